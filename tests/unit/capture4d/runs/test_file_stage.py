"""Files among others of the user's: made once, made anew when they or their inputs change, never replaced unasked."""

from __future__ import annotations

from pathlib import Path

import pytest

from capture4d.errors import InputError, StaleError
from capture4d.files.atomic import read_json
from capture4d.runs.file_stage import FileStage, open_file_stage


def opened(folder: Path, *, fine: int = 3, images: str = "a", overwrite: bool = False) -> FileStage:
    return open_file_stage(
        folder / "record.json",
        name="paint",
        schema=1,
        config={"fine": fine},
        upstream={"images": images},
        sources={"images": folder / "images"},
        overwrite=overwrite,
    )


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    (tmp_path / "notes.txt").write_text("the user's own")
    paths = [tmp_path / "a.txt", tmp_path / "b.txt"]
    stage = opened(tmp_path)
    assert stage.made(paths) is None
    for path in paths:
        path.write_text(path.name)
    assert not (tmp_path / "record.json").exists(), "a run that fails leaves no record"
    digest = stage.finish(paths)
    assert opened(tmp_path).made(paths) == digest
    return paths


def test_a_record_says_what_a_stage_folder_would(files: list[Path]) -> None:
    record = read_json(files[0].with_name("record.json"))
    assert {key: record[key] for key in ("stage", "schema", "config", "upstream", "status")} == {
        "stage": "paint", "schema": 1, "config": {"fine": 3}, "upstream": {"images": "a"}, "status": "complete",
    }  # fmt: skip
    assert record["sources"] == {"images": str(files[0].with_name("images").resolve())}


def test_what_was_lost_or_touched_is_made_anew(files: list[Path]) -> None:
    files[1].write_text("touched")
    assert opened(files[0].parent).made(files) is None
    files[1].write_text("b.txt")
    assert opened(files[0].parent).made(files) is not None
    files[0].unlink()
    assert opened(files[0].parent).made(files) is None


def test_what_is_the_users_is_told_from_what_a_run_has_left(files: list[Path]) -> None:
    folder = files[0].parent
    assert opened(folder, images="other").may_replace(files)
    assert not opened(folder).may_replace([*files, folder / "notes.txt"])
    files[0].unlink()
    assert opened(folder).may_replace(files), "what was lost is nobody's"
    files[1].write_text("touched")
    assert not opened(folder).may_replace(files)
    files[1].unlink()
    files[1].mkdir()
    assert not opened(folder).may_replace(files)


def test_other_inputs_are_taken_without_a_question(files: list[Path]) -> None:
    assert opened(files[0].parent, images="other").made(files) is None


def test_other_settings_are_refused_unless_told(files: list[Path]) -> None:
    folder = files[0].parent
    with pytest.raises(StaleError, match=r"record\.json: was made with other settings \(fine 3 to 4\)"):
        opened(folder, fine=4)
    stage = opened(folder, fine=4, overwrite=True)
    assert stage.made(files) is None
    assert {path.read_text() for path in files} == {"a.txt", "b.txt"}, "they stand until they are replaced"
    stage.finish(files)
    assert opened(folder, fine=4).made(files) is not None
    assert (folder / "notes.txt").read_text() == "the user's own"


def test_overwriting_makes_anew_whatever_the_settings(files: list[Path]) -> None:
    assert opened(files[0].parent, overwrite=True).made(files) is None


def test_a_record_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "record.json").write_text("{")
    with pytest.raises(InputError, match=r"record\.json"):
        opened(tmp_path)
