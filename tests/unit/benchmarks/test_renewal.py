from functools import partial
from pathlib import Path

import pytest

from benchmarks.renewal import renew
from capture4d.errors import InputError
from capture4d.runs.stage import open_stage, require_complete


def make(folder: Path, settings: dict[str, int], *, stage: str = "test", overwrite: bool = False) -> str:
    opened = open_stage(folder, name=stage, schema=1, config=settings, upstream={}, overwrite=overwrite)
    path = folder / "value.txt"
    if not path.is_file():
        path.write_text(str(settings["value"]))
    return opened.finish([path]).digest


def test_what_other_settings_made_is_made_anew(tmp_path: Path):
    renew(partial(make, tmp_path, {"value": 1}))
    renew(partial(make, tmp_path, {"value": 1}))
    first = require_complete(tmp_path, "test", "make")
    renew(partial(make, tmp_path, {"value": 2}))
    assert (tmp_path / "value.txt").read_text() == "2"
    assert require_complete(tmp_path, "test", "make") != first


def test_other_faults_of_a_folder_are_not_repaired(tmp_path: Path):
    renew(partial(make, tmp_path, {"value": 1}))
    with pytest.raises(InputError, match="expected output of 'other'"):
        renew(partial(make, tmp_path, {"value": 1}, stage="other"))
