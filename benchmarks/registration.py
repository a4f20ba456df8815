"""Registration against the truth, and against what else one can install.

Kinds of data: `synth`, a synthetic take of a T-shirt on a moving body (made once, kept in the user's cache);
`takes`, several such takes, frame by frame (`whole_takes`); `diffcloth`, a shirt simulated by somebody else, scanned by
our scanner; `faces`, six faces in dense correspondence and one real scan; `printed`, takes of printed cloth
(`printed_registration`); and pairs of meshes for `register-mesh`: `people`, `borders`, `hopeless`
(`benchmarks.mesh_pairs`).
`diffcloth` and `faces` are read from the folder `shared/data` beside the project.

Limits this was built against, on a take of 212 frames that ends in the pose it began with, with a template of 5,000
vertices and scans of 200,000: truth distance 0.4 mm mean and 1.2 at 95 %, border 1.5 and 4 mm, correspondence 0.6 of
the best peer's, drift ratio 1.2, warm 0.25 and cold 0.8 CPU s, 40 times less than nricp_amberg, 700 MB; all stages of a
frame, its scan read and its pose tracked, 0.5 CPU s (`whole_frame`).

Peers start where ours starts and are timed in the same way: process time, all threads.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import numpy as np
from rich.console import Console
from scipy.spatial import KDTree

from benchmarks.memory import peak_rss_mb
from benchmarks.mesh_pairs import measure_borders, measure_hopeless, measure_people
from benchmarks.metric import Metric
from benchmarks.peers import PEERS, run_peer
from benchmarks.printed_registration import printed_metrics
from benchmarks.whole_frame import whole_frame_metrics
from benchmarks.whole_takes import take_metrics
from capture4d.captures.capture import Capture, read_capture, write_capture_description
from capture4d.captures.evaluation import (
    border_errors,
    correspondence_errors,
    drift_ratio,
    material_points,
    truth_distances,
)
from capture4d.captures.garment_scans import load_garment_scan
from capture4d.captures.truth import read_truth_model, read_truth_vertices
from capture4d.extraction.stage import ExtractionSettings
from capture4d.extraction.stage import run as extract
from capture4d.files.atomic import read_json
from capture4d.geometry.ray_casting import surface_distances
from capture4d.mesh_files.meshes import read_mesh
from capture4d.types import Garment, GarmentScan, Mesh
from registration.config import PAPER, MeshRegistrationConfig, RegistrationConfig
from registration.predictions import Mover
from registration.register import prepare_frame, register_frame
from registration.register_mesh import register_mesh
from registration.stage import run as register
from registration.template import analyse_template

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
COVERED_M = 0.005
"""A template vertex has scan data if its true place has a scan vertex this near."""
FACES = ("SIMPOP_01", "SIMPOP_05", "SIMPOP_10", "SIMPOP_15", "SIMPOP_20", "SIMPOP_25")


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One frame with its truth, metres."""

    name: str
    scan: GarmentScan
    start: np.ndarray
    """(V, 3) template vertices where every method starts."""
    truth: Mesh
    """The noise-free surface."""
    places: np.ndarray
    """(V, 3) true places of the template's vertices."""
    true_borders: Mapping[str, np.ndarray]

    def covered(self) -> np.ndarray:
        return KDTree(self.scan.mesh.vertices).query(self.places)[0] < COVERED_M


@dataclass(frozen=True, slots=True)
class Scores:
    """Means over frames of one method, millimetres and CPU seconds."""

    truth_distance_mean_mm: float
    truth_distance_p95_mm: float
    missed_mean_mm: float
    """True surface to the registered one."""
    border_mean_mm: float
    border_p95_mm: float
    correspondence_mean_mm: float
    correspondence_p95_mm: float
    cpu_s: float


