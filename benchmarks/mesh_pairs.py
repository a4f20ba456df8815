"""Two meshes and no settings: `register-mesh` as it comes, on people, on painted shirts and on hopeless pairs.

Part of `python -m benchmarks registration`: `--data people`, `--data borders`, `--data hopeless`.

Limits this was built against. People: 8 mm of correspondence at 140 mm of motion, surface 0.6 mm, no failed pair,
stretch 1.3 at 99 %, 6 CPU s. Borders: surface 0.35 mm, border 1.3 and 3.5 mm at 95 %, correspondence 10 mm, 1.5 CPU s.
"""

from __future__ import annotations

import time

import numpy as np
from rich.console import Console

from benchmarks.dressed_people import MORE, PEOPLE, PeoplePair, draw_people, make_pair
from benchmarks.metric import Metric
from benchmarks.painted_shirts import make_shirt
from benchmarks.peers import run_peer
from capture4d.captures.evaluation import border_errors, correspondence_errors, truth_distances
from capture4d.errors import InputError
from capture4d.extraction.garment import painted_border
from capture4d.types import Mesh
from registration.config import MeshRegistrationConfig
from registration.register_mesh import MeshRegistration, register_mesh

__all__ = ["measure_borders", "measure_hopeless", "measure_people"]

BAD_MM, FINE_MM = 30.0, 10.0
"""A mean correspondence above the first has to be called failed, one below the second must not."""


def measure_people(*, quick: bool, seed: int | None = None) -> list[Metric]:
    """Whole dressed people, ours and trimesh's nricp from the same start; one peer's pair if quick or drawn.

    Args:
        seed: of people who are drawn, in place of those on whom settings were chosen.
    """
    people = [PEOPLE[1], PEOPLE[4]] if quick else [*PEOPLE, *MORE]
    if seed is not None:
        people = list(draw_people(seed))[: 2 if quick else None]
    rows, wrong = [], 0
    peer: list[list[float]] = []
    for number, person in enumerate(people):
        pair = make_pair(person)
        begin = time.process_time()
        result = register_mesh(pair.template, pair.scan, config=MeshRegistrationConfig(units="m"))
        cpu_s = time.process_time() - begin
        correspondence, surface = _errors(pair, result.vertices)
        verdict, stretch = result.quality.verdict, result.quality.numbers["stretch_p99"]
        wrong += _wrong(verdict, correspondence)
        rows.append([1e3 * person.motion_m, correspondence, surface, stretch, cpu_s, verdict == "failed"])
        Console(stderr=True).print(
            f"{person.name}: {result.way}, {verdict}, {correspondence:.1f} mm, surface {surface:.2f}, "
            f"stretch {stretch:.2f}, {cpu_s:.1f} s"
        )
        if number == 0 or (not quick and person in PEOPLE):
            scan = pair.scan
            answer = run_peer(
                "nricp_amberg", result.start, pair.template.faces, scan.vertices.astype(np.float64), scan.faces
            )
            peer.append([*_errors(pair, answer.vertices), answer.cpu_s])
    table, others = np.array(rows, float), np.array(peer)
    more = np.array([person in MORE for person in people])
    metrics = _people_metrics(table[~more], "")
    if more.any():
        metrics += _people_metrics(table[more], "more_")
    return [
        *metrics,
        Metric("wrong_verdicts", float(wrong)),
        Metric("nricp_amberg_correspondence_mean_mm", float(others[:, 0].mean()), "mm"),
        Metric("nricp_amberg_truth_distance_mean_mm", float(others[:, 1].mean()), "mm"),
        Metric("nricp_amberg_cpu_s", float(others[:, 2].mean()), "s"),
    ]


def _people_metrics(table: np.ndarray, prefix: str) -> list[Metric]:
    """Of rows of: motion, correspondence, surface, millimetres; stretch; CPU seconds; whether called failed."""
    far = table[:, 0] > 100
    return [
        Metric(f"{prefix}correspondence_mean_mm", float(table[:, 1].mean()), "mm"),
        Metric(f"{prefix}correspondence_far_mm", float(table[far, 1].mean()), "mm"),
        Metric(f"{prefix}correspondence_max_mm", float(table[:, 1].max()), "mm"),
        Metric(f"{prefix}truth_distance_mean_mm", float(table[:, 2].mean()), "mm"),
        Metric(f"{prefix}stretch_p99_max", float(table[:, 3].max())),
        Metric(f"{prefix}cpu_s", float(table[:, 4].mean()), "s"),
        Metric(f"{prefix}failed_pairs", float(table[:, 5].sum())),
    ]


