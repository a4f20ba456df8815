"""The laws of `@settings`, on classes made for them."""

from __future__ import annotations

import dataclasses
import pickle
from dataclasses import asdict, fields, replace
from typing import Annotated, Any, Literal

import pytest
import tyro

from capture4d.errors import InputError
from capture4d.settings import (
    Condition,
    Count,
    NonNegative,
    NotEmpty,
    Number,
    Odd,
    Part,
    Positive,
    PowerOfTwo,
    Range,
    SettingError,
    Share,
    check_fields,
    gathered_faults,
    settings,
)


@settings
class Solver:
    """How to solve."""

    steps: Count = 3
    """Steps at most."""
    damping: Positive = 0.5


@settings
class Everything:
    """One of each."""

    count: Count = 1
    share: Share = 0.5
    rest: Part = 0.5
    number: Number = 0.0
    above: Annotated[float, Range(above=-1)] = 0.0
    most: Annotated[int, Range(most=9)] = 3
    below: Annotated[float, Range(below=9)] = 3.0
    open: Annotated[float, Range(above=0, below=180)] = 48.0
    shut: Annotated[float, Range(above=0, most=1)] = 1.0
    odd: Annotated[Count, Odd] = 3
    power: Annotated[int, Range(least=4), PowerOfTwo] = 8
    perhaps: Count | None = None
    pair: tuple[NonNegative, NonNegative] = (0.0, 1.0)
    many: tuple[Positive, ...] = ()
    some: Annotated[tuple[Positive, ...], NotEmpty] = (1.0,)
    by_name: dict[str, tuple[Positive, ...]] = dataclasses.field(default_factory=dict)
    kind: Literal["a", "b"] = "a"
    bits: Literal[8, 16] = 16
    flag: bool = False
    name: str = ""
    solver: Solver = Solver(steps=4)


@settings
class Window:
    """A relation between two fields."""

    first: Count = 1
    last: Count = 5

    def __post_init__(self) -> None:
        if self.last < self.first:
            raise SettingError(self, "last", f"at least the first, {self.first}", self.last)


@dataclasses.dataclass
class Command:
    """Solve."""

    solver: Solver = Solver()
    window: Window = Window()


@pytest.mark.parametrize(
    ("field", "wrong", "said"),
    [
        ("count", 0, "at least 1, found 0"),
        ("count", 2.0, "a whole number, found 2"),
        ("count", True, "a whole number, found True"),
        ("count", "3", "a whole number, found '3'"),
        ("count", None, "a whole number, found None"),
        ("share", 1.25, "from 0 to 1, found 1.25"),
        ("share", float("nan"), "a finite number, found nan"),
        ("share", False, "a finite number, found False"),
        ("rest", 1, "from 0 to below 1, found 1"),
        ("number", float("-inf"), "a finite number, found -inf"),
        ("above", -1.0, "above -1, found -1"),
        ("most", 10, "at most 9, found 10"),
        ("below", 9.0, "below 9, found 9"),
        ("open", 180.0, "above 0, below 180, found 180"),
        ("shut", 0.0, "above 0, up to 1, found 0"),
        ("shut", 1.0000000001, "above 0, up to 1, found 1.0000000001"),
        ("odd", 4, "an odd number, found 4"),
        ("odd", -1, "at least 1, found -1"),
        ("power", 12, "a power of two, found 12"),
        ("perhaps", 0, "at least 1, found 0"),
        ("pair", (0.0, -2.0), "at least 0, found -2"),
        ("pair", (0.0,), "2 values, found 1"),
        ("pair", [0.0, 1.0], "a tuple, found [0.0, 1.0]"),
        ("many", (1.0, 0.0), "a positive number, found 0"),
        ("some", (), "at least one value, found none"),
        ("by_name", {"thin": (0.0,)}, "a positive number, found 0"),
        ("kind", "c", "one of a, b, found 'c'"),
        ("bits", 16.0, "one of 8, 16, found 16"),
        ("flag", 1, "True or False, found 1"),
        ("name", 5, "text, found 5"),
        ("solver", Window(), "a Solver, found a Window"),
    ],
)
def test_what_is_out_of_range_is_told_in_one_line(field: str, wrong: Any, said: str):
    with pytest.raises(SettingError) as raised:
        Everything(**{field: wrong})
    assert str(raised.value) == f"Everything.{field}: expected {said}"
    assert raised.value.field == field
    assert isinstance(raised.value, InputError)
    with pytest.raises(SettingError):
        replace(Everything(), **{field: wrong})


