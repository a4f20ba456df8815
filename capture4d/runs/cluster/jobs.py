"""Jobs handed to a Dask cluster, and their results as they come."""

from __future__ import annotations

import logging
import os
import pickle
import secrets
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from capture4d.errors import InputError
from capture4d.runs.changes import say
from capture4d.runs.cluster.scheduler import Cluster
from capture4d.runs.cluster.worker_side import HANDED_ON, Work, facts, run_one, same_bytes, unfit

__all__ = ["ClusterLostError", "cluster_jobs"]

RETRIES = 3
"""How often a job is tried again after a fault that is not its input's, such as that of a file server."""
LOST_TWICE = 2
"""How often a job is handed in again that the scheduler has given up: each time, up to three frames more are known to
end their workers, and left out."""
CONNECT_S = 15
"""How long a scheduler may take to answer."""
INSTALL = "expected Dask, which is not installed; run: pip install 'capture4d[cluster]'"


class ClusterLostError(RuntimeError):
    """The cluster has not brought a job to its end."""


def cluster_jobs(
    cluster: Cluster, function: Callable[..., Any], jobs: Sequence[Any], prepare: Callable[[], Any] | None
) -> Iterator[tuple[int, Any]]:
    """Do the jobs on a cluster; yields the place of each and its result, as they come.

    Raises:
        InputError: Dask is not installed, nobody answers at the address, or a worker is not fit for the work.
        ClusterLostError: a job ended its workers again and again, or the scheduler is gone.
    """
    client = _client(cluster)
    from distributed import as_completed
    from distributed.client import FutureCancelledError
    from distributed.comm.core import CommClosedError
    from distributed.scheduler import KilledWorker

    environment = {name: value for name, value in os.environ.items() if name.startswith(HANDED_ON)}
    name = secrets.token_hex(8)
    work = Work(name, cluster.command, function, prepare, str(Path.cwd()), environment, facts())
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sending large graph", category=UserWarning)
        shared = client.submit(same_bytes, pickle.dumps(work), pure=False, retries=RETRIES)

    def submitted(at: int) -> Any:
        return client.submit(run_one, name, shared, pickle.dumps(jobs[at]), pure=False, retries=RETRIES)

    places = {submitted(at): at for at in range(len(jobs))}
    given_up = [0] * len(jobs)
    try:
        finished = as_completed(list(places), loop=client.loop)
        for future in finished:
            at = places.pop(future)
            fault = future.exception()
            if isinstance(fault, KilledWorker) and given_up[at] < LOST_TWICE:
                given_up[at] += 1
                again = submitted(at)
                places[again] = at
                finished.add(again)
                continue
            if isinstance(fault, KilledWorker | CommClosedError | FutureCancelledError):
                raise ClusterLostError(_lost(cluster, fault))
            if fault is not None:
                raise fault
            result, fault = future.result()
            if fault is not None:
                raise fault
            yield at, result
    except (CommClosedError, FutureCancelledError, TimeoutError) as error:
        raise ClusterLostError(_lost(cluster, error)) from None
    finally:
        if places:
            client.cancel(list(places), force=True)


def _lost(cluster: Cluster, fault: BaseException) -> str:
    if type(fault).__name__ == "KilledWorker":
        return "a job has ended every worker that did it, perhaps for want of memory"
    return f"the scheduler at {cluster.address} does not answer any more"


def _client(cluster: Cluster) -> Any:
    """The connection to a cluster whose workers are fit, made when it is first needed."""
    if cluster.client is not None:
        return cluster.client
    try:
        from distributed import Client
    except ImportError:
        raise InputError(f"--scheduler: {INSTALL}") from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters is said by us, in one line
    try:
        client = Client(cluster.address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        reason = " ".join(str(error).split())[:160]
        raise InputError(
            f"--scheduler: expected a scheduler such as tcp://HOST:8786, found none at {cluster.address} ({reason})"
        ) from None
    try:
        if not client.scheduler_info(n_workers=-1)["workers"]:
            say(f"the scheduler at {cluster.address} has no workers yet; waiting for the first")
            client.wait_for_workers(1)
        _require_fit(client)
    except BaseException:
        client.close()
        raise
    cluster.client = client
    return client


def _require_fit(client: Any) -> None:
    """See that the workers there are compute what this machine would; those that come later look for themselves."""
    expected = facts()
    for address, found in client.run(facts, on_error="return").items():
        if isinstance(found, ModuleNotFoundError):
            raise InputError(f"--scheduler: worker {address}: expected capture4d to be installed, found {found}")
        wrong = str(found) if isinstance(found, Exception) else unfit(expected, found)
        if wrong:
            raise InputError(f"--scheduler: worker {address}: {wrong}")
    for address, worker in client.scheduler_info(n_workers=-1)["workers"].items():
        if worker["nthreads"] != 1:
            raise InputError(
                f"--scheduler: worker {address}: expected one thread (dask worker --nthreads 1), found "
                f"{worker['nthreads']}"
            )
