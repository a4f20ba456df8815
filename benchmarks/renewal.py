"""Results in the user's cache folder outlive the code that made them."""

from __future__ import annotations

from collections.abc import Callable

from capture4d.errors import StaleError

__all__ = ["renew"]


def renew(stage: Callable[..., object]) -> None:
    """Run a stage on its folder in the cache; from the start if that has other settings or inputs than today's.

    Args:
        stage: takes `overwrite`.
    """
    try:
        stage()
    except StaleError:
        stage(overwrite=True)
