"""Progress: a line at once and one at the end, JSON that machines read, and silence where it is wanted."""

import json
import re
import sys
import threading

import pytest

from capture4d.runs import progress as progress_module
from capture4d.runs.progress import progress, progress_style, stage_progress
from capture4d.runs.workers import run_jobs
from tests.command_line import PROGRESS

CLOCK = re.compile(r"\d:\d\d:\d\d")


def lines(capsys: pytest.CaptureFixture[str]) -> list[str]:
    said = capsys.readouterr()
    assert said.out == ""
    return [CLOCK.sub("TIME", line) for line in said.err.splitlines()]


def test_where_stderr_is_no_terminal_there_is_a_line_at_once_and_one_at_the_end(capsys: pytest.CaptureFixture[str]):
    with stage_progress("track"), progress("refine poses", 3) as advance:
        advance(1)
        assert lines(capsys) == ["track: begins", "track, refine poses: 0 of 3, TIME gone"]
    assert lines(capsys) == ["track, refine poses: 3 of 3 in TIME", "track: ends after TIME"]


def test_a_step_that_is_called_as_its_stage_is_named_once_and_one_without_a_stage_too(
    capsys: pytest.CaptureFixture[str],
):
    with stage_progress("register"), progress("register", 2):
        pass
    with progress("draw", 2, completed=1):
        pass
    assert lines(capsys) == [
        "register: begins",
        "register: 0 of 2, TIME gone",
        "register: 2 of 2 in TIME",
        "register: ends after TIME",
        "draw: 1 of 2, TIME gone",
        "draw: 2 of 2 in TIME",
    ]


def test_meanwhile_lines_go_on_with_the_time_that_is_left(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    told, again = threading.Event(), progress_module._print

    def print_and_tell(line: str) -> None:
        again(line)
        if " left" in line:
            told.set()

    monkeypatch.setattr(progress_module, "EVERY_S", 0.01)
    monkeypatch.setattr(progress_module, "_print", print_and_tell)
    with progress("scan", 8) as advance:
        advance(2)
        assert told.wait(60)
    said = capsys.readouterr().err.splitlines()
    assert all(PROGRESS.fullmatch(line) for line in said)
    assert any(re.fullmatch(r"scan: 2 of 8, 0:00:\d\d gone, 0:00:\d\d left", line) for line in said)


def test_what_is_read_from_disk_is_told_as_well(capsys: pytest.CaptureFixture[str]):
    files = ["before"] * 5

    def scan() -> None:
        with progress("scan", 8, lambda: len(files), completed=1):
            files.extend(["new"] * 3)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        scan()
    assert lines(capsys)[-1] == "scan: 4 of 8, stopped after TIME"


def test_a_stage_that_fails_says_that_it_stopped(capsys: pytest.CaptureFixture[str]):
    def track() -> None:
        with stage_progress("track"), progress("refine poses", 3) as advance:
            advance(2)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        track()
    assert lines(capsys)[2:] == ["track, refine poses: 2 of 3, stopped after TIME", "track: stopped after TIME"]


def test_machines_get_one_object_a_line(capsys: pytest.CaptureFixture[str]):
    with progress_style("json"):
        with stage_progress("track"), progress("refine poses", 4) as advance:
            advance(4)
        with progress("draw", 1):
            pass
    said = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    keys = ["stage", "step", "state", "done", "total", "elapsed_s", "left_s"]
    assert all(list(line) == keys for line in said)
    assert [(line["stage"], line["step"], line["state"], line["done"], line["total"]) for line in said] == [
        ("track", None, "begins", None, None),
        ("track", "refine poses", "running", 0, 4),
        ("track", "refine poses", "running", 4, 4),
        ("track", None, "ends", None, None),
        ("draw", "draw", "running", 0, 1),
        ("draw", "draw", "running", 1, 1),
    ]
    assert said[1]["left_s"] is None
    assert said[2]["left_s"] == 0


def test_quiet_is_quiet(capsys: pytest.CaptureFixture[str]):
    with progress_style("quiet"), stage_progress("track"), progress("refine poses", 4) as advance:
        advance(1)
    assert lines(capsys) == []


def test_a_terminal_gets_a_bar(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with stage_progress("track"), progress("refine poses", 4) as advance:
        advance(1)
    said = capsys.readouterr().err
    assert "4/4" in said
    assert "begins" not in said


def test_jobs_are_counted_in_their_units(capsys: pytest.CaptureFixture[str]):
    assert sorted(run_jobs(len, ["ab", "c"], workers=1, label="words", units=len)) == [1, 2]
    assert lines(capsys) == ["words: 0 of 3, TIME gone", "words: 3 of 3 in TIME"]


def test_the_time_left_forgets_how_long_it_took_to_begin(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(progress_module.time, "monotonic", lambda: now[0])
    count = progress_module._Count(100, 20, None)
    assert count.told("running").left_s is None
    now[0] = 30.0
    count.advance(1)
    assert count.told("running").left_s == 30 * 79, "one unit is all that is known"
    for _ in range(9):
        now[0] += 1
        count.advance(1)
    assert count.told("running").left_s == pytest.approx(70)
