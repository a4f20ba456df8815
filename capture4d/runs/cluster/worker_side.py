"""What runs in a cluster's worker: look whether it is fit for the work, prepare once, then one job after the other."""

from __future__ import annotations

import os
import pickle
import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import metadata
from typing import Any

from capture4d.errors import InputError
from capture4d.runs.cluster.attempts import count_attempts, end_frames

__all__ = ["THREAD_VARIABLES", "Work", "facts", "run_one", "same_bytes", "unfit"]

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""What numerical libraries read as they load; with more than one thread, sums come out in another order."""
PACKAGES = ("capture4d", "numpy", "scipy", "numba", "torch", "open3d", "anny")
"""Whose versions have to be the command's."""
HANDED_ON = "CAPTURE4D_"
"""Beginning of the variables of the command's environment that hold for workers, too."""


@dataclass(frozen=True, slots=True)
class Work:
    """What all jobs of one call share, as it travels to workers."""

    name: str
    """Another for every call."""
    command: str
    """Another for every command."""
    function: Callable[..., Any]
    prepare: Callable[[], Any] | None
    folder: str
    """Where the command was started: its relative paths are from there."""
    environment: Mapping[str, str]
    facts: Mapping[str, str]
    """Of the command's own Python."""


def facts() -> dict[str, str]:
    """Versions that results may depend on, and threads."""
    found = {"python": ".".join(platform.python_version_tuple()[:2])}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "none"
    return {**found, **{name: os.environ.get(name, "unset") for name in THREAD_VARIABLES}}


def unfit(expected: Mapping[str, str], found: Mapping[str, str]) -> str:
    """What is wrong with a worker; empty if nothing is."""
    for name in ("python", *PACKAGES):
        if found.get(name) != expected.get(name):
            return f"expected {name} {expected.get(name)} as here, found {found.get(name)}"
    for name in THREAD_VARIABLES:
        if found.get(name) != "1":
            return f"expected {name}=1 in its environment before numpy loads, found {found.get(name)}"
    return ""


def same_bytes(pickled: bytes) -> bytes:
    """A task that holds the work: a worker that is lost with it costs nothing, for the scheduler makes it again."""
    return pickled


_name: str | None = None
_work: Work | None = None
_given: tuple[Any, ...] = ()
"""Of this process: the work that it does, opened and prepared."""


def run_one(name: str, pickled: bytes, job: bytes) -> Any:
    """Do one job of a work: (result, None), or (None, the fault) where the input is at fault and trying again is idle.

    Args:
        name: of the work.
        pickled: the work.
        job: pickled.
    """
    try:
        work = _opened(name, pickled)
        return work.function(*_given, pickle.loads(job)), None
    except InputError as error:
        return None, error
    finally:
        end_frames()


def _opened(name: str, pickled: bytes) -> Work:
    global _name, _work, _given
    if _work is not None and _name == name:
        return _work
    _name, _work, _given = None, None, ()
    work = pickle.loads(pickled)
    wrong = unfit(work.facts, facts())
    if wrong:
        raise InputError(f"--scheduler: worker on {platform.node()}: {wrong}")
    try:
        os.chdir(work.folder)
    except OSError as error:
        raise InputError(
            f"--scheduler: worker on {platform.node()}: expected the folder {work.folder} as here, for all machines "
            f"share it; found none ({error.strerror})"
        ) from None
    os.environ.update(work.environment)
    count_attempts(work.command)
    _given = () if work.prepare is None else (work.prepare(),)
    _name, _work = name, work
    return work
