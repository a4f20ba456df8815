"""Synthetic takes that tests and benchmarks share: made once, kept in the user's cache folder.

Several may run at once: whoever needs what another is making waits for it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from capture4d.cache import user_cache_folder
from capture4d.runs.locks import alone
from data_synth import training_set
from data_synth.config import SynthConfig, TrainingSetConfig
from data_synth.stage import SCHEMA, run

__all__ = ["cached_take", "cached_training_set", "one_maker"]


def cached_take(config: SynthConfig, *, workers: int = 2) -> Path:
    """The capture folder of a configuration; simulated and scanned if this machine has not done so before."""
    folder = _folder(config, SCHEMA)
    with one_maker(folder):
        run(folder, config, workers=workers)
    return folder


def cached_training_set(config: TrainingSetConfig, *, workers: int = 2) -> Path:
    """The folder of a training set; what this machine has not made before is made."""
    folder = _folder(config, training_set.SCHEMA)
    with one_maker(folder):
        training_set.run(folder, config, workers=workers)
    return folder


@contextlib.contextmanager
def one_maker(folder: Path) -> Iterator[None]:
    """Nobody else makes what is kept in a folder of the cache meanwhile."""
    with alone(folder, folder=False, wait=True):
        yield


def _folder(config: SynthConfig | TrainingSetConfig, schema: int) -> Path:
    known = json.dumps([schema, asdict(config)], sort_keys=True)
    # Takes were made, and are kept, before there were prints and other garments.
    for later in ("print", "print_mm", "garment", "cut", "skirt_weights"):
        known = known.replace(f', "{later}": null', "")
    key = hashlib.sha256(known.encode()).hexdigest()[:12]
    return user_cache_folder() / "takes" / f"{config.name}-{key}"
