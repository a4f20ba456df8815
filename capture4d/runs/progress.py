"""How far the work is, on stderr: a bar on a terminal, lines elsewhere, JSON for machines, or nothing.

docs/reference/progress.md says what is printed. Standard library alone until a bar is drawn.
"""

from __future__ import annotations

import contextlib
import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Literal, TypeAlias

__all__ = ["EVERY_S", "Style", "progress", "progress_style", "stage_progress"]

Style: TypeAlias = Literal["auto", "bar", "lines", "json", "quiet"]
"""`auto` is a bar on a terminal and lines elsewhere, such as in a log file."""
EVERY_S = 10.0
"""Between two lines about one step."""
_POLL_S = 1.0
"""Between two looks at a count that is read from disk."""

_style: ContextVar[Style] = ContextVar("style of progress", default="auto")
_stage: ContextVar[str] = ContextVar("stage whose progress it is", default="")


@contextlib.contextmanager
def progress_style(style: Style) -> Iterator[None]:
    """Show progress this way meanwhile, in this thread."""
    token = _style.set(style)
    try:
        yield
    finally:
        _style.reset(token)


@contextlib.contextmanager
def stage_progress(stage: str) -> Iterator[None]:
    """What is shown meanwhile is a stage's: it is told at once that it begins, and at its end how long it took."""
    say = _teller(_chosen(), stage)
    begun, token = time.monotonic(), _stage.set(stage)
    say(_Told("begins"))
    try:
        yield
    except BaseException:
        say(_Told("stopped", elapsed_s=time.monotonic() - begun))
        raise
    finally:
        _stage.reset(token)
    say(_Told("ends", elapsed_s=time.monotonic() - begun))


@contextlib.contextmanager
def progress(
    label: str, total: int, finished: Callable[[], int] | None = None, *, completed: int = 0
) -> Iterator[Callable[[int], None]]:
    """Show how much of a step is done, and the time left; call what it yields with the units just done.

    Args:
        finished: units done so far, read from disk once a second, instead of calls.
        completed: units that were done before.
    """
    count = _Count(total, completed, finished)
    style = _chosen()
    if style == "quiet":
        yield count.advance
        return
    shown = _bar(label, count) if style == "bar" else _lines(_teller(style, _stage.get(), label), count)
    with shown:
        yield count.advance


def _chosen() -> Literal["bar", "lines", "json", "quiet"]:
    style = _style.get()
    if style == "auto":
        return "bar" if sys.stderr.isatty() else "lines"
    return style


class _Count:
    """Units of a step that are done, and when they will all be."""

    def __init__(self, total: int, completed: int, finished: Callable[[], int] | None) -> None:
        self.total = total
        self._begun, self._first, self._counted, self._finished = time.monotonic(), completed, completed, finished
        self._before = finished() if finished else 0
        self._warm: tuple[float, int] | None = None

    def advance(self, units: int) -> None:
        self._counted += units
        self._warm = self._warm or (time.monotonic(), self.done)

    @property
    def done(self) -> int:
        counted = self._first + self._finished() - self._before if self._finished else self._counted
        return min(counted, self.total)

    def told(self, state: Literal["running", "stopped"], *, all_done: bool = False) -> _Told:
        done, elapsed = self.total if all_done else self.done, time.monotonic() - self._begun
        return _Told(state, done, self.total, elapsed, self._left_s(done, elapsed))

    def _left_s(self, done: int, elapsed: float) -> float | None:
        """By the pace since the first unit was done, as soon as more have followed than came with it: what went before
        was spent on starting processes as well."""
        new, left = done - self._first, self.total - done
        if left <= 0 or new <= 0:
            return 0.0 if left <= 0 else None
        since, first = self._warm or (self._begun, self._first)
        if done - first > first - self._first:
            return (time.monotonic() - since) / (done - first) * left
        return elapsed / new * left


@dataclass(frozen=True, slots=True)
class _Told:
    """What one line says; counts are of steps, not of stages."""

    state: Literal["begins", "running", "stopped", "ends"]
    done: int | None = None
    total: int | None = None
    elapsed_s: float = 0.0
    left_s: float | None = None


def _teller(style: Style, stage: str, step: str = "") -> Callable[[_Told], None]:
    """Prints lines about a stage, or about a step of it."""

    def as_json(told: _Told) -> None:
        left = None if told.left_s is None else round(told.left_s, 1)
        _print(
            json.dumps(
                {"stage": stage or step, "step": step or None, "state": told.state, "done": told.done}
                | {"total": told.total, "elapsed_s": round(told.elapsed_s, 1), "left_s": left}
            )
        )

    def as_text(told: _Told) -> None:
        name = stage if not step or step == stage else f"{stage}, {step}" if stage else step
        if told.total is None:
            took = "" if told.state == "begins" else f" after {_clock(told.elapsed_s)}"
            _print(f"{name}: {told.state}{took}")
            return
        count = f"{name}: {told.done} of {told.total}"
        if told.state == "stopped":
            _print(f"{count}, stopped after {_clock(told.elapsed_s)}")
        elif told.done == told.total:
            _print(f"{count} in {_clock(told.elapsed_s)}")
        else:
            left = "" if told.left_s is None else f", {_clock(told.left_s)} left"
            _print(f"{count}, {_clock(told.elapsed_s)} gone{left}")

    if style == "json":
        return as_json
    # A bar says itself what it is of; a stage needs no line beside it.
    return as_text if style == "lines" else lambda told: None


def _print(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _clock(seconds: float) -> str:
    minutes, whole = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{whole:02d}"


@contextlib.contextmanager
def _lines(say: Callable[[_Told], None], count: _Count) -> Iterator[None]:
    """A line at once, one every ten seconds, and one at the end."""
    stop = threading.Event()

    def keep_telling() -> None:
        while not stop.wait(EVERY_S):
            told = count.told("running")
            if told.done != told.total:  # the end is told once, when processes have ended, too
                say(told)

    say(count.told("running"))
    teller = threading.Thread(target=keep_telling, daemon=True)
    teller.start()
    done = False
    try:
        yield
        done = True
    finally:
        stop.set()
        teller.join()
        say(count.told("running", all_done=True) if done else count.told("stopped"))


@contextlib.contextmanager
def _bar(label: str, count: _Count) -> Iterator[None]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description:<24}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    stop = threading.Event()
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(label, total=count.total, completed=count.done)

        def poll() -> None:
            while not stop.wait(_POLL_S):
                bar.update(task, completed=count.done)

        poller = threading.Thread(target=poll, daemon=True)
        poller.start()
        try:
            yield
            bar.update(task, completed=count.total)
        finally:
            stop.set()
            poller.join()