def _errors(pair: PeoplePair, vertices: np.ndarray) -> tuple[float, float]:
    """Mean correspondence error of what is a piece of the person, and mean distance from the true surface of what the
    scan shows, millimetres."""
    correspondence = correspondence_errors(vertices, pair.places)[pair.known]
    registered = Mesh(vertices.astype(np.float32), pair.template.faces)
    there, _ = truth_distances(registered, pair.truth, covered=pair.covered)
    return float(1e3 * correspondence.mean()), float(1e3 * there.mean())


def measure_borders(*, quick: bool, seed: int | None = None) -> list[Metric]:
    """Shirts with painted borders.

    Args:
        seed: of shirts that are drawn, on people who are drawn, in place of those on which settings were chosen.
    """
    rows, wrong = [], 0
    first = 0 if seed is None else 1000 * (seed + 1)
    for number in range(first, first + (2 if quick else 10)):
        shirt = make_shirt(number, drawn=seed is not None)
        config = MeshRegistrationConfig(border_colour=shirt.paint, units="m")
        begin = time.process_time()
        result = register_mesh(
            shirt.template, shirt.scan, colours=shirt.colours, config=config, find_border=painted_border
        )
        cpu_s, vertices = time.process_time() - begin, result.vertices
        correspondence = float(1e3 * correspondence_errors(vertices, shirt.places).mean())
        surface = 1e3 * truth_distances(Mesh(vertices, shirt.template.faces), shirt.truth)[0]
        border = 1e3 * border_errors({name: vertices[loop] for name, loop in shirt.loops.items()}, shirt.true_borders)
        wrong += _wrong(result.quality.verdict, correspondence)
        failed = result.quality.verdict == "failed"
        rows.append([surface.mean(), border.mean(), np.percentile(border, 95), correspondence, cpu_s, failed])
    table = np.array(rows, float)
    mean = table.mean(axis=0)
    return [
        Metric("truth_distance_mean_mm", float(mean[0]), "mm"),
        Metric("border_mean_mm", float(mean[1]), "mm"),
        Metric("border_p95_mm", float(mean[2]), "mm"),
        Metric("correspondence_mean_mm", float(mean[3]), "mm"),
        Metric("cpu_s", float(mean[4]), "s"),
        Metric("failed_pairs", float(table[:, 5].sum())),
        Metric("wrong_verdicts", float(wrong)),
    ]


def _wrong(verdict: str, correspondence_mm: float) -> bool:
    failed = verdict == "failed"
    return failed != (correspondence_mm > BAD_MM) and not FINE_MM <= correspondence_mm <= BAD_MM


def measure_hopeless(*, quick: bool, seed: int | None = None) -> list[Metric]:
    """Pairs that do not belong together: how many of them are called failed, or refused.

    Args:
        seed: of a person, another and a shirt that are drawn.
    """
    drawn = None if seed is None else draw_people(seed)
    person, other = (make_pair(each) for each in ((PEOPLE[1], PEOPLE[9]) if drawn is None else drawn[1:3]))
    shirt = make_shirt(0) if seed is None else make_shirt(1000 * (seed + 1), drawn=True)
    pairs = {
        "half the size": (person.template, _about(person.scan, 0.5 * np.eye(3))),
        "a shirt for a person": (person.template, shirt.scan),
        "a person for a shirt": (shirt.template, person.scan),
        "a ball": (person.template, _ball(person.scan)),
        "on the head, squeezed": (other.template, _about(other.scan, np.diag([1.6, -0.5, -1.6]))),
    }
    chosen = list(pairs)[:2] if quick else list(pairs)
    told = 0
    for name in chosen:
        template, scan = pairs[name]
        try:
            result: MeshRegistration | None = register_mesh(template, scan, config=MeshRegistrationConfig(units="m"))
        except InputError as error:
            result, reason = None, str(error)
        else:
            reason = "; ".join(result.quality.reasons)
        verdict = "refused" if result is None else result.quality.verdict
        told += verdict in ("failed", "refused")
        Console(stderr=True).print(f"{name}: {verdict}: {reason}")
    return [Metric("told_percent", 100.0 * told / len(chosen), "%", "higher")]


def _about(mesh: Mesh, matrix: np.ndarray) -> Mesh:
    """A mesh, turned and scaled about its middle; mirrors are not made right."""
    middle = mesh.vertices.mean(axis=0)
    return mesh.with_vertices(((mesh.vertices - middle) @ matrix.T + middle).astype(np.float32))


def _ball(mesh: Mesh) -> Mesh:
    """A mesh blown up to a ball of its own size."""
    offset = mesh.vertices - mesh.vertices.mean(axis=0)
    radius = 0.25 * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    length = np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-9)
    return mesh.with_vertices((radius * offset / length).astype(np.float32))
