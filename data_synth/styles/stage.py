"""Style sets as files: every pair at rest in the A-pose, then prototypes and test pairs in many poses.

OUTPUT/round-1, round-2       garments in the A-pose that the space of styles is found from, if there is one
OUTPUT/canonical/NNNNNN.npz   a pair in the A-pose; the unit that resumes
OUTPUT/canonical.npz          all of them
OUTPUT/pairs/NAME             a set of drapes, as `synth-drapes` makes one, of each prototype and each test pair
OUTPUT/styles.json            ranges, pairs, and how well convex combinations of the prototypes fit all others

What reads them: `capture4d.captures.drapes.style_sets`.

References: TailorNet (CVPR 2020), section 5. Drapes are made one by one, not along a walk through the poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from capture4d.body.anny import load_anny
from capture4d.body.binding import bind, embedded_offset
from capture4d.body.skinning import with_pose, with_shape
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import write_json, write_npz
from capture4d.runs.stage import Stage, StageResult, open_stage
from capture4d.runs.workers import run_jobs
from capture4d.types import Body, Garment, Mesh
from data_synth.drapes.config import DrapesConfig
from data_synth.drapes.draping import Draper, symmetric_person
from data_synth.drapes.dressing import base_garment
from data_synth.drapes.stage import run as drape_set
from data_synth.styles.config import StyleSetConfig
from data_synth.styles.pairs import (
    Pair,
    choose_prototypes,
    draw_test_pairs,
    grid,
    offered,
    ranges_of,
    require_possible,
)
from data_synth.styles.style_space import StyleSpace, subspace_cosines, two_rounds

__all__ = ["run"]

SCHEMA = 3
FOLDER = "canonical"


@dataclass(frozen=True, slots=True)
class _Job:
    """A pair to be brought to rest in the A-pose."""

    stage: Stage
    config: DrapesConfig
    number: int
    folder: str


@dataclass(frozen=True, slots=True)
class _Chosen:
    """A pair that is draped in poses: its name, role, and number among the A-poses, from 0."""

    name: str
    role: str
    canonical: int


def run(output: Path, config: StyleSetConfig, *, workers: int = 1, overwrite: bool = False) -> StageResult:
    """Make what is missing of a style set; `failed` are the drapes that are pruned, counted through all pairs.

    Raises:
        InputError: the settings ask for what there is not, or the folder holds something else.
    """
    require_possible(config)
    body = load_anny()
    stage = open_stage(output, name="synth-styles", schema=SCHEMA, config=config, upstream={}, overwrite=overwrite)
    cut = partial(_config_of, config)
    space, rounds = _found_space(stage, config, body, workers) if config.components else (None, [])
    if space is not None:
        cut = partial(_config_of, config, space=space)
        config = offered(config, space.names)
    pairs = grid(config)
    vertices, faces = _at_rest(stage, [cut(pair) for pair in pairs], body, workers)
    prototypes, errors = choose_prototypes(
        _displacements(pairs, vertices, faces, body), config.prototypes, config.start, len(config.shapes)
    )
    tested, off_grid = draw_test_pairs(config, pairs, prototypes, np.random.default_rng([config.seed, 7]))
    every = [*pairs, *off_grid]
    vertices, faces = _at_rest(stage, [cut(pair) for pair in every], body, workers)
    chosen = [
        *(_Chosen(f"prototype-{k:02d}", "prototype", each) for k, each in enumerate(prototypes, 1)),
        *(
            _Chosen(f"test-{k:02d}", "test", each)
            for k, each in enumerate([*tested, *range(len(pairs), len(every))], 1)
        ),
    ]
    sets = [_drape(output, config, cut(every[each.canonical]), each, workers) for each in chosen]
    test = np.zeros(len(every), bool)
    test[[each.canonical for each in chosen if each.role == "test"]] = True
    write_npz(
        output / "canonical.npz",
        styles=np.array([pair.style for pair in every], np.float64),
        shapes=np.array([pair.shape for pair in every], np.float64),
        vertices=vertices,
        faces=faces,
        test=test,
    )
    about = _described(config, chosen, every, errors, [each.digest for each in sets])
    write_json(output / "styles.json", about | ({"style_space": _space_told(space, rounds)} if space else {}))
    failed, before = {}, 0
    for each, result in zip(chosen, sets, strict=True):
        failed |= {before + number: f"{each.name}: {why}" for number, why in result.failed.items()}
        before += result.frames
    return stage.finish([output / "styles.json", output / "canonical.npz"], frames=before, failed=failed)


def _found_space(stage: Stage, config: StyleSetConfig, body: Body, workers: int) -> tuple[StyleSpace, list[StyleSpace]]:
    """Components of the style, and what each of two rounds of draping found."""
    folders = iter(("round-1", "round-2"))

    def drape(cuts: Sequence[Mapping[str, float]]) -> np.ndarray:
        wanted = [_config_of(config, Pair(tuple(cut.values()), ())) for cut in cuts]
        return _at_rest(stage, wanted, body, workers, folder=next(folders))[0].astype(np.float64)

    rng = np.random.default_rng([config.seed, 31])
    rounds = two_rounds(ranges_of(config)[0], config.drawn, rng, drape)
    return rounds[-1], [*rounds]


def _config_of(config: StyleSetConfig, pair: Pair, *, space: StyleSpace | None = None) -> DrapesConfig:
    """Settings of a pair in the A-pose."""
    return DrapesConfig(
        garment=config.garment,
        samples=1,
        seed=config.seed,
        style=pair.style_texts(config, space),
        beta=pair.shape,
        vertices=config.vertices,
        validation=0.0,
        test=0.0,
        poses=config.pose,
        solver=config.solver,
    )


def _at_rest(
    stage: Stage, cuts: Sequence[DrapesConfig], body: Body, workers: int, *, folder: str = FOLDER
) -> tuple[Float32[np.ndarray, "pairs verts 3"], np.ndarray]:
    """Garments in the A-pose, metres, and their faces; what is not there yet is made."""
    jobs = [_Job(stage, cut, number, folder) for number, cut in enumerate(cuts, 1)]
    pending = set(stage.pending([job.number for job in jobs], folder=folder))
    if pending:  # before there are workers: what the machine's first shirt needs is simulated once
        mean = symmetric_person(with_shape(body, np.zeros(0)))
        base_garment(cuts[0].garment, mean, cuts[0].vertices, cuts[0].garment_seed)
    lost = [job for job in jobs if job.number in pending]
    for _ in run_jobs(_bring_to_rest, lost, prepare=load_anny, workers=workers, label="A-pose"):
        pass
    vertices, faces = [], np.zeros((0, 3), np.int32)
    for job in jobs:
        with ArrayFile(stage.frame_path(job.number, folder=folder)) as arrays:
            vertices.append(arrays["vertices"])
            faces = arrays["faces"]
    return np.stack(vertices), faces


def _bring_to_rest(body: Body, job: _Job) -> None:
    """Drape a pair in the A-pose, which is the body's rest pose."""
    draper = Draper(job.config, body)
    drape = draper.drape(np.repeat(np.eye(3)[None], len(body.joint_names), axis=0))
    write_npz(
        job.stage.frame_path(job.number, folder=job.folder),
        vertices=drape.vertices.astype(np.float32),
        faces=draper.mesh.faces.astype(np.int32),
    )


