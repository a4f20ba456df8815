"""A command line to a command: what is wrong with it is one line that names the option."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping, Sequence
from typing import Any

import tyro

from capture4d.cli.faults import check_command
from capture4d.cli.option_tree import Option, options_of
from capture4d.errors import CommandLineError
from capture4d.settings import gathered_faults

__all__ = ["FORMER_SPELLINGS", "command_options", "parse"]

FORMER_SPELLINGS: Mapping[tuple[str, str], str] = {
    ("register-mesh", "--boundary-colour"): "--border-colour",
    ("run", "--track"): "--tracked",
    ("check", "--frames"): "--pattern",
    ("compare", "--gap"): "--held-out-gap",
}
"""What options were called, and are. Settings that have moved below a name, such as `--graph.nodes`, which is
`--registration.graph.nodes`, are found by the end of their names."""


def parse(name: str, kind: type, arguments: Sequence[str], presets: Mapping[str, Any] | None) -> Any:
    """The command with its options. A --preset decides what the other settings start from.

    Args:
        name: of the command, as it is typed.
        presets: settings by the name of their preset, if the command has any.
    Raises:
        CommandLineError: no such option, something missing, or a value that cannot be read.
        InputError: an option is out of range.
    """
    default = _preset(kind, arguments, presets)
    _check(name, command_options(kind, arguments, presets), arguments)
    with gathered_faults() as faults:  # tyro would print a page about each
        parsed = tyro.cli(
            kind, prog=f"capture4d {name}", args=list(arguments), default=default, config=(tyro.conf.AvoidSubcommands,)
        )
    check_command(parsed, faults, arguments)
    return parsed


def command_options(kind: type, arguments: Sequence[str], presets: Mapping[str, Any] | None) -> list[Option]:
    """The options of a command, with the defaults of the preset that its command line names."""
    return options_of(kind, _preset(kind, arguments, presets))


def _preset(kind: type, arguments: Sequence[str], presets: Mapping[str, Any] | None) -> Any:
    """A command whose settings are those of the preset; None if it has no presets."""
    if not presets:
        return None
    given = _value_of("--preset", arguments) or next(iter(presets))
    if given not in presets:
        return None
    required = {
        entry.name: tyro.MISSING
        for entry in dataclasses.fields(kind)
        if entry.default is entry.default_factory is dataclasses.MISSING
    }
    return kind(**required, preset=given, config=presets[given])


def _value_of(option: str, arguments: Sequence[str]) -> str | None:
    for index, argument in enumerate(arguments):
        if argument == option:
            return next(iter(arguments[index + 1 :]), None)
        if argument.startswith(f"{option}="):
            return argument.partition("=")[2]
    return None


# --- what is wrong with a command line -----------------------------------------------------------------------------


def _check(name: str, options: Sequence[Option], arguments: Sequence[str]) -> None:
    """
    Raises:
        CommandLineError: it cannot be understood.
    """
    help_ = f"(see capture4d {name} --help)"
    by_name = {option.spelling: option for option in options if not option.is_positional}
    switches = {option.negation for option in by_name.values() if option.kind is bool}
    places = [option for option in options if option.is_positional]
    given, loose, left = set(), [], list(arguments)
    while left:
        word = left.pop(0)
        if not word.startswith("--"):
            loose.append(word)
            continue
        typed, has_value, value = word.partition("=")
        spelling = typed.replace("_", "-")
        option = by_name.get(spelling)
        if option is None and spelling not in switches:
            raise CommandLineError(f"{typed}: no such option{_hint(name, spelling, [*by_name, *switches])} {help_}")
        if option is None or option.most == 0:
            if has_value:
                raise CommandLineError(f"{typed}: expected no value, found '{value}' {help_}")
            continue
        given.add(spelling)
        values = [value] if has_value else []
        while left and len(values) < option.most and not left[0].startswith("--"):
            values.append(left.pop(0))
        _check_values(typed, option, values)
    _check_places(places, loose, help_)
    missing = [option for option in by_name.values() if option.is_required and option.spelling not in given]
    if missing:
        said = f"expected, and missing: {missing[0].text.rstrip('.')}"
        raise CommandLineError(f"{missing[0].spelling} {missing[0].metavar}: {said} {help_}")


def _check_values(typed: str, option: Option, values: Sequence[str]) -> None:
    if len(values) < option.fewest:
        expected = "a value" if option.fewest == 1 else f"{option.fewest} values"
        raise CommandLineError(f"{typed}: expected {expected} ({option.metavar}), found {len(values) or 'none'}")
    for value in values:
        fault = option.fault(value)
        if fault is not None:
            near = difflib.get_close_matches(value, option.kind, n=1) if isinstance(option.kind, tuple) else []
            hint = f"; did you mean {near[0]}?" if near else ""
            raise CommandLineError(f"{typed}: expected {fault}, found '{value}'{hint}")


def _check_places(places: Sequence[Option], loose: Sequence[str], help_: str) -> None:
    """See that arguments without a name are as many as there are places for them."""
    needed = [option for option in places if option.is_required and option.fewest]
    if len(loose) < len(needed):
        option = needed[len(loose)]
        raise CommandLineError(f"{option.spelling}: expected, and missing: {option.text.rstrip('.')} {help_}")
    most = sum(option.most for option in places)
    if len(loose) > most:
        raise CommandLineError(f"'{loose[int(most)]}': expected an option, or nothing more {help_}")


def _hint(name: str, spelling: str, known: Sequence[str]) -> str:
    """Which option is meant by one that is not there."""
    now = FORMER_SPELLINGS.get((name, spelling))
    if now is None:
        ends = [each for each in known if each.endswith(f".{spelling[2:]}")]
        now = ends[0] if len(ends) == 1 else None
    if now is not None:
        return f"; it is called {now}"
    near = difflib.get_close_matches(spelling, known, n=1)
    return f"; did you mean {near[0]}?" if near else ""
