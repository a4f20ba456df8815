"""Worker processes of this machine, which go from one step's work to the next.

A process takes seconds to begin: it loads libraries and compiled loops. So those of one command stay until it ends
(`kept_workers`). What a step needs of them, its function and what its jobs share, is handed over in a file that each
reads before its first job of the step.

Workers that are killed are replaced once in a step. After a fault, or Ctrl-C, none is left.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NamedTuple

__all__ = ["WorkerPool", "WorkersLostError", "cpu_of_workers", "kept_workers", "worker_pool"]

REPLACED = 1
"""How often in a step workers are replaced: one that is killed takes the others' jobs with it, and a machine without
memory kills them again."""


class WorkersLostError(RuntimeError):
    """Workers were killed, and those that took their place."""


class _Answer(NamedTuple):
    result: Any
    process: int
    cpu_s: float
    """Of the process, from its beginning."""


class WorkerPool:
    """Processes that are started as they are needed."""

    def __init__(self, workers: int) -> None:
        self.workers = workers
        self.cpu_s: dict[int, float] = {}
        """What each process has told, which is not counted as this one's children's before it ends."""
        self._executor: ProcessPoolExecutor | None = None
        self._processes = set[BaseProcess]()

    def run(
        self, function: Callable[..., Any], jobs: Sequence[Any], prepare: Callable[[], Any] | None
    ) -> Iterator[tuple[int, Any]]:
        """Do jobs; yields the place of each and its result, as they come. All processes end with a fault.

        Raises:
            WorkersLostError: a process was killed, and again after it was replaced.
        """
        with tempfile.TemporaryDirectory(prefix="capture4d-") as folder:
            work = Path(folder) / "work.pickle"
            work.write_bytes(pickle.dumps((function, prepare)))
            pending, replaced = dict(enumerate(jobs)), 0
            try:
                while pending:
                    try:
                        for at, result in self._answers(str(work), pending):
                            del pending[at]
                            yield at, result
                    except BrokenProcessPool:
                        if replaced == REPLACED:
                            raise WorkersLostError from None
                        replaced += 1
                        self.end(kill=True)
            except BaseException:
                self.end(kill=True)  # files are whole or absent, so there is nothing to wait for
                raise

    def _answers(self, work: str, jobs: dict[int, Any]) -> Iterator[tuple[int, Any]]:
        if self._executor is None:
            spawn = multiprocessing.get_context("spawn")
            self._executor = ProcessPoolExecutor(self.workers, spawn, initializer=_end_with_parent)
        before = set(multiprocessing.active_children())
        with _worker_environment():
            futures: dict[Future[_Answer], int] = {
                self._executor.submit(_work, work, job): at for at, job in jobs.items()
            }
        self._processes |= set(multiprocessing.active_children()) - before
        for future in as_completed(futures):
            answer = future.result()
            self.cpu_s[answer.process] = answer.cpu_s
            yield futures[future], answer.result

    def end(self, *, kill: bool = False) -> None:
        """End all processes; a later step starts new ones."""
        if kill:
            for process in self._processes:
                process.kill()
        if self._executor is not None:
            self._executor.shutdown(wait=True, cancel_futures=True)
        self._executor, self._processes = None, set()
        self.cpu_s.clear()


# --- those of a command --------------------------------------------------------------------------------------------

_keeping = 0
_kept: WorkerPool | None = None


@contextlib.contextmanager
def kept_workers() -> Iterator[None]:
    """Processes that are started inside stay until the end of the outermost."""
    global _keeping, _kept
    _keeping += 1
    try:
        yield
    finally:
        _keeping -= 1
        if not _keeping and _kept is not None:
            _kept.end()
            _kept = None


@contextlib.contextmanager
def worker_pool(workers: int) -> Iterator[WorkerPool]:
    """So many workers: those that are kept, or some that end with the `with`."""
    global _kept
    if not _keeping:
        pool = WorkerPool(workers)
        try:
            yield pool
        finally:
            pool.end()
        return
    if _kept is None or _kept.workers != workers:
        if _kept is not None:
            _kept.end()
        _kept = WorkerPool(workers)
    yield _kept


def cpu_of_workers() -> float:
    """CPU seconds of the kept processes that have not ended; the system counts the others as children's."""
    return 0.0 if _kept is None else sum(_kept.cpu_s.values())


@contextlib.contextmanager
def _worker_environment() -> Iterator[None]:
    """Processes started meanwhile leave Ctrl-C to this one, and compute on one thread.

    Numerical libraries read these variables as they load; an ignored signal is inherited.
    """
    variables = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(dict.fromkeys(variables, "1"))
    on_main_thread = threading.current_thread() is threading.main_thread()
    answer = signal.signal(signal.SIGINT, signal.SIG_IGN) if on_main_thread else None
    try:
        yield
    finally:
        if on_main_thread:
            signal.signal(signal.SIGINT, answer)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


# --- in a worker ---------------------------------------------------------------------------------------------------

_step: tuple[str, Callable[..., Any], Callable[[], Any] | None] | None = None
"""The file of the work that this process does, and what is in it."""
_prepared: tuple[Any, ...] | None = None


def _work(work: str, job: Any) -> _Answer:
    """Run one job, and prepare before the first of a step: there, so that a fault travels back as a job's does."""
    global _step, _prepared
    if _step is None or _step[0] != work:
        _step, _prepared = None, None  # of the step before: memory is for one
        _step = (work, *pickle.loads(Path(work).read_bytes()))
    _, function, prepare = _step
    if _prepared is None:
        _prepared = () if prepare is None else (prepare(),)
    return _Answer(function(*_prepared, job), os.getpid(), time.process_time())


def _end_with_parent() -> None:
    """End with the parent, however it ends."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()
