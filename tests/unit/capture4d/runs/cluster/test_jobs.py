"""`run_jobs` on a Dask cluster of two workers."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from capture4d.errors import InputError
from capture4d.runs.cluster.scheduler import chosen_cluster, use_scheduler
from capture4d.runs.cluster.worker_side import THREAD_VARIABLES, facts, unfit
from capture4d.runs.workers import WorkerDied, run_jobs, shared

pytest.importorskip("distributed")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning", "ignore::UserWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """A scheduler on this machine; its workers find the jobs of the tests, as they find capture4d."""
    import dask
    from distributed import LocalCluster

    sys.path.insert(0, str(Path(__file__).parent))
    try:
        with (
            dask.config.set({"distributed.scheduler.allowed-failures": 1}),
            LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0", memory_limit=0) as cluster,
        ):
            yield cluster.scheduler_address
    finally:
        sys.path.remove(str(Path(__file__).parent))


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    import jobs_of_tests

    return jobs_of_tests


def test_results_come_as_from_local_workers(address: str, given) -> None:
    with use_scheduler(address):
        assert sorted(run_jobs(given.add, range(7), prepare=shared(10), workers=1, label="add")) == list(range(10, 17))
        assert sorted(run_jobs(given.add, [1], prepare=shared(5), workers=1, label="add")) == [6]
    assert chosen_cluster() is None


def test_workers_go_where_the_command_was_started(
    address: str, given, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with use_scheduler(address):
        assert list(run_jobs(given.where, [0], workers=1, label="where")) == [str(tmp_path)]


def test_a_frame_that_ends_its_workers_is_given_up_and_the_others_are_done(address: str, given, tmp_path: Path) -> None:
    with use_scheduler(address):
        found = list(run_jobs(given.write_or_die, range(6), prepare=shared(tmp_path), workers=1, label="frames"))
    assert sorted(found)[:1] == ["3 workers of the cluster were ended while they worked on this frame"]
    assert found.count("done") == 5
    assert (tmp_path / "killed").read_bytes() == b"..."
    assert [path.name for path in tmp_path.iterdir()] == ["killed"], "notes are removed"


def test_what_is_wrong_with_the_input_is_told_at_once_and_other_faults_are_tried_again(
    address: str, given, tmp_path: Path
) -> None:
    with use_scheduler(address):
        with pytest.raises(InputError, match=r"000004\.ply: cut off"):
            list(run_jobs(given.fail, [4], workers=1, label="fail"))
        assert list(run_jobs(given.fail_twice, [4], prepare=shared(tmp_path), workers=1, label="fail")) == [4]


def test_a_job_that_ends_every_worker_ends_the_command_with_a_line(
    address: str, given, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("capture4d.runs.cluster.jobs.LOST_TWICE", 0)
    with use_scheduler(address), pytest.raises(WorkerDied, match="register: a job has ended every worker"):
        list(run_jobs(given.die, [0], workers=1, label="register"))


def test_nobody_at_the_address_is_one_line(given, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("capture4d.runs.cluster.jobs.CONNECT_S", 0.5)
    for address in ("tcp://127.0.0.1:9", "nowhere"):
        with use_scheduler(address), pytest.raises(InputError, match=f"found none at {address}") as fault:
            list(run_jobs(given.add, [0, 1], prepare=shared(1), workers=1, label="add"))
        assert "\n" not in str(fault.value)


def test_without_dask_the_line_says_how_to_install_it(given, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with use_scheduler("tcp://127.0.0.1:8786"), pytest.raises(InputError, match=r"pip install 'capture4d\[cluster\]'"):
        list(run_jobs(given.add, [0, 1], prepare=shared(1), workers=1, label="add"))


def test_other_versions_and_more_threads_are_named() -> None:
    here = {**facts(), **dict.fromkeys(THREAD_VARIABLES, "1")}
    assert unfit(here, here) == ""
    assert unfit(here, {**here, "numpy": "1.0"}) == f"expected numpy {here['numpy']} as here, found 1.0"
    assert "expected OMP_NUM_THREADS=1 in its environment" in unfit(here, {**here, "OMP_NUM_THREADS": "unset"})
