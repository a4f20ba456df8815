"""A folder that goes by frames grows, shrinks, and refuses other settings."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture4d.errors import InputError, StaleError
from capture4d.files.atomic import file_digest, read_json, write_json, write_npz
from capture4d.runs.changes import StageChanges
from capture4d.runs.growing import GrowingStage, Pending, Reads, frames_of, open_growing_stage, stage_changes
from capture4d.runs.made import Ledger
from capture4d.runs.stage import require_complete


def reads(*frame_ids: int, left_out: tuple[int, ...] = (), template: str = "aa", **description: Any) -> Reads:
    return Reads({"fps": 30.0, **description}, {"template": template}, frame_ids, left_out)


def opened(folder: Path, what: Reads, *, weight: float = 1.0, schema: int = 1, overwrite: bool = False) -> GrowingStage:
    return open_growing_stage(
        folder, name="test", schema=schema, config={"weight": weight}, reads=what, sources={}, overwrite=overwrite
    )


def values(what: Reads, scans: Mapping[int, int]) -> dict[int, dict[str, str]]:
    return {each: {"scan": str(scans.get(each, each)), **what.shared} for each in what.frame_ids}


def run(folder: Path, what: Reads, scans: Mapping[int, int] | None = None, **how: Any) -> tuple[str, list[int]]:
    """The digest, and the frames that were made."""
    stage, made = opened(folder, what, **how), []
    for frame_id, inputs in values(what, scans or {}).items():
        path = stage.frame_path(frame_id)
        if not stage.stands(path, inputs):
            made.append(frame_id)
            value = np.full(3, int(inputs["scan"]))
            stage.make(path, lambda path=path, value=value: write_npz(path, value=value), inputs=inputs)
    paths = [stage.frame_path(frame_id) for frame_id in what.frame_ids]
    return stage.finish_growing(paths, frames=len(paths)).digest, made


def test_only_what_changes_is_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    first, made = run(tmp_path / "w", reads(1, 2, 3))
    assert made == [1, 2, 3]
    assert run(tmp_path / "w", reads(1, 2, 3)) == (first, [])
    assert capsys.readouterr().err == ""
    assert run(tmp_path / "w", reads(1, 2, 3, 7, 8))[1] == [7, 8]
    assert capsys.readouterr().err == "capture4d: w: 2 frames added (7-8)\n"
    assert run(tmp_path / "w", reads(1, 2, 3, 7, 8), {2: 20})[1] == [2]
    assert run(tmp_path / "w", reads(1, 2, 3, 7, 8, template="bb"))[1] == [1, 2, 3, 7, 8]
    assert "w: template changed" in capsys.readouterr().err
    digest, made = run(tmp_path / "w", reads(1, 2, 3, template="aa"))
    assert (digest, made) == (first, [1, 2, 3])
    assert run(tmp_path / "scratch", reads(1, 2, 3))[0] == first


def test_the_digest_is_that_of_the_files(tmp_path: Path):
    digest, _ = run(tmp_path / "w", reads(1, 2, 3))
    assert digest == file_digest(sorted((tmp_path / "w" / "frames").iterdir()), root=tmp_path / "w")
    assert require_complete(tmp_path / "w", "test", "make") == digest
    assert frames_of(read_json(tmp_path / "w" / "stage.json")) == (1, 2, 3)


def test_frames_that_are_gone_leave_nothing_and_frames_left_out_stay(tmp_path: Path):
    run(tmp_path / "w", reads(1, 2, 3))
    (tmp_path / "w" / "metrics").mkdir()
    (tmp_path / "w" / "metrics" / "000002.json").write_text("{}")
    assert run(tmp_path / "w", reads(1, left_out=(2,)))[1] == []
    assert sorted(path.name for path in (tmp_path / "w").rglob("0*")) == ["000001.npz", "000002.json", "000002.npz"]
    assert run(tmp_path / "w", reads(1, 2))[1] == []
    assert run(tmp_path / "w", reads(1))[1] == []
    assert sorted(path.name for path in (tmp_path / "w").rglob("0*")) == ["000001.npz"]
    assert run(tmp_path / "w", reads(1, 2, 3))[1] == [2, 3]


def test_other_settings_are_refused_in_words_and_overwriting_begins_anew(tmp_path: Path):
    digest, _ = run(tmp_path / "w", reads(1, 2))
    with pytest.raises(StaleError, match=r"w: was made with other settings \(weight 1.0 to 2.0\); with --overwrite"):
        opened(tmp_path / "w", reads(1, 2, 3), weight=2.0)
    assert require_complete(tmp_path / "w", "test", "make") == digest
    assert run(tmp_path / "w", reads(1, 2), weight=2.0, overwrite=True)[1] == [1, 2]
    with pytest.raises(StaleError, match="earlier version of capture4d, in format 1; with --overwrite"):
        opened(tmp_path / "w", reads(1, 2), weight=2.0, schema=2)


def test_a_folder_of_something_else_is_never_touched(tmp_path: Path):
    (tmp_path / "000001.npz").write_text("important")
    with pytest.raises(InputError, match="expected an empty folder"):
        opened(tmp_path, reads(2), overwrite=True)
    assert (tmp_path / "000001.npz").read_text() == "important"


def test_decisions_may_lie_in_a_folder_before_its_first_run(tmp_path: Path):
    write_json(tmp_path / "w" / "shape.json", {})
    opened(tmp_path / "w", reads(1))
    assert (tmp_path / "w" / "shape.json").is_file()


def changes(folder: Path, what: Reads, scans: Mapping[int, int] | None = None, *, weight: float = 1.0) -> StageChanges:
    def pending(ledger: Ledger) -> Pending:
        wanted = values(what, scans or {})
        stale = [each for each in wanted if not ledger.stands(folder / "frames" / f"{each:06d}.npz", wanted[each])]
        return Pending(tuple(stale), replaced=tuple(each for each in scans or {}))

    return stage_changes(folder, name="test", schema=1, config={"weight": weight}, reads=what, pending=pending)


def test_what_would_be_done_is_told_and_nothing_is_done(tmp_path: Path):
    folder = tmp_path / "w"
    assert (changes(folder, reads(1)).state, changes(folder, reads(1)).pending) == ("absent", (1,))
    assert not folder.exists()
    run(folder, reads(1, 2))
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert changes(folder, reads(1, 2)).state == "current"
    grown = changes(folder, reads(1, 2, 3, fps=60.0), {1: 10})
    assert (grown.state, grown.settings, grown.pending) == ("outdated", (), (1, 3))
    assert grown.inputs == ("frame 3 added", "fps 30.0 to 60.0", "frame 1 replaced")
    other = changes(folder, reads(1, 2), weight=3.0)
    assert (other.settings, other.pending) == (("weight 1.0 to 3.0",), (1, 2))
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    opened(folder, reads(1, 2, 3))
    assert changes(folder, reads(1, 2, 3)).state == "unfinished"
