"""Where expensive things that can be made again are kept between runs: the user's cache folder, or the next best.

A container may have no home, or one that nothing can be written to, and code that is installed read-only: then it is a
folder of the user's among the temporary ones. What lies beside the code, or nowhere, costs time and nothing else.
"""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

import platformdirs

__all__ = ["cache_path", "can_write", "kernel_cache", "user_cache_folder", "usual_cache_path"]


def cache_path() -> Path:
    """Where the cache folder is, or would be; `CAPTURE4D_CACHE` names another one."""
    override = os.environ.get("CAPTURE4D_CACHE")
    if override:
        return Path(override)
    usual = usual_cache_path()
    return usual if usual is not None and can_write(usual) else _temporary_path()


def usual_cache_path() -> Path | None:
    """Where it is for a user with a home; None for one without."""
    try:
        usual = Path(platformdirs.user_cache_dir("capture4d", appauthor=False))
    except RuntimeError:  # neither HOME nor an entry among the users
        return None
    return usual if usual.is_absolute() else None


def user_cache_folder() -> Path:
    """The cache folder, made if absent.

    Raises:
        OSError: it cannot be made; names it.
    """
    folder = cache_path()
    folder.mkdir(parents=True, exist_ok=True, mode=0o700 if folder == _temporary_path() else 0o777)
    return folder


def kernel_cache() -> Path | None:
    """Where compiled kernels are kept if they cannot be kept beside the code; None where they can."""
    return None if can_write(Path(__file__).parent) else cache_path() / "kernels"


def can_write(folder: Path) -> bool:
    """Whether a folder, made if need be, could be written to."""
    there = next((each for each in (folder, *folder.parents) if os.path.lexists(each)), None)
    return there is not None and there.is_dir() and os.access(there, os.W_OK | os.X_OK)


def _temporary_path() -> Path:
    """A folder of this user's alone: what others could put there would be run."""
    user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "user")
    folder = Path(tempfile.gettempdir()) / f"capture4d-{user}"
    try:
        found = folder.lstat()
    except OSError:
        return folder
    theirs = hasattr(os, "getuid") and (found.st_uid != os.getuid() or found.st_mode & 0o022)
    return Path(tempfile.mkdtemp(prefix="capture4d-")) if theirs or not stat.S_ISDIR(found.st_mode) else folder
