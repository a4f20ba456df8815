"""Settings may be named."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from capture4d.errors import InputError

__all__ = ["chosen"]

Config = TypeVar("Config")


def chosen(config: Config | str | None, presets: Mapping[str, Config]) -> Config:
    """The settings themselves; those of the first preset if none are given.

    Raises:
        InputError: there is no preset of that name.
    """
    if config is None:
        return next(iter(presets.values()))
    if not isinstance(config, str):
        return config
    if config not in presets:
        raise InputError(f"config: expected one of {', '.join(presets)}, found '{config}'")
    return presets[config]
