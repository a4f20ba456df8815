"""The schedule of a long take, and what its runs have taken."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

from benchmarks.long import _cpu_of, makespan


@pytest.mark.parametrize(
    ("jobs", "cores", "wanted"),
    [([3.0, 1.0, 1.0, 1.0], 2, 3.0), ([1.0, 1.0, 1.0, 3.0], 2, 4.0), ([2.0] * 5, 2, 6.0), ([2.0] * 5, 50, 2.0)],
)
def test_jobs_go_to_the_core_that_is_free_first(jobs: list[float], cores: int, wanted: float) -> None:
    assert makespan(jobs, cores) == wanted


def test_the_cpu_time_of_a_run_counts_its_children() -> None:
    busy = "import time\nwhile time.process_time() < 0.3: pass"
    script = f"import subprocess, sys, time\nsubprocess.run([sys.executable, '-c', {busy!r}])\ntime.sleep(60)"
    process = subprocess.Popen([sys.executable, "-c", script])
    try:
        deadline = time.monotonic() + 60
        while _cpu_of(process.pid) < 0.3:
            assert time.monotonic() < deadline
            time.sleep(0.1)
    finally:
        process.kill()
        process.wait()
    assert _cpu_of(os.getpid()) > 0
