"""Settings out of range, by the name of the option that made them so."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, get_type_hints

from capture4d.errors import InputError
from capture4d.settings import SettingError, check_fields

__all__ = ["check_command"]


def check_command(command: Any, faults: Sequence[SettingError], arguments: Sequence[str]) -> None:
    """See that a command can be run.

    Args:
        command: the command, its options parsed.
        faults: what was found wrong with its settings when they were made.
        arguments: its command line.
    Raises:
        InputError: a setting, or an option of the command's own, is out of range; the message names the option.
    """
    if faults:
        raise _renamed(faults[0], command, arguments)
    try:
        check_fields(command)
    except SettingError as fault:
        raise _renamed(fault, command, arguments) from None


def _renamed(fault: SettingError, command: Any, arguments: Sequence[str]) -> InputError:
    for names, settings in _settings(command):
        if settings is fault.settings:
            option = _plain(f"--{'.'.join((*names, fault.field))}")
            given = (argument.partition("=")[0] for argument in arguments if argument.startswith("--"))
            typed = next((argument for argument in given if _plain(argument) == option), option)
            return InputError(f"{typed}: {fault.said}")
    return fault


def _plain(option: str) -> str:
    return option.replace("_", "-")


def _settings(command: Any) -> Iterator[tuple[tuple[str, ...], Any]]:
    """A command and all settings in it, with what stands before the names of their options."""
    yield (), command
    for name, hint in get_type_hints(type(command), include_extras=True).items():
        renamed = (getattr(entry, "name", None) for entry in getattr(hint, "__metadata__", ()))
        shown = next((entry for entry in renamed if entry is not None), name)
        yield from _inside(getattr(command, name), (shown,) if shown else ())


def _inside(settings: Any, names: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    if dataclasses.is_dataclass(settings):
        yield names, settings
        for field in dataclasses.fields(settings):
            yield from _inside(getattr(settings, field.name), (*names, field.name))