def _displacements(
    pairs: Sequence[Pair], vertices: Float32[np.ndarray, "pairs verts 3"], faces: np.ndarray, body: Body
) -> Float32[np.ndarray, "pairs verts 3"]:
    """Of each garment over the skin of the person in it, up to what is the same for all, metres.

    The skin under a vertex is where the first pair has it, on whomever.
    """
    mean = with_shape(body, np.zeros(0))
    identity = np.repeat(np.eye(3)[None], len(body.joint_names), axis=0)
    under, barycentric, _ = bind(vertices[0], faces, with_pose(mean, identity, np.zeros(3)))
    garment = Garment(Mesh(vertices[0], faces), embedding_faces=under, embedding_barycentric=barycentric)
    moved = {
        shape: embedded_offset(garment, body, with_shape(body, np.array(shape)).vertices - mean.vertices)
        for shape in {pair.shape for pair in pairs}
    }
    return (vertices - np.stack([moved[pair.shape] for pair in pairs])).astype(np.float32)


def _drape(output: Path, config: StyleSetConfig, cut: DrapesConfig, chosen: _Chosen, workers: int) -> StageResult:
    """The set of drapes of a pair: the unseen poses have the first numbers."""
    samples = config.unseen_poses + (config.poses if chosen.role == "prototype" else config.seen_poses)
    settings = replace(cut, samples=samples, shard=min(64, samples))
    return drape_set(output / "pairs" / chosen.name, settings, workers=workers)


def _described(
    config: StyleSetConfig,
    chosen: Sequence[_Chosen],
    pairs: Sequence[Pair],
    errors: Sequence[tuple[float, float]],
    digests: Sequence[str],
) -> dict[str, Any]:
    """What styles.json says."""
    styles, shapes = ranges_of(config)
    first = 1 if config.start == "one" else min(len(config.shapes), config.prototypes)
    return {
        "garment": config.garment,
        "style_ranges": styles,
        "shape_ranges": shapes,
        "unseen_poses": config.unseen_poses,
        "pairs": {
            each.name: {
                "role": each.role,
                "canonical": each.canonical,
                "style": dict(zip(config.styles, pairs[each.canonical].style, strict=True)),
                "shape": pairs[each.canonical].shape,
                "digest": digest,
            }
            for each, digest in zip(chosen, digests, strict=True)
        },
        "convex_fits_mm": [
            {"prototypes": first + k, "worst": 1e3 * worst, "mean": 1e3 * mean}
            for k, (worst, mean) in enumerate(errors)
        ],
    }


def _space_told(space: StyleSpace, rounds: Sequence[StyleSpace]) -> dict[str, Any]:
    """What styles.json says of the components: the pattern of each point, and how well the rounds agree."""
    return {
        "components": [
            {
                "name": name,
                "explained": float(share),
                "deviation_m": float(deviation),
                "slopes": dict(zip(space.numbers, slopes.tolist(), strict=True)),
            }
            for name, share, deviation, slopes in zip(
                space.names, space.explained, space.deviations, space.slopes, strict=True
            )
        ],
        "middle": dict(zip(space.numbers, space.middle.tolist(), strict=True)),
        "limits": dict(zip(space.numbers, space.ranges.tolist(), strict=True)),
        "cosines": subspace_cosines(rounds[0].directions, rounds[-1].directions).tolist(),
    }