@pytest.mark.parametrize(
    ("field", "right"),
    [
        ("share", 1),
        ("share", 0.0),
        ("rest", 0),
        ("above", -0.999),
        ("perhaps", 7),
        ("pair", (0, 3)),
        ("many", (2.0, 3.0)),
        ("power", 4),
        ("bits", 8),
    ],
)
def test_what_is_in_range_is_kept_as_it_is(field: str, right: Any):
    kept = getattr(Everything(**{field: right}), field)
    assert kept == right
    assert type(kept) is type(right)


def test_settings_are_frozen_dataclasses_that_can_be_copied_sent_and_listed():
    made = Everything(count=4, pair=(1.0, 2.0))
    assert pickle.loads(pickle.dumps(made)) == made
    assert asdict(made)["solver"] == {"steps": 4, "damping": 0.5}
    assert [field.name for field in fields(Window)] == ["first", "last"]
    assert not hasattr(made, "__dict__")
    with pytest.raises(dataclasses.FrozenInstanceError):
        made.count = 5  # type: ignore[misc]


def test_relations_are_checked_once_the_fields_are_in_range():
    assert Window(5, 5).last == 5
    with pytest.raises(SettingError, match=r"Window.last: expected at least the first, 5, found 1"):
        Window(5, 1)
    with pytest.raises(SettingError, match=r"Window.first: expected at least 1, found 0"):
        Window(0, -1)


def test_a_fault_survives_the_way_between_processes_and_gets_a_file():
    with pytest.raises(SettingError) as raised:
        Solver(steps=-3)
    again = pickle.loads(pickle.dumps(raised.value))
    assert isinstance(again, SettingError)
    assert (str(again), again.field, again.value) == (str(raised.value), "steps", -3)
    assert str(again.at("model.safetensors")) == "model.safetensors: Solver.steps: expected at least 1, found -3"


def test_gathered_faults_are_listed_and_only_inside():
    with gathered_faults() as faults:
        made = Solver(steps=-3)
        Window(5, 1)
        Solver(damping=0.0)
    assert [fault.field for fault in faults] == ["steps", "last", "damping"]
    assert faults[0].settings is made
    with pytest.raises(SettingError):
        Solver(steps=-3)


def test_any_dataclass_can_be_checked_afterwards():
    @dataclasses.dataclass
    class Plain:
        workers: Count
        path: object = None

    check_fields(Plain(1))
    with pytest.raises(SettingError, match=r"Plain.workers: expected at least 1, found 0"):
        check_fields(Plain(0))


def test_long_values_stay_short_and_on_one_line():
    with pytest.raises(SettingError) as raised:
        Everything(kind="a\nb" * 1000)  # type: ignore[arg-type]
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 100


def test_a_condition_brings_its_own_words():
    even = Condition(lambda number: number % 2 == 0, "an even number")
    assert even.holds(4)
    assert not even.holds(3)


def test_the_command_line_is_made_from_settings(capsys: pytest.CaptureFixture[str]):
    assert tyro.cli(Command, args=["--solver.steps", "9"]).solver == Solver(steps=9)
    with pytest.raises(SystemExit):
        tyro.cli(Command, args=["--help"])
    assert "Steps at most." in capsys.readouterr().out
