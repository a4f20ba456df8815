"""Where expensive things that can be made again are kept between runs: the user's cache folder."""

from __future__ import annotations

import os
from pathlib import Path

import platformdirs

__all__ = ["cache_path", "user_cache_folder"]


def cache_path() -> Path:
    """Where the cache folder is, or would be; `CAPTURE4D_CACHE` names another one."""
    override = os.environ.get("CAPTURE4D_CACHE")
    return Path(override) if override else Path(platformdirs.user_cache_dir("capture4d", appauthor=False))


def user_cache_folder() -> Path:
    """The cache folder, made if absent."""
    folder = cache_path()
    folder.mkdir(parents=True, exist_ok=True)
    return folder
