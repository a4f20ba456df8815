"""The options of a command, read off its dataclass: how each is spelt, what it takes and what is said of it.

tyro parses by the same dataclasses; a test holds the two together.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import math
import sys
import types
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.conf import Positional, UseAppendAction

from capture4d.settings import Range

__all__ = ["Option", "options_of", "summary_of"]

_POSITIONAL, _APPEND = get_args(Positional[int])[1], get_args(UseAppendAction[int])[1]
_WORDS = {int: "N", float: "X", str: "TEXT", Path: "PATH"}
"""What stands for a value in the help."""
_MANY = math.inf


@dataclasses.dataclass(frozen=True, slots=True)
class Option:
    """One option, or one argument that stands in its place without a name."""

    spelling: str
    """`--sequence.segment`; of an argument its metavar."""
    is_positional: bool
    kind: Any
    """Type of one value: int, float, str, Path, bool, or a tuple of choices."""
    fewest: int
    most: float
    """Values it takes, infinitely many for a list; none for a switch."""
    metavar: str
    default: Any
    """`dataclasses.MISSING` if it has to be given."""
    text: str
    """One paragraph; empty if nobody wrote one."""
    owner: type
    """The class that it is a field of, where it was declared."""
    depth: int
    """0 for the command's own, 1 for those of settings that the command names, more for settings inside those."""

    @property
    def is_required(self) -> bool:
        return self.default is dataclasses.MISSING

    @property
    def is_expert(self) -> bool:
        """Whether only those look for it who know what it belongs to."""
        return self.depth > 1

    @property
    def negation(self) -> str:
        """Of a switch, what turns it off."""
        *groups, name = self.spelling[2:].split(".")
        return f"--{'.'.join((*groups, f'no-{name}'))}"

    def fault(self, value: str) -> str | None:
        """What is expected where a value cannot be read; None where it can."""
        if isinstance(self.kind, tuple):
            return None if value in self.kind else f"one of {', '.join(self.kind)}"
        try:
            self.kind(value)
        except ValueError:
            return "a whole number" if self.kind is int else "a number"
        return None


def options_of(command: type, default: Any = None) -> list[Option]:
    """Every option of a command, in the order of its fields.

    Args:
        default: a command whose values are the defaults, as a preset makes it; those of the class if None.
    """
    return list(_options(command, default, (), 0))


def summary_of(kind: type) -> str:
    """The first paragraph of a class' docstring."""
    return " ".join((inspect.getdoc(kind) or "").split("\n\n")[0].split())


def _options(kind: type, made: Any, names: tuple[str, ...], depth: int) -> Iterator[Option]:
    hints, texts = get_type_hints(kind, include_extras=True), _texts(kind)
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        notes = [note for note in _notes(hint) if hasattr(note, "metavar")]
        renamed = next((note.name for note in notes if note.name is not None), field.name)
        value = _default(field) if made is None else getattr(made, field.name)
        if value is tyro.MISSING:
            value = dataclasses.MISSING
        inner = _plain(hint)
        if dataclasses.is_dataclass(inner) and isinstance(inner, type):
            if value is None:
                continue  # absent as a whole; a preset that has it shows its options
            given = None if value is dataclasses.MISSING else value
            yield from _options(inner, given, (*names, renamed) if renamed else names, depth + 1)
            continue
        owner, text = texts.get(field.name, (kind, ""))
        metavar = next((note.metavar for note in notes if note.metavar is not None), None)
        is_positional = _POSITIONAL in _notes(hint)
        one, fewest, most = _values(inner)
        if _APPEND in _notes(hint):
            fewest = most = 1  # each time that it is given
        name = ".".join((*names, renamed)).replace("_", "-")
        spelling = (metavar or name.upper()) if is_positional else f"--{name}"
        metavar = metavar or _metavar(hint)
        if most == 1:
            metavar = metavar.removesuffix("...")
        yield Option(spelling, is_positional, one, fewest, most, metavar, value, text, owner, depth)


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def _notes(hint: Any) -> tuple[Any, ...]:
    return get_args(hint)[1:] if get_origin(hint) is Annotated else ()


def _plain(hint: Any) -> Any:
    """A type without what stands beside it, and without None."""
    if get_origin(hint) is Annotated:
        return _plain(get_args(hint)[0])
    if get_origin(hint) in (Union, types.UnionType):
        (one,) = (each for each in get_args(hint) if each is not type(None))
        return _plain(one)
    return hint


def _values(hint: Any) -> tuple[Any, int, float]:
    """Type of one value of a type without notes, and how many there are of them, at least and at most."""
    if hint is bool:
        return bool, 0, 0
    if get_origin(hint) is Literal:
        return tuple(str(each) for each in get_args(hint)), 1, 1
    if get_origin(hint) is tuple:
        inner = get_args(hint)
        one = _values(_plain(inner[0]))[0]
        return (one, 0, _MANY) if inner[-1] is Ellipsis else (one, len(inner), len(inner))
    return hint, 1, 1


def _metavar(hint: Any) -> str:
    plain = _plain(hint)
    if plain is bool:
        return ""
    if get_origin(plain) is Literal:
        return f"{{{','.join(map(str, get_args(plain)))}}}"
    if get_origin(plain) is tuple:
        inner = get_args(plain)
        noted = next((note.metavar for note in _notes(inner[0]) if getattr(note, "metavar", None)), None)
        word = noted or _metavar(inner[0])
        return f"{word}..." if inner[-1] is Ellipsis else " ".join([word] * len(inner))
    percent = any(isinstance(note, Range) and note.most == 100 for note in _notes(hint))
    return "PERCENT" if percent else _WORDS[plain]


def _texts(kind: type) -> Mapping[str, tuple[type, str]]:
    """Of each field the class that declares it, and the text that stands below it there."""
    found: dict[str, tuple[type, str]] = {}
    for each in reversed(kind.__mro__):
        if dataclasses.is_dataclass(each):
            found |= {name: (each, text) for name, text in _texts_in(each.__module__).get(each.__name__, {}).items()}
    return found


@cache
def _texts_in(module: str) -> Mapping[str, Mapping[str, str]]:
    """Texts below the fields of each class of a module, empty where there is none."""
    tree = ast.parse(inspect.getsource(sys.modules[module]))
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    return {node.name: _texts_of(node.body) for node in classes}


def _texts_of(body: list[ast.stmt]) -> Mapping[str, str]:
    texts = {}
    for node, after in zip(body, [*body[1:], ast.Pass()], strict=True):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            said = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else ""
            texts[node.target.id] = " ".join(said.split()) if isinstance(said, str) else ""
    return texts
