"""Two commands never write to one place, and no kill leaves it locked."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from capture4d.errors import InputError
from capture4d.runs.locks import LOCK, alone

HOLD = """
import sys, time
from pathlib import Path
from capture4d.runs.locks import alone
with alone(Path(sys.argv[1]), folder=sys.argv[2] == "folder"):
    print("held", flush=True)
    time.sleep(float(sys.argv[3]))
"""


@contextmanager
def held_elsewhere(output: Path, *, folder: bool, seconds: float = 60) -> Iterator[subprocess.Popen[str]]:
    arguments = [str(output), "folder" if folder else "file", str(seconds)]
    process = subprocess.Popen([sys.executable, "-c", HOLD, *arguments], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.mark.parametrize("folder", [True, False])
def test_the_second_is_refused_and_a_kill_frees_the_place(tmp_path: Path, folder: bool) -> None:
    output = tmp_path / "work"
    with held_elsewhere(output, folder=folder) as process:
        with (
            pytest.raises(InputError, match="another capture4d command is writing there") as caught,
            alone(output, folder=folder),
        ):
            pass
        assert caught.value.where == str(output)
        with alone(tmp_path / "another", folder=folder):
            pass
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        with alone(output, folder=folder):
            assert any(path.name.endswith(LOCK) for path in tmp_path.rglob(".*"))
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]  # nothing was written, so nothing is left


def test_whoever_waits_comes_next(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with held_elsewhere(tmp_path, folder=True, seconds=0.7):
        began = time.monotonic()
        with alone(tmp_path, folder=True, wait=True):
            assert time.monotonic() - began > 0.3
    assert "waiting for the command that is writing to" in capsys.readouterr().err


def test_what_was_written_stays(tmp_path: Path) -> None:
    with alone(tmp_path / "a" / "b", folder=True):
        (tmp_path / "a" / "b" / "c.txt").write_text("kept")
    assert [path.name for path in (tmp_path / "a" / "b").iterdir()] == ["c.txt"]


def test_at_most_one_of_many_is_inside(tmp_path: Path) -> None:
    """Holders that come and go remove their lock file: whoever opened it before must not take that for the lock."""
    script = textwrap.dedent("""
        import os, sys
        from pathlib import Path
        from capture4d.runs.locks import alone
        place = Path(sys.argv[1])
        for _ in range(150):
            with alone(place, folder=True, wait=True):
                handle = os.open(place / "inside", os.O_CREAT | os.O_EXCL)  # fails if somebody is inside
                os.close(handle)
                os.unlink(place / "inside")
    """)
    quick = "import capture4d.runs.locks as locks\nlocks._POLL_S = 0.0001\n" + script
    running = [
        subprocess.Popen([sys.executable, "-c", quick, str(tmp_path)], stderr=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    said = [process.communicate(timeout=120)[1] for process in running]
    assert [process.returncode for process in running] == [0, 0, 0], said


def test_two_commands_on_one_work_folder(tube_capture: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "capture4d", "extract", str(tube_capture), "--output", str(tmp_path / "work")]
    with held_elsewhere(tmp_path / "work", folder=True):
        done = subprocess.run([*command, "--workers", "1"], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr == (
        f"capture4d: {tmp_path / 'work'}: another capture4d command is writing there; "
        "run this one when it has ended, or with --wait\n"
    )
    assert not any((tmp_path / "work").glob("garment*"))


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "capture4d", *map(str, arguments)]


@pytest.mark.slow
@pytest.mark.parametrize("fixes", [True, False])
def test_a_command_says_wait_only_where_it_can(tmp_path: Path, fixes: bool) -> None:
    output = tmp_path / ("take-fixed" if fixes else "out.bvh")
    arguments = ("check", tmp_path / "take", "--fix") if fixes else ("convert-poses", tmp_path / "in.npz", output)
    with held_elsewhere(output, folder=False):
        done = subprocess.run(command(*arguments), capture_output=True, text=True, check=False)
    said = "another capture4d command is writing there; run this one when it has ended"
    assert (done.returncode, done.stderr) == (1, f"capture4d: {output}: {said}\n")


@pytest.mark.slow
def test_a_command_that_is_terminated_says_so_and_leaves_no_lock(tmp_path: Path) -> None:
    """While it waits for another one: there nothing is done yet, and the signal cannot come too late."""
    with held_elsewhere(tmp_path / "work", folder=True):
        arguments = command("extract", tmp_path / "take", "--output", tmp_path / "work", "--wait")
        with subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True) as process:
            assert process.stderr is not None
            assert "waiting for the command" in process.stderr.readline()
            process.terminate()
            said = process.stderr.read()
        assert process.returncode == 143
        assert said.startswith("capture4d: terminated;")
        assert said.count("\n") == 1
    with alone(tmp_path / "work", folder=True):
        pass
