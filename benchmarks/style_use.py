"""What stands around a garment with styles: prototypes of its pool, live frames, and styles found again.

A number of style or shape counts in sigma: of a shape that is its unit, of a style two thirds of half its range, as
ranges are 1.5 sigma either way.
"""

from __future__ import annotations

import time

import numpy as np

from benchmarks.metric import Metric
from capture4d.body.limbs import WornBody
from capture4d.body.skinning import skin, with_pose
from capture4d.captures.drapes.style_sets import Ranges
from capture4d.geometry.intersection_removal import Penetration
from capture4d.learning.convex_fits import furthest_first
from capture4d.types import Mesh
from data_synth.drapes.config import DrapesConfig
from data_synth.drapes.draping import Draper
from data_synth.styles.config import StyleSetConfig
from retarget.mixture.lesson import PairDrapes, StyleLesson
from retarget.mixture.style_fit import SeenFrame, fit_style
from retarget.mixture.styled_garment import StyledGarment

__all__ = ["fit_metrics", "frame_metrics", "prototype_metrics", "solver_metrics"]

STYLE_SIGMAS = 1.5
NOISE_M, MISSING = 0.001, 0.25
"""Of what stands for a scan: noise of each point, and the share of faces that nobody saw, in patches."""
TRACKED_OFF = 0.2
"""Of a tracked person's shape, sigma."""
STILL = np.zeros(3)
PROTOTYPES, DRAWS = 12, 5
"""At most, or half of a small pool; random choices to beat."""


def frame_metrics(garment: StyledGarment, lesson: StyleLesson, *, frames: int = 8) -> list[Metric]:
    """Milliseconds of a frame from pose, shape and style, live and exact, on one core; and what is left inside."""
    live, exact, left = [], [], []
    for pair in _test_pairs(lesson)[:2]:
        style, beta = garment.ranges.values(pair.numbers)
        worn = garment.worn(beta, style)
        weights = garment.garment.skin_weights
        assert weights is not None
        body = WornBody(worn.person, worn.in_a_pose, weights)
        rows = np.flatnonzero(pair.unseen)[:frames]
        worn.live(pair.rotations[rows[0]], STILL)  # compiles
        for row in rows:
            rotations = pair.rotations[row].astype(np.float64)
            begun = time.process_time()
            vertices = worn.live(rotations, STILL)
            live.append(time.process_time() - begun)
            begun = time.process_time()
            worn.outside(rotations, STILL)
            exact.append(time.process_time() - begun)
            surface = body.posed(with_pose(worn.person, rotations, STILL).vertices())
            left.append(Penetration.of(surface.contacts(vertices)).inside_percent)
    return [
        Metric("frame_ms", 1e3 * float(np.median(live)), "ms"),
        Metric("frame_exact_ms", 1e3 * float(np.median(exact)), "ms"),
        Metric("frame_inside_percent", float(np.mean(left)), "%"),
    ]


def solver_metrics(config: StyleSetConfig, lesson: StyleLesson, *, drapes: int = 3) -> list[Metric]:
    """Milliseconds of a drape as the solver makes it, on one core, of the same mesh in the same poses: what `frame_ms`
    takes the place of. The pattern's own style, on the mean person, who is dressed before."""
    cut = DrapesConfig(
        garment=config.garment, vertices=config.vertices, seed=config.seed, poses=config.pose, solver=config.solver
    )
    pair = _test_pairs(lesson)[0]
    draper, took = Draper(cut, pair.person.body), []
    for row in np.flatnonzero(pair.unseen)[:drapes]:
        begun = time.process_time()
        draper.drape(pair.rotations[row].astype(np.float64))
        took.append(time.process_time() - begun)
    return [Metric("drape_ms", 1e3 * float(np.median(took)), "ms")]


