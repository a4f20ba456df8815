"""The stage that trains the wrinkle GAN: pairs of one or more work folders in, a MODEL folder out.

stage.json                 what was run
generator.safetensors      the weights, with what is needed to rebuild the network
checkpoints/000500.safetensors   everything a resume needs; the last two are kept
metrics.jsonl              losses, one line every `log_every` steps
samples/000500.png         held-out frames: input, made, true
held_out.json              measures on the held-out frames: of the maps made, and of the low maps
takes.json                 digests of the registrations it learned from
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from capture4d.captures.work_folder import WorkFolder
from capture4d.errors import InputError
from capture4d.files.atomic import nan_to_none, read_json, read_json_lines, write_bytes, write_json, write_json_lines
from capture4d.geometry.uv_layout import millimetres_per_texel
from capture4d.runs.progress import progress
from capture4d.runs.stage import Stage, StageResult, open_stage
from capture4d.types import Mesh
from wrinkles.normal_maps.config import MapConfig, PairConfig, WrinkleConfig
from wrinkles.normal_maps.inference import WrinkleModel, answer, save_model
from wrinkles.normal_maps.maps_stage import ensure_pairs
from wrinkles.normal_maps.maps_stage import run as make_pairs
from wrinkles.normal_maps.metrics import MapScores, score
from wrinkles.normal_maps.pair_files import PairFolder, open_pairs, surface_texels
from wrinkles.normal_maps.pairs import PairTake, batches, consecutive_pairs, split, unfit
from wrinkles.normal_maps.spaces import to_colours
from wrinkles.normal_maps.training import TrainingState, load_state, new_state, save_state, train_step

__all__ = ["learned_takes", "run", "score_take"]

SCHEMA = 1
TAKES = "takes.json"
KEPT_CHECKPOINTS = 2
SAMPLES = 4


def run(
    works: Sequence[WorkFolder],
    output: Path,
    config: WrinkleConfig,
    *,
    pairs: PairConfig | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> StageResult:
    """Make the pairs that are missing, train, measure.

    Pairs that are there are used as they are, unless `pairs` asks for other than the default.

    Equal inputs, settings and numbers of `workers`, which are torch's threads here, give equal weights, however often
    the run was interrupted.

    Raises:
        InputError: no or differing takes, or a checkpoint of another architecture.
    """
    if not works:
        raise InputError("wrinkles train: expected at least one work folder, found none")
    if len({work.path.resolve().name for work in works}) < len(works):
        raise InputError("wrinkles train: expected work folders of different names, found two alike")
    folders = [_pairs(work, pairs, config.texels, workers=workers) for work in works]
    first, *others = folders
    for folder in others:
        if folder.layout_digest != first.layout_digest:
            raise InputError(f"expected the UV layout of {first.work}, found another; one network needs one layout",
                             where=folder.work)  # fmt: skip
    takes = [folder.read(config.texels) for folder in folders]
    parts = [split(take, held_out=config.held_out, gap=config.held_out_gap) for take in takes]
    consecutive_pairs([train for train, _ in parts])
    torch.set_num_threads(workers)
    state = new_state(config)
    stage = open_stage(
        output, name="wrinkles train", schema=SCHEMA, config=config,
        upstream={folder.work.resolve().name: folder.digest for folder in folders},
        sources={folder.work.resolve().name: folder.work for folder in folders}, overwrite=overwrite,
    )  # fmt: skip
    weights, measures = stage.path / "generator.safetensors", stage.path / "held_out.json"
    if stage.was_complete and weights.is_file() and measures.is_file():
        return stage.finish([weights], changed=False)
    write_json(stage.path / TAKES, {folder.work.resolve().name: folder.registration for folder in folders})
    recent = _resume(stage, state)
    _train(stage, state, recent, [train for train, _ in parts], [held for _, held in parts], config)
    model = WrinkleModel(
        state.generator, config.network, texels=config.texels, crop=config.crop, maps=first.maps,
        layout_digest=first.layout_digest, template=first.template,
    )  # fmt: skip
    save_model(weights, model)
    measured = {}
    for _, held in parts:
        if len(held.frame_ids):
            made, low = score_take(model, held, first.template)
            measured[held.name] = {"made": _json(made), "low": _json(low)}
    write_json(measures, measured)
    return stage.finish([weights])


def _pairs(work: WorkFolder, config: PairConfig | None, texels: int, *, workers: int) -> PairFolder:
    """As they are if they are there, unless other settings than the default are asked for; made large enough if not.

    Raises:
        InputError: halved, they are not of `texels` texels.
    """
    if config is None or config == PairConfig():
        folder = ensure_pairs(work, PairConfig(map=large_enough(texels)), workers=workers)
        problem = unfit(texels, folder.maps.size)
        if problem is not None:
            remade = f"capture4d wrinkles maps {work.path} --texels {large_enough(texels).size} --overwrite"
            raise InputError(f"{problem}; run: {remade}", where=folder.path)
        return folder
    problem = unfit(texels, config.map.size)
    if problem is not None:
        raise InputError(f"pairs.map.size: {problem}")
    make_pairs(work, config, workers=workers)
    return open_pairs(work.path)


def large_enough(texels: int) -> MapConfig:
    """Maps of which a network of `texels` can be taught: the default's size, or more."""
    size = texels
    while size < MapConfig().size:
        size *= 2
    return MapConfig().sized(size)


