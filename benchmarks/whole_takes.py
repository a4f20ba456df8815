"""Whole takes without colours, frame by frame: drift, what lies under arms, and whether frames say what is wrong.

    takes_drift_ratio               correspondence error of the last 20 frames over that of the first 20
    takes_correspondence_mm         mean over all vertices and frames
    takes_raised_p95_mm             frames with an arm above level: 95th percentile over vertices, mean over frames
    takes_raised_p95_worst_mm       the same in the worst frame
    takes_hanging_beyond_percent    frames with hanging arms: vertices more than 10 mm off, mean over frames
    takes_unsaid_beyond_percent     the same in the worst such frame that is called good; NaN if none is
    takes_unsaid_cut_faces          faces that cut others in the worst frame that is called good
    takes_unsaid_unfitted           vertices counted as fitted that lie over 5 mm from the scan, likewise
    takes_good_flagged_percent      of the frames that are truly good, those that are to be checked
    takes_good_percent              of all frames, those truly good
    takes_failed_frames             over all takes

Each is that of the worst take. A frame is truly good if it is nowhere worse than the limits of single frames: at most
20 faces cut others, 0.5 % of the vertices are more than 10 mm off and 5 % more than 6 mm.

The takes are the simulations of `printed_takes`: that of `tshirt-200k` under three noises of the scanner, and another
person's motion in another cloth. One scan of each is of printed cloth, whose colours are not looked at.

Limits this was built against: drift ratio 1.15, correspondence 2.2 mm, raised arms 6 mm; 0.5 %, 20 faces and no vertex
unsaid; at most 5 % of truly good frames flagged.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.learning_takes import true_places
from benchmarks.metric import Metric
from benchmarks.printed_takes import plain_scans, printed_take, subjects
from benchmarks.renewal import renew
from benchmarks.synthesis import arms_up
from capture4d.body.skinning import pose_frame, with_shape
from capture4d.captures.capture import Capture, read_capture
from capture4d.captures.evaluation import correspondence_errors, drift_ratio
from capture4d.captures.garment_scans import load_garment_scan
from capture4d.extraction.stage import ExtractionSettings
from capture4d.extraction.stage import run as extract
from capture4d.files.atomic import read_json
from capture4d.geometry.ray_casting import surface_distances
from registration.config import RegistrationConfig
from registration.stage import run as register

__all__ = ["take_metrics"]

MORE_NOISES = ((0, 1), ())
"""With which each simulated take is scanned once more, in plain cloth."""
HANGING, RAISED = -0.9, 0.0
"""How steeply the higher upper arm points up, 1 overhead and 0 level: below and above."""
FAR_MM, HIGH_MM, UNFITTED_MM = 10.0, 6.0, 5.0
FAR_PERCENT, CUT_FACES = 0.5, 20


@dataclass(frozen=True, slots=True, eq=False)
class _Take:
    """Of every frame of one registered take."""

    name: str
    mean_mm: np.ndarray
    p95_mm: np.ndarray
    beyond_percent: np.ndarray
    """Vertices more than `FAR_MM` off."""
    cut_faces: np.ndarray
    unfitted: np.ndarray
    """Vertices whose residual is at most `UNFITTED_MM`, though they lie farther from the scan."""
    up: np.ndarray
    """See `HANGING`."""
    verdicts: np.ndarray

    @property
    def truly_good(self) -> np.ndarray:
        return (self.cut_faces <= CUT_FACES) & (self.beyond_percent <= FAR_PERCENT) & (self.p95_mm <= HIGH_MM)

    @property
    def called_good(self) -> np.ndarray:
        return self.verdicts == "good"


def take_metrics(*, quick: bool, frames: int, workers: int) -> list[Metric]:
    """Register and measure; what was done is kept, so that a run that was stopped goes on.

    Args:
        quick: 8 frames of one small take.
    """
    takes = []
    for config, noises in zip(subjects(8 if quick else frames, quick=quick), MORE_NOISES, strict=False):
        printed = printed_take(config, "random", 24.0 if quick else None, workers=workers).capture
        takes.append(_registered(f"{config.name}, printed", printed, workers))
        for noise in () if quick else noises:
            folder = plain_scans(config, noise, workers=workers)
            takes.append(_registered(f"{config.name}, noise {noise}", folder, workers))
    _print(takes)
    hanging = [take.beyond_percent[take.up < HANGING] for take in takes]
    raised = [take.p95_mm[take.up > RAISED] for take in takes]
    good = np.concatenate([take.truly_good for take in takes])
    called = np.concatenate([take.called_good for take in takes])
    unsaid = np.concatenate([take.beyond_percent[take.called_good & (take.up < HANGING)] for take in takes])
    return [
        Metric("takes_drift_ratio", max(drift_ratio(take.mean_mm) for take in takes)),
        Metric("takes_correspondence_mm", max(float(take.mean_mm.mean()) for take in takes), "mm"),
        Metric("takes_raised_p95_mm", max((float(each.mean()) for each in raised if len(each)), default=np.nan), "mm"),
        Metric("takes_raised_p95_worst_mm", _worst(np.concatenate(raised)), "mm"),
        Metric("takes_hanging_beyond_percent", max((float(e.mean()) for e in hanging if len(e)), default=np.nan), "%"),
        Metric("takes_unsaid_beyond_percent", _worst(unsaid), "%"),
        Metric("takes_unsaid_cut_faces", _worst(np.concatenate([take.cut_faces for take in takes])[called])),
        Metric("takes_unsaid_unfitted", _worst(np.concatenate([take.unfitted for take in takes])[called])),
        Metric("takes_good_flagged_percent", 100.0 * float((good & ~called).sum() / max(good.sum(), 1)), "%"),
        Metric("takes_good_percent", 100.0 * float(good.mean()), "%", "higher"),
        Metric("takes_failed_frames", float(sum((take.verdicts == "failed").sum() for take in takes))),
    ]


def _worst(values: np.ndarray) -> float:
    return float(values.max()) if len(values) else float("nan")


def _registered(name: str, folder: Path, workers: int) -> _Take:
    capture, work = read_capture(folder), folder / "work"
    renew(partial(extract, capture, work / "garment", ExtractionSettings(), workers=workers))
    uncoloured = RegistrationConfig(colour=replace(RegistrationConfig().colour, use="off"))
    renew(partial(register, capture, work / "garment", work / "off", uncoloured))
    up, places = _arms_up(capture), true_places(capture)
    rows = [_frame(frame_id, work, there) for frame_id, there in zip(capture.frame_ids, places, strict=True)]
    mean, p95, beyond, cut, unfitted = np.array([row[:-1] for row in rows], dtype=float).T
    return _Take(name, mean, p95, beyond, cut, unfitted, up, np.array([row[-1] for row in rows]))


def _frame(frame_id: int, work: Path, places: np.ndarray) -> tuple[float, float, float, float, float, str]:
    record = read_json(work / "off" / "metrics" / f"{frame_id:06d}.json")
    with np.load(work / "off" / "frames" / f"{frame_id:06d}.npz") as arrays:
        vertices, residual = arrays["vertices"], arrays["residual_m"]
    error = 1e3 * correspondence_errors(vertices, places)
    scan = load_garment_scan(work / "garment" / "frames" / f"{frame_id:06d}.npz", frame_id).mesh
    fitted = residual <= 1e-3 * UNFITTED_MM  # NaN is not
    away = 1e3 * surface_distances(scan, vertices[fitted].astype(np.float64))
    return (
        float(error.mean()),
        float(np.percentile(error, 95)),
        100.0 * float((error > FAR_MM).mean()),
        float(record["self_intersections"]),
        float((away > UNFITTED_MM).sum()),
        record["verdict"],
    )


def _arms_up(capture: Capture) -> np.ndarray:
    """(T,) how steeply the higher upper arm points up."""
    assert capture.body is not None
    assert capture.poses is not None
    shaped = with_shape(capture.body, capture.poses.shape)
    rows = range(len(capture.frame_ids))
    return np.array([arms_up(shaped, pose_frame(shaped, capture.poses, row)) for row in rows])


def _print(takes: list[_Take]) -> None:
    table = Table(
        "take", "first 20", "last 20", "mean mm", "raised p95", "hanging > 10 mm %", "called good", "truly good"
    )
    for take in takes:
        window = max(1, min(20, len(take.mean_mm) // 2))
        cells = (
            take.mean_mm[:window].mean(),
            take.mean_mm[-window:].mean(),
            take.mean_mm.mean(),
            take.p95_mm[take.up > RAISED].mean() if (take.up > RAISED).any() else np.nan,
            take.beyond_percent[take.up < HANGING].mean() if (take.up < HANGING).any() else np.nan,
        )
        counts = (take.called_good.sum(), take.truly_good.sum())
        table.add_row(take.name, *(f"{cell:.2f}" for cell in cells), *(str(count) for count in counts))
    Console(stderr=True).print(table)
