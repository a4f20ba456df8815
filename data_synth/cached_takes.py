"""Synthetic takes that tests and benchmarks share: made once, kept in the user's cache folder."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

from capture4d.cache import user_cache_folder
from data_synth.config import SynthConfig
from data_synth.stage import SCHEMA, run

__all__ = ["cached_take"]


def cached_take(config: SynthConfig, *, workers: int = 2) -> Path:
    """The capture folder of a configuration; simulated and scanned if this machine has not done so before."""
    key = hashlib.sha256(json.dumps([SCHEMA, asdict(config)], sort_keys=True).encode()).hexdigest()[:12]
    folder = user_cache_folder() / "takes" / f"{config.name}-{key}"
    run(folder, config, workers=workers)
    return folder
