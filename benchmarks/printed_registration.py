"""Registration of printed cloth: with colours that are learned or given, against the same takes without colours.

    printed_correspondence_mm           random print, colours learned: over vertices with scan data
    printed_ratio                       the same over that without colours
    printed_given_correspondence_mm     random print, colours from a picture
    printed_drift_ratio                 random print, learned: last 20 frames over first 20, the worse take
    printed_stripes_ratio               errors across the stripes, with colours over without
    printed_logo_ratio                  errors inside a logo on the chest, with colours over without
    printed_elsewhere_ratio             the larger of those along stripes and outside the logo
    printed_extra_cpu_s                 what colours add to a warm frame's CPU time, median
    printed_learning_cpu_s              learning the print, once a take
    printed_recall, printed_precision   of the garment's vertices, the worst frame of all

Stripes and logo are scanned in the first 60 frames of each take, over which arms sink and begin to rise: what they are
held to is the same frames without colours. Limits this was built against, on 212 frames of two people: learned 1.5 mm
and a ratio of 0.8, given 1.2 mm, drift ratio 1.05, elsewhere 1.02, 0.15 CPU s more a frame, recall and precision
0.99. Everything is kept in the user's cache folder: a run that was stopped goes on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial import KDTree

from benchmarks.metric import Metric
from benchmarks.printed_takes import PrintedTake, printed_take, subjects
from benchmarks.renewal import renew
from capture4d.captures.capture import Capture, read_capture, read_scan
from capture4d.captures.evaluation import drift_ratio, material_points
from capture4d.captures.garment_scans import load_garment_scan
from capture4d.captures.truth import read_truth_model, read_truth_vertices
from capture4d.extraction.stage import ExtractionSettings
from capture4d.extraction.stage import run as extract
from capture4d.files.atomic import read_json
from capture4d.runs.made import Ledger
from data_synth.config import SynthConfig
from data_synth.outfits import PrintName
from registration.config import RegistrationConfig
from registration.print_stage import PRINT
from registration.stage import run as register

__all__ = ["printed_metrics"]

COVERED_M = 0.005
"""As in `benchmarks.registration`."""
FEWER = 60
"""Frames of stripes and logo."""


@dataclass(frozen=True, slots=True, eq=False)
class _Errors:
    """Of one take and one way to register it, millimetres; NaN where the scan has no data."""

    u: np.ndarray
    """(T, V) along the pattern's u, across stripes."""
    v: np.ndarray
    total: np.ndarray
    """(T, V) distances."""
    inside: np.ndarray
    """(V,) vertices inside the logo."""
    warm_cpu_s: float
    learn_cpu_s: float

    @property
    def mean_mm(self) -> float:
        return float(np.nanmean(self.total))


def printed_metrics(*, quick: bool, frames: int, workers: int) -> list[Metric]:
    """Measure; see the top of the module.

    Args:
        quick: one small take of 8 frames, coarse scans and prints.
        frames: of each of the two takes otherwise.
    """
    size = 24.0 if quick else None
    found: list[Mapping[str, _Errors]] = []
    shares: list[tuple[float, float]] = []
    for config in subjects(8 if quick else frames, quick=quick):
        take = {name: _measured(config, name, size, shares, workers) for name in ("random", "stripes", "logo")}
        found.append({f"{name} {way}": errors for name, ways in take.items() for way, errors in ways.items()})
    mean = {key: float(np.mean([take[key].mean_mm for take in found])) for key in found[0]}
    drift = max(drift_ratio(np.nanmean(take["random learned"].total, axis=1)) for take in found)
    along = [_ratio(take["stripes learned"].v, take["stripes off"].v) for take in found]
    across = [_ratio(take["stripes learned"].u, take["stripes off"].u) for take in found]
    logo = [_logo_ratios(take["logo learned"], take["logo off"]) for take in found]
    extra = [take["random learned"].warm_cpu_s - take["random off"].warm_cpu_s for take in found]
    return [
        Metric("printed_correspondence_mm", mean["random learned"], "mm"),
        Metric("printed_uncoloured_correspondence_mm", mean["random off"], "mm"),
        Metric("printed_ratio", mean["random learned"] / mean["random off"]),
        Metric("printed_given_correspondence_mm", mean["random given"], "mm"),
        Metric("printed_drift_ratio", drift),
        Metric("printed_stripes_across_mm", _across(found, "stripes learned"), "mm"),
        Metric("printed_stripes_ratio", float(np.mean(across))),
        Metric("printed_logo_ratio", float(np.mean([inside for inside, _ in logo]))),
        Metric("printed_elsewhere_ratio", max([*along, *(outside for _, outside in logo)])),
        Metric("printed_extra_cpu_s", float(np.mean(extra)), "s"),
        Metric("printed_learning_cpu_s", max(take["random learned"].learn_cpu_s for take in found), "s"),
        Metric("printed_recall", min(recall for recall, _ in shares), "", "higher"),
        Metric("printed_precision", min(precision for _, precision in shares), "", "higher"),
    ]


