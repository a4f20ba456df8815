"""Workers that are kept from step to step, and replaced when they are killed."""

from __future__ import annotations

import os
import signal
import time
from functools import partial
from pathlib import Path

import pytest

from capture4d.errors import InputError
from capture4d.runs.processes.pool import WorkerPool, cpu_of_workers, kept_workers
from capture4d.runs.workers import run_jobs


def where(job: int) -> int:
    time.sleep(0.05)
    return os.getpid()


def where_with(prepared: str, job: int) -> tuple[str, int]:
    return prepared, os.getpid()


def named(name: str) -> str:
    return name


def die_once(folder: Path, job: int) -> int:
    if job == 2 and not (folder / "died").exists():
        (folder / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return job


def complain(job: int) -> int:
    raise InputError("expected cloth")


def is_running(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().split()[2] != "Z"
    except FileNotFoundError:
        return False


def test_processes_go_from_step_to_step_and_none_is_left() -> None:
    with kept_workers():
        first = set(run_jobs(where, range(6), workers=2, label="one"))
        prepared = [
            set(run_jobs(where_with, range(3), prepare=partial(named, name), workers=2, label=name)) for name in "ab"
        ]
        assert cpu_of_workers() > 0
        assert all(is_running(process) for process in first)
    assert len(first) <= 2
    for name, found in zip("ab", prepared, strict=True):
        assert {each for each, _ in found} == {name}
        assert {process for _, process in found} <= first
    assert not any(is_running(process) for process in first)
    assert cpu_of_workers() == 0


def test_a_killed_worker_is_replaced_and_a_fault_leaves_none(tmp_path: Path) -> None:
    (tmp_path / "work").mkdir()
    prepare = partial(Path, tmp_path / "work")
    with kept_workers():
        assert sorted(run_jobs(die_once, range(5), prepare=prepare, workers=2, label="die")) == list(range(5))
        before = set(run_jobs(where, range(4), workers=2, label="where"))
        with pytest.raises(InputError, match="expected cloth"):
            list(run_jobs(complain, range(4), workers=2, label="complain"))
        assert not any(is_running(process) for process in before)
        assert not before & set(run_jobs(where, range(4), workers=2, label="again"))


def test_a_pool_tells_what_its_processes_have_cost() -> None:
    pool = WorkerPool(1)
    assert [at for at, _ in pool.run(where, [0, 1], None)] == [0, 1]
    assert len(pool.cpu_s) == 1
    assert min(pool.cpu_s.values()) > 0
    pool.end()
    assert not pool.cpu_s