def learned_takes(model: Path) -> set[str]:
    """Digests of the registrations that a trained network learned from."""
    path = model / TAKES
    return set(read_json(path).values()) if path.is_file() else set()


def score_take(model: WrinkleModel, take: PairTake, mesh: Mesh) -> tuple[MapScores, MapScores]:
    """Measures of generated maps, and of their inputs, against the high maps of a take, where they show the surface.

    Args:
        mesh: the template, its UVs as the maps have them.
    """
    known = take.valid & surface_texels(mesh, model.maps.size, model.texels)
    mm_per_texel = millimetres_per_texel(mesh, model.texels)
    made = torch.stack([model.generate(low.float()) for low in take.low])
    truth, consecutive = take.high.float(), torch.zeros(len(made), dtype=torch.bool)
    consecutive[torch.from_numpy(take.consecutive())] = True

    def against_truth(maps: torch.Tensor) -> MapScores:
        return score(maps, truth, known, mm_per_texel=mm_per_texel, consecutive=consecutive)

    return against_truth(made), against_truth(take.low.float())


def _train(
    stage: Stage,
    state: TrainingState,
    recent: list[dict[str, float]],
    train: list[PairTake],
    held: list[PairTake],
    config: WrinkleConfig,
) -> None:
    """Go on to the last step.

    Args:
        recent: losses since the last row of the log.
    """
    schedule = config.schedule
    rows = _logged(stage.path / "metrics.jsonl", state.step)
    stream = batches(train, size=schedule.batch, seed=config.seed, start=state.step, crop=config.crop)
    saved = time.monotonic()
    with progress("train", schedule.steps, completed=state.step) as advance:
        while state.step < schedule.steps:
            recent.append(train_step(state, next(stream), config))
            advance(1)
            last = state.step == schedule.steps
            if state.step % schedule.log_every == 0 or last:
                mean = {name: float(np.mean([losses[name] for losses in recent])) for name in sorted(recent[0])}
                rows.append({"step": state.step, **mean})
                recent.clear()
            if state.step % schedule.sample_every == 0 or last:
                _write_samples(stage, state, held, config)
            late = time.monotonic() - saved >= schedule.checkpoint_s
            if state.step % schedule.checkpoint_every == 0 or late or last:
                _write_log(stage.path / "metrics.jsonl", rows)
                _save(stage, state, recent)
                saved = time.monotonic()


def _checkpoint(stage: Stage, step: int) -> Path:
    return stage.path / "checkpoints" / f"{step:06d}.safetensors"


def _checkpoints(stage: Stage) -> list[Path]:
    """The oldest first."""
    paths = (path for path in (stage.path / "checkpoints").glob("*.safetensors") if path.stem.isdigit())
    return sorted(paths, key=lambda path: int(path.stem))


def _save(stage: Stage, state: TrainingState, recent: Sequence[Mapping[str, float]]) -> None:
    save_state(_checkpoint(stage, state.step), state, recent)
    for old in _checkpoints(stage)[:-KEPT_CHECKPOINTS]:
        old.unlink()


def _resume(stage: Stage, state: TrainingState) -> list[dict[str, float]]:
    """Go on from the newest checkpoint, if there is one; the losses that it had not logged yet."""
    paths = _checkpoints(stage)
    return load_state(paths[-1], state) if paths else []


def _logged(path: Path, step: int) -> list[dict[str, float]]:
    """Rows up to a step; what was logged after the last checkpoint is done again."""
    if not path.is_file():
        return []
    return [row for row in read_json_lines(path) if row.get("step", step + 1) <= step]


def _write_log(path: Path, rows: Sequence[dict[str, float]]) -> None:
    write_json_lines(path, map(nan_to_none, rows))


def _write_samples(stage: Stage, state: TrainingState, held: list[PairTake], config: WrinkleConfig) -> None:
    """A sheet of held-out frames, a row each: input, made, true. Leaves the random state as it was."""
    frames = [(take, at) for take in held for at in range(len(take.frame_ids))]
    if not frames:
        return
    chosen = [frames[int(at)] for at in np.linspace(0, len(frames) - 1, min(SAMPLES, len(frames)))]
    random = torch.get_rng_state()
    state.generator.eval()
    rows = []
    with torch.inference_mode():
        for take, at in chosen:
            low = take.low[at].float()
            made = answer(state.generator, low[None], low[None], crop=config.crop)[0] * (low != 0).any(dim=0)
            row = torch.cat([low, made, take.high[at].float()], dim=2)
            rows.append(to_colours(row.permute(1, 2, 0).numpy()))
    torch.set_rng_state(random)
    write_bytes(stage.path / "samples" / f"{state.step:06d}.png", _png(np.concatenate(rows)))


def _png(picture: np.ndarray) -> bytes:
    import cv2

    good, data = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
    assert good
    return data.tobytes()


def _json(scores: MapScores) -> dict[str, float | None]:
    return nan_to_none(asdict(scores))
