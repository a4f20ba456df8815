"""A pool of workers that tell how far they are: one thread each, and none outlives the command. They are processes of
this machine, or those of a cluster (`runs.cluster`)."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing.connection import wait
from typing import Any, TypeVar, overload

from capture4d.runs.cluster.scheduler import Cluster, chosen_cluster
from capture4d.runs.progress import progress

__all__ = ["WorkerDied", "run_jobs", "shared"]

Job = TypeVar("Job")
Prepared = TypeVar("Prepared")
Result = TypeVar("Result")


class WorkerDied(RuntimeError):
    """A worker process ended without an answer: killed, or out of memory. Finished frames are on disk."""


def shared(value: Prepared) -> Callable[[], Prepared]:
    """A `prepare` that hands the same value to every process, once each."""
    return partial(_value, value)


def _value(value: Prepared) -> Prepared:
    return value


@overload
def run_jobs(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    *,
    workers: int,
    label: str,
    units: Callable[[Job], int] | None = None,
    finished: Callable[[], int] | None = None,
) -> Iterator[Result]: ...
@overload
def run_jobs(
    function: Callable[[Prepared, Job], Result],
    jobs: Sequence[Job],
    *,
    prepare: Callable[[], Prepared],
    workers: int,
    label: str,
    units: Callable[[Job], int] | None = None,
    finished: Callable[[], int] | None = None,
) -> Iterator[Result]: ...
def run_jobs(
    function: Callable[..., Result],
    jobs: Sequence[Job],
    *,
    prepare: Callable[[], Any] | None = None,
    workers: int,
    label: str,
    units: Callable[[Job], int] | None = None,
    finished: Callable[[], int] | None = None,
) -> Iterator[Result]:
    """Run `function` on every job and yield the results as they come; `capture4d.runs.progress` shows how far it is.

    Args:
        function: importable by name, as are its jobs and results, for they travel to new processes.
        prepare: makes what all jobs need, once in each process, before its first job: `function(prepared, job)`. A
            function of a module, or a `functools.partial` of one, with what it needs.
        workers: processes; 1 runs the jobs here, in order. Each worker computes on one thread, so that results do not
            depend on how many there are. With a cluster it has no meaning.
        units: how much of the progress a job is worth, 1 each if None.
        finished: units done so far, read from disk once a second; for jobs that are worth many.
    Raises:
        WorkerDied: a worker was killed; of a cluster, every one that did the same job.
        InputError: there is no cluster where one was chosen, or its workers are not fit.
    """
    if not jobs:
        return
    total, cluster = sum(units(job) if units else 1 for job in jobs), chosen_cluster()
    with progress(label, total, finished) as advance:
        if cluster is not None:
            for at, result in _on_cluster(cluster, function, jobs, prepare, label):
                advance(units(jobs[at]) if units else 1)
                yield result
            return
        if workers <= 1 or len(jobs) <= 1:
            given = () if prepare is None else (prepare(),)
            for job in jobs:
                result = function(*given, job)
                advance(units(job) if units else 1)
                yield result
            return
        before = set(multiprocessing.active_children())
        pool = ProcessPoolExecutor(
            min(workers, len(jobs)),
            multiprocessing.get_context("spawn"),
            initializer=_start_worker,
            initargs=(function, prepare),
        )
        try:
            with _worker_environment():
                futures: dict[Future[Result], Job] = {pool.submit(_work, job): job for job in jobs}
            for future in as_completed(futures):
                result = future.result()
                advance(units(futures[future]) if units else 1)
                yield result
        except BaseException as error:
            for worker in set(multiprocessing.active_children()) - before:
                worker.kill()  # files are whole or absent, so there is nothing to wait for
            if isinstance(error, BrokenProcessPool):
                raise WorkerDied(
                    f"{label}: a worker process was killed, perhaps for want of memory; finished frames are kept, "
                    "the same command goes on (with fewer --workers if memory is short). A script of your own must "
                    "start its work under `if __name__ == '__main__':`"
                ) from None
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _on_cluster(
    cluster: Cluster,
    function: Callable[..., Result],
    jobs: Sequence[Any],
    prepare: Callable[[], Any] | None,
    label: str,
) -> Iterator[tuple[int, Result]]:
    from capture4d.runs.cluster.jobs import ClusterLostError, cluster_jobs

    try:
        yield from cluster_jobs(cluster, function, jobs, prepare)
    except ClusterLostError as error:
        raise WorkerDied(f"{label}: {error}; finished frames are kept, the same command goes on") from None


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


_function: Callable[..., Any] | None = None
_prepare: Callable[[], Any] | None = None
_prepared: tuple[Any, ...] | None = None
"""Of this process, if it is a worker: it serves one pool, from its start to its end."""


def _work(job: Any) -> Any:
    """Run one job in a worker, which prepares before its first: there, so that a fault travels back as a job's does."""
    global _prepared
    if _prepared is None:
        _prepared = () if _prepare is None else (_prepare(),)
    assert _function is not None
    return _function(*_prepared, job)


def _start_worker(function: Callable[..., Any], prepare: Callable[[], Any] | None) -> None:
    """Take the work, and end with the parent, however it ends."""
    global _function, _prepare
    _function, _prepare = function, prepare
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
