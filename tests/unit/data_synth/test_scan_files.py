"""A scan is whole if it is as long as its header says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from capture4d.captures.capture import write_scan
from capture4d.runs.stage import open_stage
from capture4d.types import Mesh, Scan
from data_synth.scan_files import is_whole_scan, pending_scans


@pytest.fixture
def scan() -> Scan:
    vertices = np.random.default_rng(0).random((50, 3)).astype(np.float32)
    faces = np.arange(48, dtype=np.int32).reshape(-1, 3)
    return Scan(Mesh(vertices, faces), np.zeros((50, 3), np.uint8), 1, 0.0)


def test_what_the_scanner_writes_is_whole_and_nothing_shorter_is(scan: Scan, tmp_path: Path) -> None:
    path = tmp_path / "000001.ply"
    write_scan(path, scan)
    assert is_whole_scan(path)
    content = path.read_bytes()
    for length in (0, 10, 200, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        assert not is_whole_scan(path)
    path.write_bytes(content + b"more")
    assert not is_whole_scan(path)


def test_missing_and_cut_off_scans_are_pending(scan: Scan, tmp_path: Path) -> None:
    stage = open_stage(tmp_path / "take", name="test", schema=1, config={}, upstream={})
    for frame_id in (1, 2, 3):
        write_scan(stage.frame_path(frame_id, ".ply", folder="scans"), scan)
    cut = stage.frame_path(2, ".ply", folder="scans")
    cut.write_bytes(cut.read_bytes()[:-1])
    assert pending_scans(stage, (1, 2, 3, 4)) == [2, 4]
