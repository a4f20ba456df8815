"""Settings are checked when they are made: `@settings` beside a class, and beside each field which values it takes.

    @settings
    class GraphConfig:
        nodes: Count = 300
        reach_m: Annotated[float, Range(above=0, most=2)] = 0.1

    GraphConfig(nodes=-3)  # SettingError: GraphConfig.nodes: expected at least 1, found -3

Numbers are finite; a whole number will do for a float, True for neither. Relations between fields are checked by the
class's own `__post_init__`, which runs once every field is in its range. The standard library alone: `capture4d --help`
loads this.
"""

from __future__ import annotations

import dataclasses
import math
import reprlib
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import Annotated, Any, Literal, TypeVar, Union, dataclass_transform, get_args, get_origin, get_type_hints

from capture4d.errors import InputError

__all__ = [
    "Condition",
    "Cosine",
    "Count",
    "Degrees",
    "NonNegative",
    "NotEmpty",
    "Number",
    "Odd",
    "Part",
    "Percent",
    "Positive",
    "PowerOfTwo",
    "Range",
    "Seed",
    "SettingError",
    "Share",
    "Whole",
    "check_fields",
    "gathered_faults",
    "settings",
]

Made = TypeVar("Made")


@dataclasses.dataclass(frozen=True, slots=True)
class Range:
    """Limits of a number. `least` and `most` still belong to the range, `above` and `below` do not."""

    least: float | None = None
    most: float | None = None
    above: float | None = None
    below: float | None = None

    def holds(self, number: float) -> bool:
        return (
            (self.least is None or number >= self.least)
            and (self.most is None or number <= self.most)
            and (self.above is None or number > self.above)
            and (self.below is None or number < self.below)
        )

    @property
    def words(self) -> str:
        low, high = (self.above if self.least is None else self.least), (self.below if self.most is None else self.most)
        if low is None and high is None:
            return "a number"
        if high is None:
            return f"at least {low}" if self.least is not None else "a positive number" if low == 0 else f"above {low}"
        if low is None:
            return f"at most {high}" if self.most is not None else f"below {high}"
        if self.least is not None:
            return f"from {low} to {high}" if self.most is not None else f"from {low} to below {high}"
        return f"above {low}, up to {high}" if self.most is not None else f"above {low}, below {high}"


@dataclasses.dataclass(frozen=True, slots=True)
class Condition:
    """What else must be true of a value, and how that is said."""

    holds: Callable[[Any], bool]
    words: str


NotEmpty = Condition(bool, "at least one value")
Odd = Condition(lambda number: number % 2 == 1, "an odd number")
PowerOfTwo = Condition(lambda number: number.bit_count() == 1, "a power of two")

Count = Annotated[int, Range(least=1)]
Whole = Annotated[int, Range(least=0)]
Seed = Annotated[int, Range(least=0, below=2**63)]
Number = Annotated[float, Range()]
Positive = Annotated[float, Range(above=0)]
NonNegative = Annotated[float, Range(least=0)]
Share = Annotated[float, Range(least=0, most=1)]
Part = Annotated[float, Range(least=0, below=1)]  # a share that leaves something over
Percent = Annotated[float, Range(least=0, most=100)]
Cosine = Annotated[float, Range(least=-1, most=1)]
Degrees = Annotated[float, Range(least=0, most=180)]


class SettingError(InputError):
    """A setting that nothing can be done with.

    Attributes:
        settings: what the setting belongs to.
        field: name of the setting, dotted where it belongs to settings inside those.
        value: what it was set to; of several numbers, the one that is wrong.
        said: what was expected, and what was found.
    """

    def __init__(self, settings: object, field: str, expected: str, value: object) -> None:
        self.settings, self.field, self.value = settings, field, value
        self.said = f"expected {expected}, found {_told(value)}"
        super().__init__(f"{type(settings).__name__}.{field}: {self.said}")


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def settings(kind: type[Made]) -> type[Made]:
    """Make the class a frozen dataclass whose values are checked when it is made.

    Raises, whenever one is made:
        SettingError: a value is out of the range beside its field.
    """
    relations = getattr(kind, "__post_init__", None)

    def check(made: Any) -> None:
        try:
            check_fields(made)
            if relations is not None:
                relations(made)
        except SettingError as fault:
            gathered = _gathered.get()
            if gathered is None:
                raise
            gathered.append(fault)

    kind.__post_init__ = check  # type: ignore[attr-defined]
    return dataclasses.dataclass(frozen=True, slots=True)(kind)


