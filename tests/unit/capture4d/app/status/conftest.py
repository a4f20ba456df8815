"""A take that was run once, to be copied, changed and damaged."""

import shutil
from pathlib import Path

import pytest

from tests.command_line import run
from tests.conftest import write_tube_capture


@pytest.fixture(scope="session")
def ran_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with capture/ and the work/ of a run on it."""
    folder = tmp_path_factory.mktemp("ran")
    write_tube_capture(folder / "capture")
    assert run("run", folder / "capture", "--output", folder / "work", "--workers", "1") == 0
    return folder


@pytest.fixture
def ran(ran_once: Path, tmp_path: Path) -> Path:
    """A copy of both. What is recorded of the capture's place is that of the first, so it lies in the work folder."""
    for name in ("capture", "work"):
        shutil.copytree(ran_once / name, tmp_path / name)
    for path in (tmp_path / "work").glob("*/stage.json"):
        path.write_text(path.read_text().replace(str(ran_once / "capture"), str(tmp_path / "capture")))
    return tmp_path