def fit_metrics(garment: StyledGarment, lesson: StyleLesson, *, frames: int = 3) -> list[Metric]:
    """Mean error of a component, in sigma, from one registered frame and from one scan of an unseen pair.

    Where nobody knows the person, all components together, those of style and those of shape; and all of them where the
    person was tracked, and is off by 0.2 sigma in each component.
    """
    errors: dict[str, list[float]] = {}
    seconds, scale, styles = [], _sigmas(garment.ranges), len(garment.ranges.style)
    for index, pair in enumerate(_test_pairs(lesson)):
        rng = np.random.default_rng([17, index])
        for row in np.flatnonzero(pair.unseen)[:frames]:
            transforms = with_pose(pair.person, pair.rotations[row], STILL).transforms
            vertices = skin(pair.unposed[row].astype(np.float64), lesson.skin_weights, transforms)
            seen = _seen(garment, pair, int(row), vertices)
            for name, frame in (("registered", seen), ("scan", _scanned(garment, seen, rng))):
                begun = time.process_time()
                off = scale * np.abs(fit_style(garment, [frame]).numbers - pair.numbers)
                seconds.append(time.process_time() - begun)
                errors.setdefault(f"fit_{name}_sigma", []).append(float(off.mean()))
                errors.setdefault(f"fit_{name}_style_sigma", []).append(float(off[:styles].mean()))
                errors.setdefault(f"fit_{name}_shape_sigma", []).append(float(off[styles:].mean()))
                shape = garment.ranges.values(pair.numbers)[1]
                tracked = np.asarray(shape) + TRACKED_OFF * rng.standard_normal(len(shape))
                off = scale * np.abs(fit_style(garment, [frame], shape=tracked).numbers - pair.numbers)
                errors.setdefault(f"fit_{name}_tracked_sigma", []).append(float(off.mean()))
    return [
        *(Metric(key, float(np.mean(found))) for key, found in errors.items()),
        Metric("fit_style_s", float(np.mean(seconds)), "s"),
    ]


def prototype_metrics(lesson: StyleLesson) -> list[Metric]:
    """Mean vertex error, in the A-pose, of convex combinations of prototypes: chosen as the set chooses them, beginning
    with one style on everybody as in the paper, and at random."""
    pool, styles = lesson.pool, len(lesson.ranges.style)
    count = min(PROTOTYPES, len(pool) // 2)
    middle = np.linalg.norm(lesson.pool_numbers[:, :styles], axis=1)
    everybody = np.flatnonzero(middle < middle.min() + 1e-9)[:count]
    central = int(np.argmin(np.linalg.norm(lesson.pool_numbers, axis=1)))
    rows, rng = pool.reshape(len(pool), -1), np.random.default_rng(5)

    def mean_mm(start: np.ndarray) -> float:
        return 1e3 * furthest_first(rows, [int(each) for each in start], count, _apart)[1][-1][1]

    drawn = [mean_mm(rng.choice(len(pool), count, replace=False)) for _ in range(DRAWS)]
    return [
        Metric("prototypes", count, "", "higher"),
        Metric("convex_fit_mm", mean_mm(np.array([central])), "mm"),
        Metric("convex_fit_paper_mm", mean_mm(everybody), "mm"),
        Metric("convex_fit_random_mm", float(np.mean(drawn)), "mm"),
    ]


def _apart(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm((one - other).reshape(-1, 3), axis=1).mean())


def _test_pairs(lesson: StyleLesson) -> list[PairDrapes]:
    return [pair for pair in lesson.pairs if pair.test and pair.unseen.any()]


def _sigmas(ranges: Ranges) -> np.ndarray:
    """Of each number, from -1 to 1, how many sigma a unit is."""
    shapes = [(high - low) / 2 for low, high in ranges.shape if low < high]
    return np.array([STYLE_SIGMAS] * len(ranges.style) + shapes)


def _seen(garment: StyledGarment, pair: PairDrapes, row: int, vertices: np.ndarray) -> SeenFrame:
    loops = garment.garment.loops
    points = np.concatenate([np.zeros((0, 3)), *(vertices[loop] for loop in loops.values())])
    return SeenFrame(
        pair.rotations[row], STILL, Mesh(vertices.astype(np.float32), garment.garment.template.faces), True,
        points.astype(np.float32), tuple(name for name, loop in loops.items() for _ in loop),
    )  # fmt: skip


def _scanned(garment: StyledGarment, seen: SeenFrame, rng: np.random.Generator) -> SeenFrame:
    """The same with other vertices, noise, and patches that nobody saw."""
    mesh = seen.mesh
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    centres = middles[rng.choice(len(middles), 6, replace=False)]
    near = np.linalg.norm(middles[:, None] - centres, axis=2).min(axis=1)
    faces = mesh.faces[near > np.quantile(near, MISSING)]
    points = mesh.vertices + NOISE_M * rng.standard_normal(mesh.vertices.shape)
    border = seen.border_points + NOISE_M * rng.standard_normal(seen.border_points.shape)
    return SeenFrame(
        seen.rotations, seen.translation, Mesh(points.astype(np.float32), faces), False, border.astype(np.float32),
        seen.border_names,
    )  # fmt: skip
