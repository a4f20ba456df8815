"""Which cluster does the work: a Dask scheduler's address, for as long as a command or a `with` lasts."""

from __future__ import annotations

import contextlib
import secrets
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

__all__ = ["Cluster", "chosen_cluster", "use_scheduler"]


@dataclass(eq=False)
class Cluster:
    """A scheduler, and the connection to it once there is one."""

    address: str
    command: str = field(default_factory=lambda: secrets.token_hex(4))
    """Name of what uses it, another every time."""
    client: Any = None
    """A `distributed.Client`, of which nothing but `cluster.jobs` knows."""


_cluster: ContextVar[Cluster | None] = ContextVar("cluster that does the work", default=None)


@contextlib.contextmanager
def use_scheduler(address: str | None) -> Iterator[None]:
    """Let the workers of a Dask scheduler do what is done meanwhile in this thread, in place of local processes.

    Args:
        address: such as "tcp://head:8786"; None leaves the work here.
    """
    cluster = None if address is None else Cluster(address)
    token = _cluster.set(cluster)
    try:
        yield
    finally:
        _cluster.reset(token)
        if cluster is not None and cluster.client is not None:
            cluster.client.close()


def chosen_cluster() -> Cluster | None:
    """The cluster that does the work; None if it is done here."""
    return _cluster.get()
