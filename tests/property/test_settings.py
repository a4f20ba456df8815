"""Every number in every settings class of the five packages states its range, and is held to it."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from capture4d.cli.main import COMMANDS
from capture4d.settings import Condition, PowerOfTwo, Range, SettingError
from data_synth.config import TRAINING_SETS, TrainingSetConfig
from data_synth.drapes.config import HOLDS, Hold
from registration.config import DenseConfig, Schedule

ROOT = Path(__file__).parents[2]
PACKAGES = ("capture4d", "data_synth", "registration", "retarget", "wrinkles")
NAMED_SO = re.compile(r"(Config|Settings|Schedule)$")
EXAMPLES: dict[type, Any] = {
    Hold: HOLDS["tshirt"],
    Schedule: DenseConfig().cold,
    TrainingSetConfig: TRAINING_SETS["tiny-train"],
}
"""Of the classes that cannot be made without arguments."""


def decorated_classes() -> Iterator[tuple[str, str, set[str]]]:
    """Module, name and decorators of every class in the source."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.ClassDef):
                    yield module, node.name, {re.split(r"\W", ast.unparse(entry))[0] for entry in node.decorator_list}


def settings_classes() -> list[type]:
    return [
        getattr(importlib.import_module(module), name)
        for module, name, decorators in decorated_classes()
        if "settings" in decorators
    ]


CLASSES = settings_classes()


@dataclass(frozen=True)
class Place:
    """Where a number stands in a field, and what stands beside it."""

    field: str
    kind: type
    rules: tuple[Range | Condition, ...]
    value: Callable[[Any], Any]
    """What the field is set to, that the number stands there."""

    @property
    def range(self) -> Range:
        return next(rule for rule in self.rules if isinstance(rule, Range))


def places(kind: type) -> list[Place]:
    """All numbers of a dataclass, but those inside other dataclasses."""
    hints = get_type_hints(kind, include_extras=True)
    return [place for field in dataclasses.fields(kind) for place in within(field.name, hints[field.name])]


def within(field: str, hint: Any, value: Callable[[Any], Any] = lambda number: number) -> Iterator[Place]:
    origin, inner = get_origin(hint), get_args(hint)
    if hint in (int, float):
        yield Place(field, hint, (), value)
    elif origin is Annotated and inner[0] in (int, float):
        rules = tuple(entry for entry in inner[1:] if isinstance(entry, Range | Condition))
        yield Place(field, inner[0], rules, value)
    elif origin is Annotated:
        yield from within(field, inner[0], value)
    elif origin in (Union, UnionType):
        for option in inner:
            yield from within(field, option, value)
    elif origin is tuple:
        count = 1 if inner[-1] is Ellipsis else len(inner)
        for position in range(count):
            yield from within(field, inner[position], lambda number: value((number,) * count))
    elif origin is dict:
        yield from within(field, inner[1], lambda number: value({"name": number}))


def dataclasses_in(hint: Any) -> Iterator[type]:
    """The dataclasses that an annotation speaks of, and all in those."""
    if inspect.isclass(hint) and dataclasses.is_dataclass(hint):
        yield hint
        for entry in get_type_hints(hint, include_extras=True).values():
            yield from dataclasses_in(entry)
    for entry in get_args(hint):
        yield from dataclasses_in(entry)


def outside(place: Place) -> st.SearchStrategy[Any]:
    """Values that the range leaves out, and those that are no number. (What is of another type altogether is caught by
    beartype here; `tests/unit/capture4d/test_settings.py` has that.)"""
    no_number = [True, False] if place.kind is int else [True, False, math.nan, math.inf, -math.inf]
    found: list[st.SearchStrategy[Any]] = [st.sampled_from(no_number)]
    limits = place.range
    whole = place.kind is int
    if limits.least is not None:
        least = limits.least
        found.append(st.integers(max_value=int(least) - 1) if whole else st.floats(max_value=least, exclude_max=True))
    if limits.above is not None:
        found.append(st.floats(max_value=limits.above))
    if limits.most is not None:
        most = limits.most
        found.append(st.integers(min_value=int(most) + 1) if whole else st.floats(min_value=most, exclude_min=True))
    if limits.below is not None:
        found.append(st.integers(min_value=int(limits.below)) if whole else st.floats(min_value=limits.below))
    return st.one_of(found)


def inside(place: Place) -> st.SearchStrategy[Any]:
    limits = place.range
    if place.kind is int:
        if PowerOfTwo in place.rules:
            most = 40 if limits.most is None else int(limits.most).bit_length() - 1
            return st.integers(int(limits.least or 1).bit_length() - 1, most).map(lambda power: 2**power)
        low = limits.least if limits.above is None else limits.above + 1
        high = limits.most if limits.below is None else limits.below - 1
        found = st.integers(None if low is None else int(low), None if high is None else int(high))
    else:
        low = limits.above if limits.least is None else limits.least
        high = limits.below if limits.most is None else limits.most
        found = st.floats(
            low, high, exclude_min=limits.above is not None, exclude_max=limits.below is not None,
            allow_nan=False, allow_infinity=False,
        )  # fmt: skip
    conditions = [rule for rule in place.rules if isinstance(rule, Condition)]
    return found.filter(lambda number: all(rule.holds(number) for rule in conditions))


def example(kind: type) -> Any:
    return EXAMPLES[kind] if kind in EXAMPLES else kind()


def test_what_is_named_as_settings_is_settings():
    escaped = [
        f"{module}.{name}"
        for module, name, decorators in decorated_classes()
        if NAMED_SO.search(name) and "dataclass" in decorators
    ]
    assert escaped == []
    assert len(CLASSES) > 40


def test_what_a_command_is_made_from_is_settings():
    assert len(COMMANDS) > 20
    reached = {kind for command in COMMANDS.values() for kind in dataclasses_in(command)} - {*COMMANDS.values()}
    assert reached - set(CLASSES) == set()


@pytest.mark.parametrize("kind", [*CLASSES, *COMMANDS.values()], ids=lambda kind: f"{kind.__module__}.{kind.__name__}")
def test_every_number_states_its_range(kind: type):
    silent = [place.field for place in places(kind) if not any(isinstance(rule, Range) for rule in place.rules)]
    assert silent == []


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: f"{kind.__module__}.{kind.__name__}")
@examples(max_examples=25, deadline=None)
@given(data=st.data())
def test_every_number_is_held_to_its_range(kind: type, data: st.DataObject):
    made = example(kind)
    for place in places(kind):
        right = place.value(data.draw(inside(place), label=place.field))
        assert getattr(dataclasses.replace(made, **{place.field: right}), place.field) == right
        wrong = data.draw(outside(place), label=place.field)
        with pytest.raises(SettingError) as raised:
            dataclasses.replace(made, **{place.field: place.value(wrong)})
        assert str(raised.value).startswith(f"{kind.__name__}.{place.field}: expected ")
        assert len(str(raised.value).splitlines()) == 1
