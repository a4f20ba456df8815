"""The synthetic scanner as a stage: a configuration in, a capture folder with its truth out."""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from capture4d.captures.capture import Capture, write_capture_description, write_scan
from capture4d.captures.truth import TruthFrame, TruthModel, write_truth_frame, write_truth_model
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import file_digest, read_json, write_bytes, write_json, write_npz
from capture4d.files.records import load_rig, save_body, save_garment, save_poses, save_rig
from capture4d.runs.stage import Stage, StageResult, open_stage
from capture4d.runs.workers import run_jobs
from capture4d.types import Mesh, Rig
from data_synth.cloth.patterns import locate
from data_synth.cloth.quality import measure_cloth
from data_synth.cloth.template import bind_template, carry
from data_synth.config import SynthConfig
from data_synth.outfits import OUTFITS
from data_synth.prints import picture_over
from data_synth.scan_files import pending_scans
from data_synth.scanner.scan import scan_surfaces
from data_synth.take import TakePlan, in_view, measured_poses, plan_take, simulate_take, take_rig, take_surfaces
from data_synth.worn import template_weights

__all__ = [
    "ScanJob",
    "Scene",
    "finish_take",
    "is_whole",
    "open_scene",
    "open_take",
    "run",
    "scan_frame",
    "scan_jobs",
    "simulate_clip",
    "simulated_frames",
    "simulation_jobs",
]

SCHEMA = 3
SIMULATED = (
    "capture.json",
    "rig.json",
    "body.npz",
    "poses.npz",
    "template.npz",
    "truth/poses.npz",
    "truth/model.npz",
)
"""Files of a take that the simulation writes, besides the cloth."""
PRINT = "truth/print.png"
"""What is printed on the garment, over the bounding box of the template's UVs; not there if nothing is."""
QUALITY = "truth/quality.json"


def run(output: Path, config: SynthConfig, *, workers: int = 2, overwrite: bool = False) -> StageResult:
    """Simulate and scan a take.

    Simulation is sequential and starts over when it was interrupted; scans are made in parallel and kept. Files that a
    finished take has lost are made anew, for which the clip is simulated again.

    Raises:
        InputError: the folder holds something else.
    """
    stage = open_take(output, config, overwrite=overwrite)
    for _ in run_jobs(
        simulate_clip,
        simulation_jobs(stage, config),
        workers=1,
        label="simulate cloth",
        units=lambda _: config.frames,
        finished=lambda: simulated_frames(stage),
    ):
        pass
    prepare = partial(open_scene, stage, config)
    for _ in run_jobs(scan_frame, scan_jobs(stage, config), prepare=prepare, workers=workers, label="scan"):
        pass
    return finish_take(stage, config)


def open_take(output: Path, config: SynthConfig, *, overwrite: bool = False) -> Stage:
    """The folder of a take, new or to be continued.

    Raises:
        InputError: the folder holds something else or a take with other settings.
    """
    upstream = {}
    if config.motion.bvh is not None:
        path = Path(config.motion.bvh)
        if not path.is_file():
            raise InputError("no such BVH file", where=path)
        upstream["bvh"] = file_digest([path], root=path.parent)
    return open_stage(output, name="synth", schema=SCHEMA, config=config, upstream=upstream, overwrite=overwrite)


@dataclass(frozen=True, slots=True)
class SimulationJob:
    """The whole clip: a simulation is sequential."""

    stage: Stage
    config: SynthConfig


@dataclass(frozen=True, slots=True)
class ScanJob:
    """One frame."""

    stage: Stage
    config: SynthConfig
    frame_id: int


def simulation_jobs(stage: Stage, config: SynthConfig) -> list[SimulationJob]:
    """One, or none if the clip has been simulated. What an interrupted simulation has left is removed."""
    cloth = stage.path / "cloth"
    lost = [name for name in _simulated(config) if not (stage.path / name).is_file()]
    if ((cloth / "complete.json").exists() and not lost) or is_whole(stage, config):
        return []
    shutil.rmtree(cloth, ignore_errors=True)
    return [SimulationJob(stage, config)]


def simulated_frames(stage: Stage) -> int:
    """Frames of the clip that lie on disk so far."""
    return len(list((stage.path / "cloth").glob("0*.npz")))


def scan_jobs(stage: Stage, config: SynthConfig) -> list[ScanJob]:
    """The frames that have not been scanned yet, or whose scan or truth is lost or cut off."""
    return [ScanJob(stage, config, frame_id) for frame_id in _unscanned(stage, config)]


def is_whole(stage: Stage, config: SynthConfig) -> bool:
    """Whether every file of the take is there."""
    wanted = [*_simulated(config), QUALITY]
    return all((stage.path / name).is_file() for name in wanted) and not _unscanned(stage, config)


def _simulated(config: SynthConfig) -> tuple[str, ...]:
    return SIMULATED if config.print is None else (*SIMULATED, PRINT)


def _unscanned(stage: Stage, config: SynthConfig) -> list[int]:
    frame_ids = range(1, config.frames + 1)
    pending = set(stage.pending(frame_ids, folder="truth"))
    if config.scans:
        pending.update(pending_scans(stage, frame_ids))
    return sorted(pending)


