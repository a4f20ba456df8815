"""Kill `capture4d run` at random moments, run it again, and compare the results with an uninterrupted run."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from benchmarks.metric import Metric
from capture4d.captures.capture import read_capture
from capture4d.files.atomic import read_json

STAGES, TRACKED = ("garment", "registration"), ("garment", "body", "registration")
DELAY_S = 0.5
"""Longer than a frame takes, so that kills fall between frames, into frames, and between stages."""


def run(
    *,
    quick: bool = False,
    capture: Path | None = None,
    kills: int = 10,
    track: bool = False,
    workers: int = 2,
    seed: int = 0,
) -> list[Metric]:
    """Kill `capture4d run` with SIGKILL at random moments of its course; the same command has to finish the work.

    Args:
        quick: three kills instead of ten.
        capture: capture folder to run on; a tiny synthetic one if absent.
        kills: how often, each time on a fresh work folder. The moments are spread over the work, not over time: so many
            files of frames are there, and up to half a second has passed.
        track: track the body as well, which takes most of the time; its digest is compared too.
        workers: processes of the killed run, which die with it.
        seed: of the moments.
    """
    console = Console(stderr=True)
    moments = random.Random(seed)
    trials = min(kills, 3) if quick else kills
    stages, options = (TRACKED, ("--tracked",)) if track else (STAGES, ())
    with tempfile.TemporaryDirectory(prefix="capture4d-resume-") as scratch:
        folder = Path(scratch)
        if capture is None:
            capture = folder / "capture"
            _command("synth", capture, "--preset", "tiny", "--workers", workers)
        frames = len(read_capture(capture).frame_ids)

        _run_to_the_end(capture, folder / "whole", workers, options)
        expected = _digests(folder / "whole", stages)

        same = interrupted = 0
        for trial in range(trials):
            work = folder / "killed"
            share = (trial + moments.random()) / trials
            files, seconds = int(share * len(stages) * frames), moments.uniform(0.0, DELAY_S)
            alive = _kill_after(files, seconds, capture, work, workers, options)
            done = _frames_done(work)
            _run_to_the_end(capture, work, workers, options)
            found = _digests(work, stages)
            same += found == expected
            interrupted += alive
            console.print(
                f"kill {trial}: after {done} of {len(stages) * frames} frames, same digests: {found == expected}"
            )
            shutil.rmtree(work)
    return [
        Metric("kills", interrupted, "runs", "higher"),
        Metric("same_digest_share", same / trials, "", "higher"),
    ]


def _arguments(*words: object) -> list[str]:
    return [sys.executable, "-m", "capture4d", *map(str, words)]


def _command(*words: object) -> None:
    subprocess.run(_arguments(*words), check=True, stdout=subprocess.DEVNULL)


def _run_to_the_end(capture: Path, work: Path, workers: int, options: Sequence[str]) -> None:
    _command("run", capture, "--output", work, "--workers", workers, "--max-failed", 100, *options)


def _kill_after(files: int, seconds: float, capture: Path, work: Path, workers: int, options: Sequence[str]) -> bool:
    """Start a run and kill it, and only it, a time after it has written so many frames; whether it was at work."""
    process = subprocess.Popen(
        _arguments("run", capture, "--output", work, "--workers", workers, *options),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while process.poll() is None and _frames_done(work) < files:
        time.sleep(0.005)
    try:
        process.wait(timeout=seconds)
    except subprocess.TimeoutExpired:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        return True
    return False


def _frames_done(work: Path) -> int:
    return len(list(work.glob("*/frames/*.npz")))


def _digests(work: Path, stages: Sequence[str]) -> list[str]:
    return [read_json(work / stage / "stage.json")["digest"] for stage in stages]
