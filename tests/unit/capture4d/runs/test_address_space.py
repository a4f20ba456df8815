"""A small `ulimit -v` is one line, not a crash of some library."""

import resource
import subprocess
import sys
from pathlib import Path

import pytest

from capture4d.runs.address_space import memory_fault, require_address_space


def limited(limit: int, *arguments: object) -> subprocess.CompletedProcess[str]:
    def lower() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))

    command = [sys.executable, "-m", "capture4d", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, preexec_fn=lower)


@pytest.mark.parametrize(("limit", "command", "needs"), [
    (2_048_000_000, "run", "2.5"), (500_000_000, "check", "1"), (300_000_000, "convert-body", "0.4"),
])  # fmt: skip
def test_too_little_address_space_is_one_line(tmp_path: Path, limit: int, command: str, needs: str) -> None:
    done = limited(limit, command, tmp_path, *(() if command == "check" else ("--output", tmp_path / "x")))
    assert done.returncode == 1
    assert done.stderr == (
        f"capture4d: the system gives this process at most {limit / 1e9:.3g} GB of address space (ulimit -v); "
        f"capture4d {command} needs {needs} GB and more for large files\n"
    )
    assert not (tmp_path / "x").exists()


def test_help_needs_none(tmp_path: Path) -> None:
    assert limited(200_000_000, "--help").returncode == 0


def test_without_a_limit_every_command_begins() -> None:
    require_address_space("run")


def test_what_says_that_memory_is_out_is_told_from_other_faults() -> None:
    for error in (MemoryError(), ImportError("libx.so: failed to map segment from shared object")):
        said = memory_fault(error)
        assert said is not None
        assert said.startswith("out of memory: ")
    assert memory_fault(ImportError("No module named 'x'")) is None
    assert memory_fault(ValueError("cannot map")) is None