def finish_take(stage: Stage, config: SynthConfig) -> StageResult:
    """Close the folder of a take whose frames are all there."""
    frame_ids = list(range(1, config.frames + 1))
    _write_quality(stage, frame_ids)
    files = [stage.path / name for name in (*_simulated(config), QUALITY)]
    files += [stage.frame_path(frame_id, folder="truth") for frame_id in frame_ids]
    if config.scans:
        files += [stage.frame_path(frame_id, ".ply", folder="scans") for frame_id in frame_ids]
    result = stage.finish(files)
    shutil.rmtree(stage.path / "cloth", ignore_errors=True)
    return result


def simulate_clip(job: SimulationJob) -> None:
    """Simulate a clip and write its cloth, and what no scan changes."""
    take, folder, config = plan_take(job.config), job.stage.path, job.config
    faces = take.shaped.body.template.faces
    dressed, extent = None, []
    for index, coarse, fine in simulate_take(take):
        step = index + take.lead
        if step == config.simulation.calm_frames - 1:
            dressed = carry(take.coarse, take.template, coarse)
        if index == 0:
            assert dressed is not None
            assert fine is not None
            _write_model(take, folder, dressed, coarse, fine)
        if fine is None:
            continue
        frame_id = 1 + index // config.capture_every
        surface = take.bodies[step].vertices()
        quality = measure_cloth(take.fine, take.wrinkles, fine, surface, faces)
        write_json(folder / "cloth" / f"{frame_id:06d}.json", asdict(quality))
        write_npz(folder / "cloth" / f"{frame_id:06d}.npz", vertices=fine, body=surface.astype(np.float32))
        extent.append(in_view(config, fine, surface))
    rig = take_rig(config, np.array(extent))
    save_rig(folder / "rig.json", rig)
    outfit = OUTFITS[config.outfit]
    save_body(folder / "body.npz", take.shaped.body)
    save_poses(folder / "poses.npz", measured_poses(take))
    save_poses(folder / "truth" / "poses.npz", take.poses)
    write_capture_description(
        Capture(
            folder,
            config.name,
            take.poses.fps,
            tuple(int(frame_id) for frame_id in take.poses.frame_ids),
            outfit.garment if config.print is None else None,  # no one colour is
            dict.fromkeys(take.pattern.borders, outfit.border),
        )
    )
    if take.paint.print is not None:
        picture = picture_over(take.paint.print, take.fine, take.template.uv)
        write_bytes(folder / PRINT, cv2.imencode(".png", picture[..., ::-1])[1].tobytes())
    write_json(folder / "cloth" / "complete.json", {"frames": config.frames})


def _write_model(take: TakePlan, folder: Path, dressed: np.ndarray, coarse: np.ndarray, fine: np.ndarray) -> None:
    """The template, and the truth that no frame changes."""
    body_at = take.config.simulation.calm_frames - 1
    settled = carry(take.coarse, take.template, coarse)
    weights = template_weights(take.config, dressed, take.bodies[body_at])
    garment = bind_template(
        take.template, dressed, take.bodies[body_at], settled, take.bodies[take.lead], skin_weights=weights
    )
    save_garment(folder / "template.npz", garment)
    faces, weights = locate(take.fine, take.template.vertex_uv)
    write_truth_model(
        folder / "truth" / "model.npz",
        TruthModel(
            fine=Mesh(fine, take.fine.faces, take.fine.uv.astype(np.float32)),
            loops={name: loop.astype(np.int32) for name, loop in take.fine.loops.items()},
            template_faces=faces,
            template_barycentric=weights.astype(np.float32),
        ),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What all frames of a take are scanned with."""

    plan: TakePlan
    rig: Rig


def open_scene(stage: Stage, config: SynthConfig) -> Scene:
    """The scene of a take that has been simulated."""
    return Scene(plan_take(config), load_rig(stage.path / "rig.json"))


def scan_frame(scene: Scene, job: ScanJob) -> int:
    """Scan a simulated frame and write its truth; its number."""
    take, folder, frame_id, config = scene.plan, job.stage.path, job.frame_id, job.config
    with ArrayFile(folder / "cloth" / f"{frame_id:06d}.npz") as cloth:
        fine, surface = cloth["vertices"], cloth["body"]
    labels = np.zeros(0, np.uint8)
    if config.scans:
        scan, labels = scan_surfaces(
            scene.rig,
            take_surfaces(take, fine, surface),
            config=config.scanner,
            rng=np.random.default_rng([config.seed, 200, frame_id]),
            frame_id=frame_id,
            time_s=(frame_id - 1) / take.poses.fps,
        )
        write_scan(folder / "scans" / f"{frame_id:06d}.ply", scan)
    position = frame_id - 1
    write_truth_frame(
        folder / "truth" / f"{frame_id:06d}.npz",
        TruthFrame(fine, take.poses.rotations[position], take.poses.translations[position], labels),
    )
    return frame_id


def _write_quality(stage: Stage, frame_ids: list[int]) -> None:
    """Gather the measures of every simulated frame; bad frames are reported, not hidden."""
    path = stage.path / QUALITY
    if path.exists():
        return
    rows = [
        {"frame_id": frame_id, **read_json(stage.path / "cloth" / f"{frame_id:06d}.json")} for frame_id in frame_ids
    ]
    write_json(path, rows)
    bad = [row for row in rows if row["reasons"]]
    for row in bad[:10]:
        print(f"frame {row['frame_id']}: {'; '.join(row['reasons'])}")
    if len(bad) > 10:
        print(f"... and {len(bad) - 10} more flagged frames, all in {path}")
