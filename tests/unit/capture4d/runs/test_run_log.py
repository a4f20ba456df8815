"""The log of a work folder: what a report of a fault needs, and nothing else."""

import json
import os
import sys
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from capture4d.runs import run_log as module
from capture4d.runs.run_log import FORMER_LOG, LARGEST_LOG, LOG, logged_stage, run_log
from capture4d.runs.stage import StageResult, open_stage


@dataclass(frozen=True)
class Inner:
    nodes: int = 300


@dataclass(frozen=True)
class Command:
    output: Path
    config: Inner = field(default_factory=Inner)
    sizes: tuple[int, ...] = (1, 2)


def begin_stage(folder: Path) -> None:
    open_stage(folder / "garment", name="extract", schema=1, config={}, upstream={})


def read(folder: Path, name: str = LOG) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / name).read_text().splitlines()]


def a_run(folder: Path, *, code: int = 0) -> None:
    with run_log(folder, ["extract", "take"], Command(folder), cores=3) as log:
        begin_stage(folder)
        log.end(code)


def test_everything_that_a_report_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("CAPTURE4D_PASSWORD", "hunter2")

    @logged_stage("extract")
    def extract() -> StageResult:
        begin_stage(tmp_path)
        print("capture4d: 3 scans are points", file=sys.stderr)
        print("extract: 1 of 3, 0:00:01 gone", file=sys.stderr)
        return StageResult(tmp_path, "abc", 36, {4: "no cloth", 5: "none"})

    with run_log(tmp_path, ["extract", "take", "--output", "x"], Command(tmp_path), cores=3) as log:
        extract()
        log.end(3)
    begins, starts, said, ends, last = read(tmp_path)
    assert begins["command"] == ["capture4d", "extract", "take", "--output", "x"]
    assert begins["settings"] == {"output": str(tmp_path), "config": {"nodes": 300}, "sizes": [1, 2]}
    assert begins["cores"] == 3
    assert begins["platform"]
    assert {"python", "capture4d", "numpy", "torch", "open3d"} <= set(begins["versions"])
    assert (starts["event"], starts["stage"]) == ("stage begins", "extract")
    assert (said["event"], said["text"]) == ("said", "3 scans are points")
    assert ends["event"] == "stage ends"
    assert {**ends, "wall_s": 0, "cpu_s": 0}.items() >= {
        "stage": "extract", "outcome": "done", "digest": "abc", "frames": 36, "failed": 2, "wall_s": 0, "cpu_s": 0,
    }.items()  # fmt: skip
    assert (last["event"], last["code"]) == ("ends", 3)
    assert last["wall_s"] >= ends["wall_s"] >= 0
    assert "hunter2" not in (tmp_path / LOG).read_text()


def test_a_fault_brings_its_traceback_and_the_stage_it_stopped(tmp_path: Path):
    @logged_stage("extract")
    def extract() -> None:
        begin_stage(tmp_path)
        raise ZeroDivisionError("no frames")

    with run_log(tmp_path, ["extract"], Command(tmp_path), cores=1) as log:
        try:
            extract()
        except ZeroDivisionError as error:
            log.fault(error)
    _, _, ends, fault = read(tmp_path)
    assert ends["outcome"] == "stopped"
    assert (fault["kind"], fault["text"]) == ("ZeroDivisionError", "no frames")
    assert "in extract" in fault["traceback"]


def test_it_is_appended_to(tmp_path: Path):
    a_run(tmp_path)
    first = (tmp_path / LOG).read_text()
    a_run(tmp_path, code=3)
    assert (tmp_path / LOG).read_text().startswith(first)
    assert [line["code"] for line in read(tmp_path) if line["event"] == "ends"] == [0, 3]


def test_a_killed_run_has_told_how_it_began(tmp_path: Path):
    with run_log(tmp_path, ["extract"], Command(tmp_path), cores=1) as log:
        begin_stage(tmp_path)
        log.write("stage begins", stage="extract")
        assert [line["event"] for line in read(tmp_path)] == ["begins", "stage begins"]


def test_a_command_that_is_refused_at_once_leaves_none(tmp_path: Path):
    (tmp_path / "holiday.txt").write_text("not ours")
    with run_log(tmp_path, ["extract"], Command(tmp_path), cores=1) as log:
        log.fault(ValueError("no such capture"))
        log.end(1)
    assert [path.name for path in tmp_path.iterdir()] == ["holiday.txt"]


def test_a_long_log_makes_room_and_the_last_long_one_is_kept(tmp_path: Path):
    begin_stage(tmp_path)
    (tmp_path / LOG).write_text('{"event": "old"}\n' + " " * LARGEST_LOG + "\n")
    a_run(tmp_path)
    assert (tmp_path / FORMER_LOG).stat().st_size > LARGEST_LOG
    assert [line["event"] for line in read(tmp_path)] == ["begins", "ends"]


def test_one_run_does_not_fill_it(tmp_path: Path):
    begin_stage(tmp_path)
    with run_log(tmp_path, ["extract"], Command(tmp_path), cores=1) as log:
        for frame in range(1000):
            print(f"capture4d: frame {frame}: {'x' * 5000}", file=sys.stderr)
        log.end(0)
    said = [line for line in read(tmp_path) if line["event"] == "said"]
    assert len(said) == module._MOST_NOTES
    assert read(tmp_path)[-1]["left_out"] == 1000 - module._MOST_NOTES
    assert (tmp_path / LOG).stat().st_size < LARGEST_LOG


def test_pythons_warnings_are_noted_and_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    begin_stage(tmp_path)
    shown: list[str] = []
    monkeypatch.setattr(warnings, "showwarning", lambda message, *_: shown.append(str(message)))
    with run_log(tmp_path, ["extract"], Command(tmp_path), cores=1), warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.warn("careful", stacklevel=1)
    assert (read(tmp_path)[-1]["kind"], read(tmp_path)[-1]["text"]) == ("UserWarning", "careful")
    assert shown == ["careful"]


def test_a_log_that_cannot_be_written_stops_nothing(tmp_path: Path):
    begin_stage(tmp_path)
    (tmp_path / LOG).mkdir()
    a_run(tmp_path)
    assert os.listdir(tmp_path / LOG) == []


def test_stderr_is_what_it_was_afterwards(tmp_path: Path):
    before = sys.stderr, warnings.showwarning
    a_run(tmp_path)
    assert before == (sys.stderr, warnings.showwarning)


def test_a_stage_without_a_log_is_a_call(tmp_path: Path):
    @logged_stage("extract")
    def add(a: int, *, b: int) -> int:
        return a + b

    assert add(1, b=2) == 3
    assert add.__name__ == "add"
