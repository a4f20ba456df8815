"""Workers that tell how far they are: one thread each, and none outlives the command. They are processes of this
machine (`runs.processes.pool`), or those of a cluster (`runs.cluster`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, TypeVar, overload

from capture4d.runs.cluster.scheduler import Cluster, chosen_cluster
from capture4d.runs.processes.pool import WorkersLostError, worker_pool
from capture4d.runs.progress import progress

__all__ = ["WorkerDied", "run_jobs", "shared"]

Job = TypeVar("Job")
Prepared = TypeVar("Prepared")
Result = TypeVar("Result")


class WorkerDied(RuntimeError):
    """Worker processes ended without an answer: killed, or out of memory. Finished frames are on disk."""


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
        WorkerDied: a worker was killed, and one of those that took its place; of a cluster, every one that did the
            same job.
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
        try:
            with worker_pool(workers) as pool:
                for at, result in pool.run(function, jobs, prepare):
                    advance(units(jobs[at]) if units else 1)
                    yield result
        except WorkersLostError:
            raise WorkerDied(
                f"{label}: a worker process was killed, perhaps for want of memory; finished frames are kept, "
                "the same command goes on (with fewer --workers if memory is short). A script of your own must "
                "start its work under `if __name__ == '__main__':`"
            ) from None


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
