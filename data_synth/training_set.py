"""Many takes of one subject in one garment, to learn from, and the same motions on other people, as truth.

OUTPUT/takes/NAME          capture folders; every one brings the same template
OUTPUT/bodies/WHO/NAME     the held-out clips on other people, in the same garment graded to them; no scans
OUTPUT/set.json            which clips are held out, which run backwards, who the other people are

Clips are simulated in parallel, then all frames of all takes are scanned in parallel. Every take is a stage of its own
and resumes as one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from capture4d.files.atomic import write_bytes, write_json
from capture4d.runs.stage import Stage, StageResult, open_stage
from capture4d.runs.workers import run_jobs
from data_synth.config import SynthConfig, TrainingSetConfig
from data_synth.stage import (
    ScanJob,
    Scene,
    finish_take,
    is_whole,
    open_scene,
    open_take,
    scan_frame,
    scan_jobs,
    simulate_clip,
    simulated_frames,
    simulation_jobs,
)

__all__ = ["body_takes", "run"]

SCHEMA = 1


def run(output: Path, config: TrainingSetConfig, *, workers: int = 2, overwrite: bool = False) -> StageResult:
    """Make what is missing of a training set.

    Raises:
        InputError: the folder holds something else.
    """
    stage = open_stage(output, name="training-set", schema=SCHEMA, config=config, upstream={}, overwrite=overwrite)
    wanted = {f"takes/{name}": take for name, take in config.takes.items()}
    wanted |= {
        f"bodies/{who}/{name}": take for who, takes in body_takes(config).items() for name, take in takes.items()
    }
    folders = {name: replace(stage, path=output / name) for name in wanted}
    if (output / "set.json").is_file() and all(is_whole(folders[name], take) for name, take in wanted.items()):
        return stage.finish([output / "set.json"])
    takes = {name: (open_take(output / name, take), take) for name, take in wanted.items()}
    simulations = [job for each in takes.values() for job in simulation_jobs(*each)]
    simulated = [job.stage for job in simulations]
    for _ in run_jobs(
        simulate_clip, simulations, workers=workers, label="simulate clips", units=lambda job: job.config.frames,
        finished=lambda: sum(map(simulated_frames, simulated)),
    ):  # fmt: skip
        pass
    scans = [job for each in takes.values() for job in scan_jobs(*each)]
    for _ in run_jobs(_scan, scans, prepare=_Scenes, workers=workers, label="scan"):
        pass
    digests = {name: _finish(output, config, *each).digest for name, each in takes.items()}
    note = {"held_out": config.held_out, "reversed": config.reversed, "bodies": config.bodies, "digests": digests}
    write_json(output / "set.json", note)
    return stage.finish([output / "set.json"])


def body_takes(config: TrainingSetConfig) -> Mapping[str, Mapping[str, SynthConfig]]:
    """The held-out clips on other people, by person and clip."""
    return {
        who: {
            name: replace(
                config.takes[name],
                name=f"{config.takes[name].name}-{who}",
                body_shape=shape,
                drafted_for=config.takes[name].body_shape,
                scans=False,
            )
            for name in config.held_out
        }
        for who, shape in config.bodies.items()
    }


class _Scenes:
    """The scene of the take that a process is at: jobs come take by take, and a scene is too large to keep them all."""

    def __init__(self) -> None:
        self._path: Path | None = None
        self._scene: Scene | None = None

    def of(self, job: ScanJob) -> Scene:
        if self._scene is None or self._path != job.stage.path:
            self._path, self._scene = job.stage.path, open_scene(job.stage, job.config)
        return self._scene


def _scan(scenes: _Scenes, job: ScanJob) -> int:
    return scan_frame(scenes.of(job), job)


def _finish(output: Path, config: TrainingSetConfig, stage: Stage, take: SynthConfig) -> StageResult:
    """Close a take, with the template of the first: a lab makes one, and registers it to every take."""
    first = output / "takes" / next(iter(config.takes)) / "template.npz"
    if take.drafted_for is None:
        write_bytes(stage.path / "template.npz", first.read_bytes())
    return finish_take(stage, take)
