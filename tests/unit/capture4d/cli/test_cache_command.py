"""`capture4d cache` as a user types it."""

import json
from pathlib import Path

import pytest

from capture4d.runs.locks import alone
from tests.command_line import fails, run

TAKE = "takes/tiny-0123456789ab"
OLD = '{"stage": "synth", "schema": 1, "config": {"name": "tiny"}}'


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CAPTURE4D_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def filled(cache: Path) -> Path:
    (cache / TAKE).mkdir(parents=True)
    (cache / TAKE / "stage.json").write_text(OLD)
    (cache / TAKE / "scan.ply").write_bytes(bytes(3_000_000))
    (cache / "body-anny-v1.npz").write_bytes(bytes(4000))
    return cache


def said(capsys: pytest.CaptureFixture[str], *arguments: str, code: int = 0) -> str:
    assert run("cache", *arguments) == code
    captured = capsys.readouterr()
    assert captured.err == ""
    return captured.out


def test_a_line_an_entry_the_largest_first_and_the_sums(filled: Path, capsys: pytest.CaptureFixture[str]):
    lines = said(capsys).splitlines()
    assert lines[0] == f"{filled}:"
    assert [line.split()[0] for line in lines[2:5]] == ["entry", TAKE, "body-anny-v1.npz"]
    assert lines[3].split()[1:3] == ["3.0", "MB"]
    assert lines[3].endswith("old      synth: format 1, now 3")
    assert lines[-1] == "2 entries, 3.0 MB; 3.0 MB of it old, which capture4d cache --remove old removes"


@pytest.mark.parametrize("arguments", [(), ("--remove", "old"), ("--remove", "all", "--dry-run")])
def test_nothing_kept_is_said(cache: Path, arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]):
    assert said(capsys, *arguments) == f"{cache}: no such folder; nothing is kept\n"
    assert not cache.exists()
    cache.mkdir()
    assert said(capsys, *arguments) == f"{cache}: nothing is kept there\n"


def test_what_is_removed_is_said_with_what_was_freed(filled: Path, capsys: pytest.CaptureFixture[str]):
    would = said(capsys, "--remove", "old", "--dry-run").splitlines()
    assert would == [f"would remove {TAKE} (3.0 MB)", "Nothing was removed; it would be 1 entry, 3.0 MB."]
    assert (filled / TAKE).is_dir()
    assert said(capsys, "--remove", "old").splitlines() == [
        f"removed {TAKE} (3.0 MB)",
        "Removed: 1 entry, 3.0 MB freed.",
    ]
    assert not (filled / TAKE).exists()
    assert said(capsys, "--remove", "old") == "Nothing was removed.\n"
    assert said(capsys).splitlines()[-1] == "1 entry, 4.0 kB; nothing of it old"


def test_what_stays_is_said_and_is_exit_3(filled: Path, capsys: pytest.CaptureFixture[str]):
    (filled / "thesis.tex").write_text("x")
    with alone(filled / TAKE, folder=False):
        lines = said(capsys, "--remove", "all", code=3).splitlines()
    assert lines[0] == "removed body-anny-v1.npz (4.0 kB)"
    assert lines[1].startswith(f"left {TAKE}: being written")
    assert lines[2] == "left thesis.tex: does not look like ours; its name removes it"
    assert (filled / TAKE / "scan.ply").is_file()


def test_an_unknown_name_is_exit_1_and_none_at_all_is_exit_2(filled: Path, capsys: pytest.CaptureFixture[str]):
    line = fails(capsys, "cache", "--remove", "old", "takes/tiny")
    assert line == (
        f"--remove: expected old, all or a name of what is kept, found 'takes/tiny'; there is {TAKE}, body-anny-v1.npz"
    )
    assert (filled / TAKE).is_dir()
    assert "expected old, all or names" in fails(capsys, "cache", "--remove", code=2)


def test_json_says_the_same(filled: Path, capsys: pytest.CaptureFixture[str]):
    told = json.loads(said(capsys, "--json"))
    assert [entry["name"] for entry in told["entries"]] == [TAKE, "body-anny-v1.npz"]
    assert told["bytes"] == sum(entry["bytes"] for entry in told["entries"])
    done = json.loads(said(capsys, "--json", "--remove", "old"))
    assert (done["removed"], done["left"], done["freed_bytes"]) == ([TAKE], {}, told["old_bytes"])
