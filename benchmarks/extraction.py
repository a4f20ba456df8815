"""Garment extraction with learned colours against the labels of the virtual scanner.

Frames of a simulated T-shirt on a body, painted anew and scanned under three lights in two outfits. Nothing is told but
the scans: garment, paint, suit and skin have to be found. Limits this was built against, worst case of the depth
scanner: precision and recall of the garment's vertices 0.99, 95 % of the border points within 2 mm of the true border.
The stereo scanner, whose scans run on from the cloth to the body behind it, is measured apart (`stereo_`).
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from rich.console import Console
from scipy.spatial import KDTree

from benchmarks.cached_takes import cached_take
from benchmarks.metric import Metric
from capture4d.body.skinning import pose_frame, with_shape
from capture4d.captures.capture import read_capture
from capture4d.captures.evaluation import curve_distances
from capture4d.captures.take_colours import KnownColours
from capture4d.captures.truth import read_truth_frame, read_truth_model
from capture4d.colours.learning import ColoursNotSeparableError, learn_colours
from capture4d.extraction.garment import ColourNotFoundError, cut_out
from capture4d.files.records import load_poses
from capture4d.geometry.ray_casting import surface_distances
from capture4d.types import GarmentScan, Mesh, Scan
from data_synth.config import PRESETS
from data_synth.outfits import OUTFITS, OutfitName
from data_synth.scanner.border_paint import PaintedSheet, paint_borders
from data_synth.scanner.config import FusionConfig, Lighting, RigConfig, ScannerConfig, ShadingConfig, StereoConfig
from data_synth.scanner.raycast import Surface
from data_synth.scanner.rig import bounding_sphere, scanner_rig
from data_synth.scanner.scan import LABEL_BODY, LABEL_GARMENT, scan_surfaces

OUTFITS_MEASURED: tuple[OutfitName, ...] = ("blue", "red")
BAND_M = 0.012
"""Width of the paint."""
NEAR_M, COVERED_M = 0.002, 0.01
QUICK_SCANNER = ScannerConfig(
    rig=RigConfig(cameras=32, image_size=448),
    stereo=StereoConfig(pods=12, image_size=512, supersampling=1, speckle_window_px=80),
    fusion=FusionConfig(garment_voxel_m=0.0034, body_voxel_m=0.007, min_component_faces=250),
)


@dataclass(frozen=True, slots=True, eq=False)
class _Dressed:
    """One frame before it is painted and scanned."""

    cloth: np.ndarray
    body: np.ndarray


@dataclass(frozen=True, slots=True)
class _Case:
    outfit: OutfitName
    scanner: ScannerConfig

    @property
    def name(self) -> str:
        return f"{self.scanner.sensor}, {self.outfit}, {self.scanner.shading.lighting}"


@dataclass(frozen=True, slots=True)
class _Scores:
    """Of one case, worst over its frames."""

    precision: float
    recall: float
    border_within_percent: float
    border_p95_mm: float
    border_covered_percent: float
    """Of the true border, with a border point within 10 mm."""
    learn_cpu_s: float
    extract_cpu_s: float
    """A frame."""
    scan_cpu_s: float
    """A frame."""
    scan_median_mm: float
    """Scan vertex to the true surface."""
    scan_p95_mm: float


def run(*, quick: bool = False, frames: int = 3, workers: int = 2) -> list[Metric]:
    """Scan, learn, extract, compare.

    Args:
        quick: two frames of a small take, and a coarser scanner.
        frames: of the take, a third of it apart; colours are learned from them.
        workers: processes that make the take, if it is not in the cache.
    """
    take = _Take.load(
        cached_take(
            replace(PRESETS["tiny"], frames=12, capture_every=1) if quick else PRESETS["tshirt-200k"], workers=workers
        )
    )
    rows = np.linspace(0, 2 / 3, 2 if quick else frames) * take.frames
    dressed = [take.frame(int(row)) for row in rows]
    scores = {case: _measure(take, case, dressed) for case in _cases(QUICK_SCANNER if quick else ScannerConfig())}
    _print_rows(scores)
    depth = [score for case, score in scores.items() if case.scanner.sensor == "depth"]
    stereo = [score for case, score in scores.items() if case.scanner.sensor == "stereo"]
    return [
        *_worst("", depth),
        *_worst("stereo_", stereo),
        Metric("stereo_scan_median_mm", max(score.scan_median_mm for score in stereo), "mm"),
        Metric("stereo_scan_p95_mm", max(score.scan_p95_mm for score in stereo), "mm"),
        Metric("stereo_scan_cpu_s", max(score.scan_cpu_s for score in stereo), "s"),
        Metric("learn_cpu_s", max(score.learn_cpu_s for score in scores.values()), "s"),
        Metric("extract_cpu_s", max(score.extract_cpu_s for score in scores.values()), "s"),
    ]


def _cases(scanner: ScannerConfig) -> Iterator[_Case]:
    """All lights with the depth scanner; with the stereo scanner, whose scans are slow, each outfit in one."""
    lights: tuple[Lighting, ...] = ("even", "side", "two-temperature")
    for index, outfit in enumerate(OUTFITS_MEASURED):
        for lighting in lights:
            yield _Case(outfit, replace(scanner, shading=ShadingConfig(lighting=lighting)))
        lit = ShadingConfig(lighting=lights[-1 - index])
        yield _Case(outfit, replace(scanner, sensor="stereo", shading=lit))


@dataclass(frozen=True, slots=True, eq=False)
class _Take:
    folder: Path
    frames: int
    fine: Mesh
    loops: dict[str, np.ndarray]
    faces: np.ndarray
    bare: np.ndarray
    """Body vertices without a suit."""

    @staticmethod
    def load(folder: Path) -> _Take:
        capture = read_capture(folder)
        model, body = read_truth_model(capture), capture.body
        assert model is not None
        assert body is not None
        assert body.regions is not None
        return _Take(
            folder, len(capture.frame_ids), model.fine, dict(model.loops), body.template.faces, body.regions > 0
        )

    def frame(self, row: int) -> _Dressed:
        capture = read_capture(self.folder)
        poses, body = load_poses(self.folder / "truth" / "poses.npz"), capture.body
        assert body is not None
        posed = pose_frame(with_shape(body, poses.shape), poses, row).vertices()
        return _Dressed(read_truth_frame(capture, capture.frame_ids[row]).vertices, posed.astype(np.float32))


@lru_cache(maxsize=1)
def _painted(take: _Take, name: OutfitName, max_edge_m: float) -> PaintedSheet:
    outfit = OUTFITS[name]
    return paint_borders(
        take.fine,
        width_m=BAND_M,
        garment_colour=outfit.garment,
        border_colours=[outfit.border],
        max_edge_m=max_edge_m,
    )


def _scan(take: _Take, case: _Case, dressed: _Dressed, seed: int) -> tuple[Scan, np.ndarray, Mesh]:
    """A scan, whether each of its vertices is on the garment, and the true surface."""
    outfit, fusion = OUTFITS[case.outfit], case.scanner.fusion
    sheet = _painted(take, case.outfit, fusion.garment_voxel_m)
    suit = np.where(take.bare[:, None], outfit.skin, outfit.suit).astype(np.uint8)
    surfaces = [
        Surface(sheet.posed(dressed.cloth), sheet.colours, LABEL_GARMENT, fusion.garment_voxel_m, sheet.painted),
        Surface(Mesh(dressed.body, take.faces), suit, LABEL_BODY, fusion.body_voxel_m),
    ]
    centre, radius = bounding_sphere(dressed.cloth)
    scan, labels = scan_surfaces(
        scanner_rig(case.scanner, centre=centre, radius=max(radius, 0.58)),
        surfaces,
        config=case.scanner,
        rng=np.random.default_rng(seed),
    )
    cloth = surfaces[0].mesh
    truth = Mesh(
        np.concatenate([cloth.vertices, dressed.body]),
        np.concatenate([cloth.faces, take.faces + np.int32(len(cloth.vertices))]),
    )
    return scan, labels != LABEL_BODY, truth


def _measure(take: _Take, case: _Case, dressed: Sequence[_Dressed]) -> _Scores:
    Console(stderr=True).print(case.name, highlight=False)
    begin = time.process_time()
    scans = [_scan(take, case, each, seed) for seed, each in enumerate(dressed)]
    scanned = time.process_time()
    off = [1e3 * surface_distances(truth, scan.mesh.vertices) for scan, _, truth in scans]
    accuracy = max(float(np.median(each)) for each in off), max(float(np.percentile(each, 95)) for each in off)
    begin_learning = time.process_time()
    try:
        found = learn_colours([scan for scan, *_ in scans], source=case.name)
    except ColoursNotSeparableError as error:
        Console(stderr=True).print(str(error), highlight=False)
        return _Scores(0, 0, 0, np.inf, 0, np.nan, np.nan, np.nan, *accuracy)
    learned = time.process_time()
    paint = dict.fromkeys(take.loops, found.paints[0]) if found.paints else {}
    colours = KnownColours(found.garment, paint, tuple(paint), found.others, found.light)
    rows = []
    extract_cpu_s = 0.0
    for (scan, is_garment, _), each in zip(scans, dressed, strict=True):
        start = time.process_time()
        try:
            garment = cut_out(scan, colours)
        except ColourNotFoundError:
            rows.append((0.0, 0.0, 0.0, np.inf, 0.0))
            continue
        extract_cpu_s += time.process_time() - start
        rows.append(_compare(garment, scan, is_garment, {name: each.cloth[loop] for name, loop in take.loops.items()}))
    precision, recall, within, p95, covered = np.array(rows).T
    return _Scores(
        precision=float(precision.min()),
        recall=float(recall.min()),
        border_within_percent=float(within.min()),
        border_p95_mm=float(p95.max()),
        border_covered_percent=float(covered.min()),
        learn_cpu_s=learned - begin_learning,
        extract_cpu_s=extract_cpu_s / len(dressed),
        scan_cpu_s=(scanned - begin) / len(dressed),
        scan_median_mm=accuracy[0],
        scan_p95_mm=accuracy[1],
    )


def _compare(
    garment: GarmentScan, scan: Scan, is_garment: np.ndarray, loops: dict[str, np.ndarray]
) -> tuple[float, float, float, float, float]:
    """Precision, recall, border points near the true border (%), their 95 % distance (mm), true border covered (%)."""
    kept = KDTree(garment.mesh.vertices).query(scan.mesh.vertices)[0] == 0
    hits = float((kept & is_garment).sum())
    if not len(garment.boundary_points):
        return hits / kept.sum(), hits / is_garment.sum(), 0.0, np.inf, 0.0
    there = np.min([curve_distances(garment.boundary_points, loop) for loop in loops.values()], axis=0)
    back = KDTree(garment.boundary_points).query(np.concatenate(list(loops.values())))[0]
    return (
        hits / kept.sum(),
        hits / is_garment.sum(),
        100 * float((there < NEAR_M).mean()),
        1e3 * float(np.percentile(there, 95)),
        100 * float((back < COVERED_M).mean()),
    )


def _worst(prefix: str, scores: Sequence[_Scores]) -> list[Metric]:
    return [
        Metric(f"{prefix}garment_precision", min(score.precision for score in scores), "", "higher"),
        Metric(f"{prefix}garment_recall", min(score.recall for score in scores), "", "higher"),
        Metric(
            f"{prefix}border_within_2mm_percent", min(score.border_within_percent for score in scores), "%", "higher"
        ),
        Metric(f"{prefix}border_p95_mm", max(score.border_p95_mm for score in scores), "mm"),
        Metric(f"{prefix}border_covered_percent", min(score.border_covered_percent for score in scores), "%", "higher"),
    ]


def _print_rows(scores: dict[_Case, _Scores]) -> None:
    """One line a case: what it is, and its scores in the order of their definition."""
    for case, score in scores.items():
        cells = [f"{name} {getattr(score, name):.4g}" for name in _Scores.__dataclass_fields__]
        Console(width=400).print(f"{case.name}: {', '.join(cells)}", highlight=False)