def _across(found: Sequence[Mapping[str, _Errors]], key: str) -> float:
    return float(np.mean([np.nanmean(np.abs(take[key].u)) for take in found]))


def _ratio(coloured: np.ndarray, plain: np.ndarray) -> float:
    return float(np.nanmean(np.abs(coloured)) / np.nanmean(np.abs(plain)))


def _logo_ratios(coloured: _Errors, plain: _Errors) -> tuple[float, float]:
    """Errors inside and outside the logo, with colours over without."""
    inside = coloured.inside
    return (
        _ratio(coloured.total[:, inside], plain.total[:, inside]),
        _ratio(coloured.total[:, ~inside], plain.total[:, ~inside]),
    )


def _measured(
    config: SynthConfig, name: PrintName, print_mm: float | None, shares: list[tuple[float, float]], workers: int
) -> dict[str, _Errors]:
    take = printed_take(config, name, print_mm, frames=None if name == "random" else FEWER, workers=workers)
    capture = read_capture(take.capture)
    renew(partial(extract, capture, take.capture / "work" / "garment", ExtractionSettings(), workers=workers))
    some = capture.frame_ids[:: max(1, len(capture.frame_ids) // 12)]
    shares += [_share(take, capture, frame_id) for frame_id in some]
    colour = RegistrationConfig().colour
    ways = {"off": replace(colour, use="off"), "learned": colour}
    if name == "random":
        ways["given"] = replace(colour, print=str(take.picture))
    return {way: _registered(take, capture, way, RegistrationConfig(colour=chosen)) for way, chosen in ways.items()}


def _share(take: PrintedTake, capture: Capture, frame_id: int) -> tuple[float, float]:
    """Recall and precision of the garment's vertices."""
    found = load_garment_scan(take.capture / "work" / "garment" / "frames" / f"{frame_id:06d}.npz", frame_id)
    places = np.ascontiguousarray(read_scan(capture, frame_id).mesh.vertices)
    row = [("", places.dtype)] * 3
    cut = np.isin(places.view(row).ravel(), np.ascontiguousarray(found.mesh.vertices).view(row).ravel())
    true = take.is_garment(frame_id)
    return float((cut & true).sum() / true.sum()), float((cut & true).sum() / cut.sum())


def _registered(take: PrintedTake, capture: Capture, way: str, config: RegistrationConfig) -> _Errors:
    work = take.capture / "work"
    garments, output = work / "garment", work / way
    renew(partial(register, capture, garments, output, config))
    made = Ledger.read(output).of(output / PRINT)
    records = [read_json(output / "metrics" / f"{frame_id:06d}.json") for frame_id in capture.frame_ids]
    model = read_truth_model(capture)
    assert model is not None
    template = capture.template.template
    assert template.uv is not None
    rows = []
    for frame_id in capture.frame_ids:
        fine = read_truth_vertices(capture, frame_id)
        places = material_points(fine, model.fine.faces, model.template_faces, model.template_barycentric)
        with np.load(output / "frames" / f"{frame_id:06d}.npz") as arrays:
            error = 1e3 * (arrays["vertices"].astype(np.float64) - places)
        scan = load_garment_scan(garments / "frames" / f"{frame_id:06d}.npz", frame_id)
        error[KDTree(scan.mesh.vertices).query(places)[0] >= COVERED_M] = np.nan
        axes = pattern_axes(places.astype(np.float64), template.faces, template.uv.astype(np.float64))
        rows.append((*np.einsum("avc,vc->av", axes, error), np.linalg.norm(error, axis=1)))
    u, v, total = (np.array(each) for each in zip(*rows, strict=True))
    warm = [record["cpu_s"] for record in records if "warm" in record["started_from"]]
    middle, radius = take.logo
    corner = np.zeros((len(template.vertices), 2))
    corner[template.faces] = template.uv
    inside = np.linalg.norm(corner - middle, axis=1) < radius
    learned = 0.0 if made is None else float(made.said["cpu_s"])
    return _Errors(u, v, total, inside, float(np.median(warm)) if warm else np.nan, learned)


def pattern_axes(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Unit directions of the pattern's u and v on a posed template, (2, V, 3)."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    first, second = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    along_u = ((b - a) * second[:, 1:] - (c - a) * first[:, 1:]) / area[:, None]
    along_v = ((c - a) * first[:, :1] - (b - a) * second[:, :1]) / area[:, None]
    found = np.zeros((2, len(vertices), 3))
    for corner in range(3):
        np.add.at(found[0], faces[:, corner], along_u)
        np.add.at(found[1], faces[:, corner], along_v)
    return found / np.maximum(np.linalg.norm(found, axis=2, keepdims=True), 1e-12)
