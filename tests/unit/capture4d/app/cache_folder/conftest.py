"""Cache folders with something in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from capture4d.files.atomic import write_json
from capture4d.runs.stage import SCHEMAS
from data_synth.config import PRESETS

TAKE, OLD_TAKE = "takes/tiny-0123456789ab", "takes/tiny-ba9876543210"
Record = Callable[..., Path]


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache"


@pytest.fixture
def record(cache: Path) -> Record:
    """Write a stage.json below the cache folder, of this version unless it is told otherwise."""

    def write(place: str, stage: str = "synth", *, config: Any = None, **said: Any) -> Path:
        folder = cache / place
        given = asdict(PRESETS["tiny"]) if config is None else config
        write_json(folder / "stage.json", {"stage": stage, "schema": SCHEMAS[stage], "config": given, **said})
        return folder

    return write


@pytest.fixture
def filled(cache: Path, record: Record) -> Path:
    """Two takes, one of them old, and what was made from each."""
    for size, take, schema in ((1000, TAKE, SCHEMAS["synth"]), (2000, OLD_TAKE, SCHEMAS["synth"] - 1)):
        folder = record(take, schema=schema)
        (folder / "scan.ply").write_bytes(bytes(size))
        (folder / "truth").mkdir()
        printed = cache / "printed" / f"{folder.name}-stripes-1234"
        printed.mkdir(parents=True)
        (printed / "scan.ply").write_bytes(bytes(10 * size))
        (printed / "truth").symlink_to(folder / "truth")
        record(f"works/{folder.name}/garment", "extract", config={"learn": 1}, sources={"capture": str(folder)})
    (cache / "body-anny-v1.npz").write_bytes(bytes(300))
    (cache / "people").mkdir()
    (cache / "people" / "a.npz").write_bytes(bytes(200))
    return cache