def run(
    *,
    quick: bool = False,
    data: Literal["synth", "takes", "diffcloth", "faces", "printed", "people", "borders", "hopeless"] = "synth",
    frames: int = 212,
    compared: int = 6,
    workers: int = 2,
    capture: Path | None = None,
    seed: int | None = None,
) -> list[Metric]:
    """Register a take, and single frames of it with every method.

    Args:
        quick: few frames of a small take; the same keys.
        data: see above.
        frames: of the take (synth, takes, printed); drift compares its last 20 with its first 20.
        compared: frames on which all methods start from the same place.
        workers: processes that make the take; registration itself is measured in one.
        capture: capture folder with truth to measure on instead of the cached synthetic take.
        seed: of people and shirts that are drawn, in place of those on which settings were chosen (people, borders,
            hopeless).
    """
    pairs = {"people": measure_people, "borders": measure_borders, "hopeless": measure_hopeless}
    if data in pairs:
        return pairs[data](quick=quick, seed=seed)
    if data == "faces":
        return _faces(2 if quick else len(FACES))
    if data == "printed":
        return printed_metrics(quick=quick, frames=frames, workers=workers)
    if data == "takes":
        return take_metrics(quick=quick, frames=frames, workers=workers)
    with tempfile.TemporaryDirectory(prefix="capture4d-registration-") as scratch:
        if data == "diffcloth":
            scans = _scanned_diffcloth(Path(scratch) / "capture", 4 if quick else 13, workers)
            near = _take(scans, Path(scratch), 3 if quick else compared, start="previous")
            return near if quick else near + _far_diffcloth(Path(scratch) / "far", workers)
        take = read_capture(capture or _synthetic_take(quick, workers))
        first = _first_frames(take, Path(scratch) / "capture", frames)
        return _take(first, Path(scratch), 2 if quick else compared, start="skinned")


def _synthetic_take(quick: bool, workers: int) -> Path:
    from benchmarks.cached_takes import cached_take
    from data_synth.config import PRESETS

    return cached_take(
        replace(PRESETS["tiny"], frames=12, capture_every=1) if quick else PRESETS["tshirt-200k"], workers=workers
    )


def _far_diffcloth(folder: Path, workers: int) -> list[Metric]:
    """From the first frame to far ones at once, as two meshes without settings; correspondence."""
    capture = read_capture(_scanned_diffcloth(folder / "capture", 6, workers, step=50))
    extract(capture, folder / "garment", ExtractionSettings())
    cases = list(_cases(capture, folder / "garment", "previous")(None))
    metrics = []
    for row in (2, 5):
        result = register_mesh(
            capture.template.template, cases[row].scan.mesh, config=MeshRegistrationConfig(units="m")
        )
        errors = correspondence_errors(result.vertices, cases[row].places)
        metrics.append(Metric(f"far_{50 * row}_mm", float(1e3 * errors.mean()), "mm"))
    return metrics


def _scanned_diffcloth(output: Path, frames: int, workers: int, *, step: int = 10) -> Path:
    from data_synth.scan_stage import run as scan
    from data_synth.scanner.config import ScanConfig

    meshes = _shared("diffcloth-tshirt/sequence_a.npz")
    scan(meshes, output, ScanConfig(height_m=0.7, frames=frames, step=step, fps=60.0), workers=workers)
    return output


def _shared(name: str) -> Path:
    path = SHARED / name
    if not path.exists():
        raise FileNotFoundError(f"{path}: this benchmark needs the third-party data beside the project")
    return path


# --- a take ------------------------------------------------------------------------------------------------------


