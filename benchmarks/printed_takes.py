"""Takes of printed and of plain cloth: simulated once for each person, scanned once for each print and each noise.

All is kept in the cache folder.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from benchmarks.cached_takes import cached_take, one_maker
from capture4d.cache import user_cache_folder
from capture4d.captures.capture import Capture, read_capture, write_capture_description, write_scan
from capture4d.captures.truth import read_truth_vertices
from capture4d.files.atomic import write_bytes, write_npy
from capture4d.runs.workers import run_jobs
from capture4d.types import Rig
from data_synth.config import PRESETS, GarmentStyle, MotionConfig, SynthConfig
from data_synth.outfits import PrintName
from data_synth.prints import logo_circle, picture_over
from data_synth.scanner.config import FusionConfig, RigConfig, ScannerConfig, ShadingConfig
from data_synth.scanner.scan import LABEL_BODY, scan_surfaces
from data_synth.take import TakePlan, plan_take, take_rig, take_surfaces

__all__ = ["LAMP", "PrintedTake", "plain_scans", "printed_take", "subjects"]

LAMP = ShadingConfig(lighting="overhead", pixel_noise=0.04)
"""One strong lamp that flickers, and noise of which a scan's vertices keep about 0.02."""


@dataclass(frozen=True, slots=True, eq=False)
class PrintedTake:
    """A capture, and what is known of its print."""

    capture: Path
    picture: Path
    """Of the print, over the template's UVs."""
    labels: Path
    """Folder of arrays, one a frame: which vertices of the scan show the garment."""
    logo: tuple[np.ndarray, float]
    """Middle and radius on the pattern of a logo, metres; wherever it would be."""

    def is_garment(self, frame_id: int) -> np.ndarray:
        """(V,) bool of a scan's vertices: they show the garment."""
        return np.load(self.labels / f"{frame_id:06d}.npy")


def subjects(frames: int, *, quick: bool) -> list[SynthConfig]:
    """The simulated takes, without scans: two people, fabrics and motions; quick is one small one."""
    if quick:
        scanner = ScannerConfig(
            rig=RigConfig(cameras=24, image_size=400),
            fusion=FusionConfig(garment_voxel_m=0.004, body_voxel_m=0.012, min_component_faces=120),
            shading=LAMP,
        )
        return [
            replace(PRESETS["tiny"], name="printed-tiny", frames=frames, capture_every=3, scans=False, scanner=scanner)
        ]
    first = replace(PRESETS["tshirt-200k"], frames=frames, scans=False)
    second = replace(
        first,
        name="tshirt-cotton-reach",
        seed=3,
        fabric="shirt-cotton",
        body_shape=(0.5, 1.2),
        style=GarmentStyle(sleeve_length=0.75),
        motion=MotionConfig(clip="reach-twist", seed=5),
    )
    return [first, second]


def plain_scans(config: SynthConfig, noise: int, *, workers: int) -> Path:
    """A capture of plain cloth: a simulated take, scanned in the usual light; goes on where it was stopped.

    Args:
        config: of a take without scans.
        noise: which of the scanner's noises.
    """
    simulated = read_capture(cached_take(config, workers=workers), scans=False)
    folder = user_cache_folder() / "printed" / f"{simulated.path.name}-plain-{noise}"
    with one_maker(folder):
        _make(folder, config, simulated, workers, noise=noise)
    return folder


def printed_take(
    config: SynthConfig, name: PrintName, print_mm: float | None, *, frames: int | None = None, workers: int
) -> PrintedTake:
    """Scans of a simulated take in which something is printed on the cloth; goes on where it was stopped.

    Args:
        config: of a take without scans.
        frames: from the beginning; None is all of the take.
    """
    simulated = read_capture(cached_take(config, workers=workers), scans=False)
    simulated = replace(simulated, frame_ids=simulated.frame_ids[:frames])
    lit = replace(config, scanner=replace(config.scanner, shading=LAMP), print=name, print_mm=print_mm)
    plan = plan_take(lit)
    assert plan.paint.print is not None
    picture = picture_over(plan.paint.print, plan.fine, plan.template.uv)
    drawn = cv2.imencode(".png", picture[..., ::-1])[1].tobytes()
    digest = hashlib.sha256(drawn).hexdigest()[:8]
    folder = user_cache_folder() / "printed" / f"{simulated.path.name}-{name}-{digest}"
    with one_maker(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_bytes(folder / "print.png", drawn)
        _make(folder, lit, simulated, workers)
    return PrintedTake(folder, folder / "print.png", folder / "labels", logo_circle(plan.template, print_mm))


def _make(folder: Path, config: SynthConfig, simulated: Capture, workers: int, *, noise: int = 0) -> None:
    for place in (folder / "scans", folder / "labels"):
        place.mkdir(parents=True, exist_ok=True)
    for entry in ("body.npz", "poses.npz", "template.npz", "truth"):
        if not (folder / entry).exists():
            (folder / entry).symlink_to(simulated.path / entry)
    printed = config.print is not None
    colour = None if printed else simulated.garment_colour
    capture = replace(simulated, path=folder, garment_colour=colour, files=None)
    missing = [each for each in simulated.frame_ids if not (folder / "scans" / f"{each:06d}.ply").is_file()]
    prepare = partial(_Scanned.open, config, simulated, folder, noise)
    for _ in run_jobs(_scan, missing, prepare=prepare, workers=workers, label=f"scan {config.print or 'plain cloth'}"):
        pass
    write_capture_description(capture)


@dataclass(frozen=True, slots=True, eq=False)
class _Scanned:
    """What all frames are scanned with."""

    plan: TakePlan
    simulated: Capture
    rig: Rig
    folder: Path
    noise: int

    @staticmethod
    def open(config: SynthConfig, simulated: Capture, folder: Path, noise: int) -> _Scanned:
        extent = []
        for frame_id in simulated.frame_ids:
            fine = read_truth_vertices(simulated, frame_id)
            extent.append((fine.min(axis=0), fine.max(axis=0)))
        return _Scanned(plan_take(config), simulated, take_rig(config, np.array(extent)), folder, noise)


def _scan(scene: _Scanned, frame_id: int) -> None:
    plan, simulated = scene.plan, scene.simulated
    step = plan.lead + (frame_id - 1) * plan.config.capture_every
    body = plan.bodies[step].vertices().astype(np.float32)
    scan, labels = scan_surfaces(
        scene.rig,
        take_surfaces(plan, read_truth_vertices(simulated, frame_id), body),
        config=plan.config.scanner,
        rng=np.random.default_rng([plan.config.seed, 200 + scene.noise, frame_id]),
        frame_id=frame_id,
        time_s=simulated.time_s(frame_id),
    )
    write_npy(scene.folder / "labels" / f"{frame_id:06d}.npy", labels != LABEL_BODY)
    write_scan(scene.folder / "scans" / f"{frame_id:06d}.ply", scan)
