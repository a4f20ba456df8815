"""There is a place for what can be made again, also where neither home nor code can be written to."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from capture4d import cache, heavy_imports
from capture4d.cache import cache_path, can_write, kernel_cache, user_cache_folder


@pytest.fixture
def homeless(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No home at all, as for a user of a container without an entry; the temporary folder."""
    for name in ("CAPTURE4D_CACHE", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)

    def none(*_: object, **__: object) -> str:
        raise RuntimeError("could not determine the home directory")

    monkeypatch.setattr(cache.platformdirs, "user_cache_dir", none)
    monkeypatch.setattr(cache.tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_without_a_home_it_is_a_folder_of_the_users_alone(homeless: Path) -> None:
    folder = user_cache_folder()
    assert folder.parent == homeless
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert user_cache_folder() == folder  # what was kept is found again


@pytest.mark.parametrize("kind", ["open to all", "a link"])
def test_a_folder_that_somebody_else_may_have_made_is_not_used(homeless: Path, kind: str) -> None:
    """Kernels are run from it."""
    planted = homeless / f"capture4d-{os.getuid()}"
    if kind == "a link":
        planted.symlink_to("/", target_is_directory=True)
    else:
        planted.mkdir()
        planted.chmod(0o777)
    assert cache_path() != planted


def test_a_home_that_cannot_be_written_to_is_none(homeless: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache.platformdirs, "user_cache_dir", lambda *_, **__: "/proc/nowhere/cache")
    monkeypatch.setattr(cache, "can_write", lambda folder: "proc" not in folder.parts)
    assert cache_path().parent == homeless


def test_what_a_user_names_is_taken(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CAPTURE4D_CACHE", str(tmp_path / "mine"))
    assert cache_path() == tmp_path / "mine"


def test_a_file_is_no_place(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert can_write(tmp_path / "new" / "folder")
    assert not can_write(tmp_path / "file" / "folder")


def test_kernels_go_where_they_can(homeless: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert kernel_cache() is None  # beside the code
    monkeypatch.setattr(cache, "can_write", lambda folder: False)
    assert kernel_cache() == cache_path() / "kernels"


def test_a_kernel_that_can_be_kept_nowhere_is_compiled_all_the_same() -> None:
    """numba refuses to cache what has no file of its own."""
    names: dict[str, object] = {"njit": heavy_imports.njit}
    exec("@njit(cache=True)\ndef twice(number):\n    return 2 * number", names)
    assert names["twice"](21) == 42  # pyright: ignore[reportCallIssue]


def test_the_command_runs_without_a_home() -> None:
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-m", "capture4d", "doctor", "--no-load", "--json"],
        capture_output=True, text=True, env=environment, check=False,
    )  # fmt: skip
    assert "Traceback" not in done.stderr
    assert '"kernels"' in done.stdout