def check_fields(made: Any) -> None:
    """Check the fields of any dataclass against what stands beside them.

    Raises:
        SettingError: a value is out of the range beside its field.
    """
    for name, hint in _hints(type(made)):
        fault = _fault(hint, getattr(made, name))
        if fault is not None:
            raise SettingError(made, name, *fault)


@contextmanager
def gathered_faults() -> Iterator[list[SettingError]]:
    """Faulty settings that are made inside are listed, not refused: for whoever can name them better, once all are
    made. They must not be used."""
    faults: list[SettingError] = []
    token = _gathered.set(faults)
    try:
        yield faults
    finally:
        _gathered.reset(token)


_gathered: ContextVar[list[SettingError] | None] = ContextVar("faulty settings", default=None)


@cache
def _hints(kind: type) -> tuple[tuple[str, Any], ...]:
    """Fields and their annotations, read when the first is made: names may be defined below the class."""
    hints = get_type_hints(kind, include_extras=True)
    return tuple((field.name, hints[field.name]) for field in dataclasses.fields(kind))


def _fault(hint: Any, value: Any) -> tuple[str, Any] | None:
    """What an annotation expects and a value is not, and what was found; None where nothing is wrong.

    Annotations that say nothing of a number, a text, a choice or settings let everything pass.
    """
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        fault = _fault(inner[0], value)
        rules = (rule for rule in inner[1:] if isinstance(rule, Range | Condition))
        return fault or next(((rule.words, value) for rule in rules if not rule.holds(value)), None)
    if origin is Union or origin is types.UnionType:
        faults = [_fault(kind, value) for kind in inner]
        return None if None in faults else faults[0]
    if origin is Literal:
        fits = any(value == option and type(value) is type(option) for option in inner)
        return None if fits else (f"one of {', '.join(map(str, inner))}", value)
    if origin is tuple:
        return _fault_in_tuple(inner, value)
    if origin is dict:
        return next(filter(None, (_fault(inner[1], entry) for entry in value.values())), None)
    if hint in _KINDS:
        fits, words = _KINDS[hint]
        return None if fits(value) else (words, value)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type) and not isinstance(value, hint):
        return f"a {hint.__name__}", value
    return None


def _fault_in_tuple(kinds: tuple[Any, ...], value: Any) -> tuple[str, Any] | None:
    if not isinstance(value, tuple):
        return "a tuple", value
    if kinds[-1] is Ellipsis:
        kinds = kinds[:1] * len(value)
    if len(kinds) != len(value):
        return f"{len(kinds)} values", len(value)
    return next(filter(None, map(_fault, kinds, value)), None)


def _is_number(value: Any) -> bool:
    return math.isfinite(value) if isinstance(value, float) else _is_whole(value)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


_KINDS: dict[Any, tuple[Callable[[Any], bool], str]] = {
    bool: (lambda value: isinstance(value, bool), "True or False"),
    float: (_is_number, "a finite number"),
    int: (_is_whole, "a whole number"),
    str: (lambda value: isinstance(value, str), "text"),
    type(None): (lambda value: value is None, "None"),
}


def _told(value: object) -> str:
    """A value in a message of one line."""
    if isinstance(value, float):
        return f"{value:g}" if float(f"{value:g}") == value or not math.isfinite(value) else repr(value)
    if isinstance(value, tuple):
        return " ".join(map(_told, value)) or "none"
    if dataclasses.is_dataclass(value):
        return f"a {type(value).__name__}"
    return " ".join(reprlib.repr(value).split())