def _take(folder: Path, scratch: Path, compared: int, *, start: Literal["skinned", "previous"]) -> list[Metric]:
    capture = read_capture(folder)
    extract(capture, scratch / "garment", ExtractionSettings())
    peak_mb = _peak_rss(folder, scratch / "garment", scratch / "registration")
    third = _first_frames(capture, scratch / "short", max(2, len(capture.frame_ids) // 3))
    extract(read_capture(third), scratch / "short-garment", ExtractionSettings())
    short_mb = _peak_rss(third, scratch / "short-garment", scratch / "short-registration")
    records = [read_json(path) for path in sorted((scratch / "registration" / "metrics").glob("*.json"))]
    garment = capture.template

    def load(frame_id: int) -> np.ndarray:
        with np.load(scratch / "registration" / "frames" / f"{frame_id:06d}.npz") as arrays:
            return arrays["vertices"]

    cases = _cases(capture, scratch / "garment", start)
    whole = [_score(garment, case, load(capture.frame_ids[row]), 0.0) for row, case in enumerate(cases(None))]
    take = _mean(whole)
    warm = [record["cpu_s"] for record in records if "warm" in record["started_from"]]
    metrics = [
        Metric("truth_distance_mean_mm", take.truth_distance_mean_mm, "mm"),
        Metric("truth_distance_p95_mm", take.truth_distance_p95_mm, "mm"),
        Metric("missed_mean_mm", take.missed_mean_mm, "mm"),
        Metric("border_mean_mm", take.border_mean_mm, "mm"),
        Metric("border_p95_mm", take.border_p95_mm, "mm"),
        Metric("correspondence_mean_mm", take.correspondence_mean_mm, "mm"),
        Metric("correspondence_p95_mm", take.correspondence_p95_mm, "mm"),
        Metric("drift_ratio", drift_ratio(np.array([scores.correspondence_mean_mm for scores in whole]))),
        Metric("warm_cpu_s", _median(warm), "s"),
        Metric("peak_rss_mb", peak_mb, "MB"),
        Metric("rss_growth_mb", peak_mb - short_mb, "MB"),
        Metric("failed_frames", float(sum(record["verdict"] == "failed" for record in records))),
    ]
    metrics += _comparison(garment, list(cases(compared)), _median(warm))
    nricp = next(each.value for each in metrics if each.key == "nricp_amberg_cpu_s")
    tracked = start == "skinned"  # of the others no body was scanned
    return metrics + (whole_frame_metrics(capture, scratch / "whole", _median(warm), nricp) if tracked else [])


def _cases(
    capture: Capture, garment_folder: Path, start: Literal["skinned", "previous"]
) -> Callable[[int | None], Iterator[Case]]:
    """Frames with their truth: all of a take, or so many spread over it."""
    model, garment, config = read_truth_model(capture), capture.template, RegistrationConfig()
    assert model is not None, "these takes come with their truth"
    mover = Mover.create(analyse_template(garment, config), capture.body, capture.poses)

    def places(fine: np.ndarray) -> np.ndarray:
        return material_points(fine, model.fine.faces, model.template_faces, model.template_barycentric)

    def generate(count: int | None) -> Iterator[Case]:
        total = len(capture.frame_ids)
        for row in range(total) if count is None else np.linspace(1, total - 1, count).round().astype(int).tolist():
            frame_id = capture.frame_ids[row]
            fine = read_truth_vertices(capture, frame_id)
            before = read_truth_vertices(capture, capture.frame_ids[max(row - 1, 0)])
            yield Case(
                name=f"frame {frame_id}",
                scan=load_garment_scan(garment_folder / "frames" / f"{frame_id:06d}.npz", frame_id),
                start=places(before) if mover is None or start == "previous" else mover.skinned(row),
                truth=Mesh(fine, model.fine.faces),
                places=places(fine),
                true_borders={name: fine[loop] for name, loop in model.loops.items()},
            )

    return generate


def _comparison(garment: Garment, cases: Sequence[Case], warm_cpu_s: float) -> list[Metric]:
    """Ours, its ablations and the peers, from the same starts."""
    default = RegistrationConfig()
    boundary = default.boundary
    ours = {
        "default": default,
        "paper": PAPER,
        "no_border": replace(default, boundary=replace(boundary, coarse_rule="none", dense_rule="none")),
        "nearest": replace(default, boundary=replace(boundary, coarse_rule="nearest", dense_rule="nearest")),
        "eq2": replace(default, boundary=replace(boundary, coarse_rule="argmax", dense_rule="argmax")),
    }
    scores: dict[str, Scores] = {}
    for name, config in ours.items():
        analysis = analyse_template(garment, config)
        rows = []
        for case in cases:
            begin = time.process_time()
            fitted = register_frame(analysis, prepare_frame(analysis, case.scan, config), case.start, config=config)
            rows.append(_score(garment, case, fitted.vertices, time.process_time() - begin))
        scores[name] = _mean(rows)
    faces = garment.template.faces
    for name in PEERS:
        rows = []
        for case in cases:
            Console(stderr=True).print(f"{name}, {case.name}")
            scan = case.scan.mesh
            result = run_peer(name, case.start, faces, scan.vertices.astype(np.float64), scan.faces)
            rows.append(_score(garment, case, result.vertices, result.cpu_s))
        scores[name] = _mean(rows)
    return _comparison_metrics(scores, warm_cpu_s)


def _comparison_metrics(scores: Mapping[str, Scores], warm_cpu_s: float) -> list[Metric]:
    metrics = [Metric("cold_cpu_s", scores["default"].cpu_s, "s")]
    metrics += [
        Metric(f"{name}_{key}", getattr(score, key), "s" if key == "cpu_s" else "mm")
        for name, score in scores.items()
        for key in Scores.__dataclass_fields__
    ]
    best = {
        key: min(getattr(scores[name], key) for name in PEERS)
        for key in ("truth_distance_mean_mm", "truth_distance_p95_mm", "missed_mean_mm", "correspondence_mean_mm")
    }
    for key, value in best.items():
        metrics.append(Metric(f"{key.removesuffix('_mm')}_ratio_to_best_peer", getattr(scores["default"], key) / value))
    metrics.append(Metric("cpu_ratio_to_nricp_amberg", scores["nricp_amberg"].cpu_s / warm_cpu_s, "", "higher"))
    return metrics


def _score(garment: Garment, case: Case, vertices: np.ndarray, cpu_s: float) -> Scores:
    registered = Mesh(vertices.astype(np.float32), garment.template.faces)
    there, back = truth_distances(registered, case.truth, covered=case.covered())
    borders = border_errors({name: vertices[loop] for name, loop in garment.loops.items()}, case.true_borders)
    matched = correspondence_errors(vertices, case.places)
    return Scores(
        truth_distance_mean_mm=float(1e3 * there.mean()),
        truth_distance_p95_mm=float(1e3 * np.percentile(there, 95)),
        missed_mean_mm=float(1e3 * back.mean()),
        border_mean_mm=float(1e3 * borders.mean()),
        border_p95_mm=float(1e3 * np.percentile(borders, 95)),
        correspondence_mean_mm=float(1e3 * matched.mean()),
        correspondence_p95_mm=float(1e3 * np.percentile(matched, 95)),
        cpu_s=cpu_s,
    )


def _mean(scores: Sequence[Scores]) -> Scores:
    return Scores(**{key: float(np.mean([getattr(s, key) for s in scores])) for key in Scores.__dataclass_fields__})


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if len(values) else float("nan")


# --- memory ------------------------------------------------------------------------------------------------------


def _peak_rss(capture: Path, garment: Path, output: Path) -> float:
    """Largest resident set of a process that registers the capture and does nothing else, MB."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(_register_and_measure, capture, garment, output).result()


def _register_and_measure(capture: Path, garment: Path, output: Path) -> float:
    register(read_capture(capture), garment, output, RegistrationConfig(), workers=1)
    return peak_rss_mb()


def _first_frames(capture: Capture, folder: Path, count: int) -> Path:
    """The first frames of a take, as a capture of links to it."""
    folder.mkdir()
    for path in capture.path.iterdir():
        if path.name != "capture.json":
            (folder / path.name).symlink_to(path.resolve())
    write_capture_description(replace(capture, path=folder, frame_ids=capture.frame_ids[:count]))
    return folder


# --- faces -------------------------------------------------------------------------------------------------------


def _faces(count: int) -> list[Metric]:
    """A face template to faces in dense correspondence, and to a real scan without; all start where ours did."""
    template = _face("Template")
    config = MeshRegistrationConfig(units="m")
    rows: dict[str, list[list[float]]] = {name: [] for name in ("ours", *PEERS)}
    real: dict[str, float] = {}
    for name in [*FACES[:count], "DemoFace_10K"]:
        scan = _face(name)
        begin = time.process_time()
        result = register_mesh(template, scan, config=config)
        found = {"ours": (result.vertices.astype(np.float64), time.process_time() - begin)}
        for peer in PEERS:
            Console(stderr=True).print(f"{peer}, {name}")
            answer = run_peer(peer, result.start, template.faces, scan.vertices.astype(np.float64), scan.faces)
            found[peer] = (answer.vertices, answer.cpu_s)
        for method, (vertices, cpu_s) in found.items():
            there = 1e3 * surface_distances(scan, vertices)
            if name not in FACES:
                real[method] = float(np.median(there))
                continue
            back = 1e3 * surface_distances(Mesh(vertices.astype(np.float32), template.faces), scan.vertices)
            matched = 1e3 * correspondence_errors(vertices, scan.vertices)
            rows[method].append([there.mean(), back.mean(), matched.mean(), np.percentile(matched, 95), cpu_s])
    keys = ("truth_distance_mean_mm", "missed_mean_mm", "correspondence_mean_mm", "correspondence_p95_mm", "cpu_s")
    metrics = [
        Metric(f"{method}_{key}", value, "s" if key == "cpu_s" else "mm")
        for method, values in rows.items()
        for key, value in zip(keys, np.mean(values, axis=0).tolist(), strict=True)
    ]
    return metrics + [Metric(f"{method}_real_scan_distance_median_mm", value, "mm") for method, value in real.items()]


def _face(name: str) -> Mesh:
    """A face in metres; the files are in millimetres."""
    mesh = read_mesh(_shared(f"face-templates/{name}.obj")).mesh
    return mesh.with_vertices((mesh.vertices / 1000).astype(np.float32))
