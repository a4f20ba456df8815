"""What a report of a fault should bring along: log.jsonl in the folder that a command writes to, a JSON object a line.

docs/reference/log.md lists what is in it. It is appended to, whatever becomes of the command; the environment is not
in it. A log must never be what stops a run: where it cannot be written, it is not.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import platform
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from capture4d.files.atomic import plain_value
from capture4d.runs.processes.pool import cpu_of_workers, kept_workers
from capture4d.runs.progress import stage_progress
from capture4d.runs.stage import StageResult

__all__ = ["FORMER_LOG", "LARGEST_LOG", "LOG", "RunLog", "logged_stage", "run_log"]

LOG, FORMER_LOG = "log.jsonl", "log.old.jsonl"
LARGEST_LOG = 1_000_000
"""Bytes; a log that has more becomes FORMER_LOG when the next command begins, and what was that goes."""
_MOST_NOTES = 200
"""Lines of one run about what was said on the screen; what comes after is counted."""
_LONGEST_TEXT, _LONGEST_TRACEBACK = 2_000, 8_000
_TOLD_VERSIONS = ("capture4d", "numpy", "scipy", "numba", "torch", "open3d", "warp-lang")
_SAID = "capture4d: "
"""What every line begins with that a command says; progress does not."""

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class RunLog:
    """The log of one command. Nothing is written before a stage has begun in the folder: a command that is refused at
    once leaves none behind."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._waiting, self._notes, self._is_open = folder, "", 0, False
        self._run = f"{datetime.now(UTC):%Y%m%dT%H%M%S}-{os.getpid()}"
        self._begun, self._cpu = time.monotonic(), _cpu_s()

    def write(self, event: str, **facts: Any) -> None:
        """Append a line."""
        line = {"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "run": self._run, "event": event, **facts}
        self._waiting += json.dumps(line, default=plain_value) + "\n"
        with contextlib.suppress(OSError):
            self._is_open = self._is_open or self._has_stage()
            if self._is_open:
                with open(self._folder / LOG, "a", encoding="utf-8") as file:
                    file.write(self._waiting)
                self._waiting = ""

    def note(self, event: str, text: str, **facts: Any) -> None:
        """Append what was said on the screen, unless too much was."""
        self._notes += 1
        if self._notes <= _MOST_NOTES:
            self.write(event, text=text[:_LONGEST_TEXT], **facts)

    def fault(self, error: BaseException) -> None:
        """Append what ended the command."""
        lines = "".join(traceback.format_exception(error))
        self.write(
            "fault",
            kind=type(error).__name__,
            text=str(error)[:_LONGEST_TEXT],
            traceback=lines[-_LONGEST_TRACEBACK:],
        )

    def end(self, code: int) -> None:
        """Append the last line."""
        left_out = max(0, self._notes - _MOST_NOTES)
        self.write("ends", code=code, **_times(self._begun, self._cpu), **({"left_out": left_out} if left_out else {}))

    def _has_stage(self) -> bool:
        return any(any(self._folder.glob(place)) for place in ("stage.json", "*/stage.json", "*/*/stage.json"))


_log: ContextVar[RunLog | None] = ContextVar("log of this run", default=None)


@contextlib.contextmanager
def run_log(folder: Path, arguments: Sequence[str], settings: Any, *, cores: int) -> Iterator[RunLog]:
    """Keep a log of a command meanwhile; call its `fault` and `end`.

    Args:
        arguments: its command line.
        settings: dataclass of what that means.
    """
    with contextlib.suppress(OSError):
        if (folder / LOG).stat().st_size > LARGEST_LOG:
            os.replace(folder / LOG, folder / FORMER_LOG)
    log = RunLog(folder)
    log.write(
        "begins",
        command=["capture4d", *arguments],
        folder=str(Path.cwd()),
        versions={"python": platform.python_version(), **{name: _version(name) for name in _TOLD_VERSIONS}},
        platform=platform.platform(),
        cores=cores,
        settings=plain_value(settings),
    )
    token = _log.set(log)
    try:
        with _overhearing(log):
            yield log
    finally:
        _log.reset(token)


def logged_stage(name: str) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Of a function that runs a stage: the log tells when it begins and ends and what came of it, if there is a log;
    the screen tells the former."""

    def decorate(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        @functools.wraps(function)
        def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            log = _log.get()
            with stage_progress(name), kept_workers():
                if log is None:
                    return function(*args, **kwargs)
                log.write("stage begins", stage=name)
                begun, cpu_s = time.monotonic(), _cpu_s()
                outcome: Mapping[str, Any] = {"outcome": "stopped"}
                try:
                    result = function(*args, **kwargs)
                    outcome = {"outcome": "done", **_counts(result)}
                    return result
                finally:
                    log.write("stage ends", stage=name, **outcome, **_times(begun, cpu_s))

        return run

    return decorate


def _counts(result: object) -> Mapping[str, Any]:
    if not isinstance(result, StageResult):
        return {}
    counts = {"frames": result.frames, "failed": len(result.failed)} if result.frames else {}
    return {"digest": result.digest, **counts}


def _times(begun: float, cpu_s: float) -> Mapping[str, float]:
    return {"wall_s": round(time.monotonic() - begun, 2), "cpu_s": round(_cpu_s() - cpu_s, 2)}


def _cpu_s() -> float:
    """Of this process, and of its workers, ended or kept."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system + cpu_of_workers()


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


@contextlib.contextmanager
def _overhearing(log: RunLog) -> Iterator[None]:
    """What is said on stderr meanwhile, and Python's warnings, are noted as well."""
    stderr, show = sys.stderr, warnings.showwarning

    def show_and_note(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: Any = None,
        line: str | None = None,
    ) -> None:
        log.note("warning", str(message), kind=category.__name__, where=f"{filename}:{lineno}")
        show(message, category, filename, lineno, file, line)

    overheard = _Overheard(stderr, log)
    sys.stderr, warnings.showwarning = overheard, show_and_note
    try:
        yield
    finally:
        if sys.stderr is overheard:
            sys.stderr = stderr
        warnings.showwarning = show


class _Overheard:
    """A stream whose lines about the run are noted as they pass."""

    def __init__(self, stream: Any, log: RunLog) -> None:
        self._stream, self._log, self._line = stream, log, ""

    def write(self, text: str) -> int:
        *lines, self._line = (self._line + text).split("\n")
        for line in lines:
            if _SAID in line:  # on a terminal, what moves the cursor past a bar stands before it
                self._log.note("said", line.partition(_SAID)[2])
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
