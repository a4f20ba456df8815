"""What ends a command is a line that says what the same command would do, and an exit code."""

import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from capture4d import pipeline
from capture4d.cli.answers import TerminatedError
from capture4d.cli.main import main
from capture4d.errors import InputError
from capture4d.runs.run_log import LOG
from capture4d.runs.stage import StageResult, open_stage
from capture4d.runs.workers import WorkerDied
from tests.command_line import run

GOES_ON = "the same command goes on"
BEGINS_ANEW = "without --overwrite the same command goes on, with it it begins anew"
FULL = OSError(28, "No space left on device", "out/x.npz")
DIED = WorkerDied("fit: a worker process was killed; finished frames are kept, the same command goes on (with fewer)")


@pytest.mark.parametrize(
    ("error", "code"), [(KeyboardInterrupt(), 130), (TerminatedError(), 143), (FULL, 1), (DIED, 1), (MemoryError(), 1)]
)
def test_what_the_same_command_would_do(
    error: BaseException, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(pipeline, "fit", fail)
    command = ("fit", "take", "--output", tmp_path / "work")
    for more, said in (((), GOES_ON), (("--overwrite",), BEGINS_ANEW)):
        assert run(*command, *more) == code
        (line,) = capsys.readouterr().err.splitlines()
        assert said in line
        assert ("--overwrite" in line) == bool(more)
    assert not (tmp_path / "work").exists()


@pytest.fixture
def stopping(monkeypatch: pytest.MonkeyPatch) -> dict[str, BaseException | None]:
    """A stage that begins, says something, and then raises what is put here."""
    fault: dict[str, BaseException | None] = {"raised": None}

    def fit(works: Sequence[Path], output: Path, *_: object, **__: object) -> StageResult:
        open_stage(output, name="fit", schema=1, config={}, upstream={})
        print("capture4d: one take teaches little", file=sys.stderr)
        if fault["raised"] is not None:
            raise fault["raised"]
        return StageResult(output, "digest")

    monkeypatch.setattr(pipeline, "fit", fit)
    return fault


@pytest.mark.parametrize(
    ("error", "code"), [(None, 0), (InputError("no cloth", where="a.ply"), 1), (KeyboardInterrupt(), 130)]
)
def test_the_log_has_what_was_said_and_the_exit_code(
    error: BaseException | None, code: int, stopping: dict[str, BaseException | None], tmp_path: Path
):
    stopping["raised"] = error
    assert run("fit", "take", "--output", tmp_path / "work") == code
    lines = [json.loads(line) for line in (tmp_path / "work" / LOG).read_text().splitlines()]
    assert lines[0]["command"] == ["capture4d", "fit", "take", "--output", str(tmp_path / "work")]
    assert lines[0]["settings"]["config"]["regressor"] == "all"
    assert lines[1]["text"] == "one take teaches little"
    assert lines[-1]["code"] == code
    events = [line["event"] for line in lines]
    if error is None:
        assert events == ["begins", "said", "ends"]
    else:
        assert events == ["begins", "said", "said", "fault", "ends"]
        assert lines[3]["kind"] == type(error).__name__


def test_a_bug_is_in_the_log_and_keeps_its_traceback(stopping: dict[str, BaseException | None], tmp_path: Path):
    stopping["raised"] = ZeroDivisionError("ours")
    with pytest.raises(ZeroDivisionError):
        main(["fit", "take", "--output", str(tmp_path / "work")])
    *_, fault, ends = [json.loads(line) for line in (tmp_path / "work" / LOG).read_text().splitlines()]
    assert re.search(r"ZeroDivisionError: ours\n$", fault["traceback"])
    assert ends["code"] == 1
    assert type(sys.stderr).__name__ != "_Overheard"
