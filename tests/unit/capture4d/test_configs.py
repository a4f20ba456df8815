"""What a stage can be told from Python has one public place, and presets have the names of the command line."""

import dataclasses
import typing
from pathlib import Path

import pytest

from capture4d import configs, pipeline
from capture4d.cli.main import COMMANDS
from capture4d.errors import InputError
from capture4d.steps.presets import chosen


def hints_of(function: typing.Any) -> dict[str, object]:
    plain = getattr(function, "__wrapped__", function)
    return {name: hint for name, hint in plain.__annotations__.items() if name in ("config", "tracking", "pairs")}


@pytest.mark.parametrize("name", pipeline.__all__)
def test_the_settings_of_every_stage_are_there(name: str):
    for hint in hints_of(getattr(pipeline, name)).values():
        assert isinstance(hint, str)
        wanted = {each.strip() for each in hint.split("|")} - {"None", "str"}
        assert wanted <= set(configs.__all__)
        assert all(dataclasses.is_dataclass(getattr(configs, each)) for each in wanted)


def test_presets_are_those_of_the_command_line():
    told = {
        name: typing.get_args(typing.get_type_hints(command)["preset"])
        for name, command in COMMANDS.items()
        if any(field.name == "preset" for field in dataclasses.fields(command))
    }
    found = {name: tuple(presets) for name, presets in configs.PRESETS.items()}
    found["synth-drapes"] = ("one-style", *found["synth-drapes"])  # the command's own settings
    assert {name: set(presets) for name, presets in found.items()} == {name: set(each) for name, each in told.items()}


@pytest.mark.parametrize("name", ["register", "run", "wrinkles_train", "fit_styles", "offsets_train", "synth_drapes"])
def test_a_preset_of_no_such_name_is_one_line(name: str, tube_capture: Path, tmp_path: Path):
    given = {
        "register": (tube_capture, tmp_path),
        "run": (tube_capture, tmp_path),
        "wrinkles_train": ([tmp_path], tmp_path / "model"),
        "synth_drapes": (tmp_path / "drapes",),
    }.get(name, (tmp_path, tmp_path / "model"))
    with pytest.raises(InputError, match=r"^config: expected one of .*, found 'papr'$"):
        getattr(pipeline, name)(*given, "papr")


def test_values_are_changed_by_the_path_of_their_field():
    usual = configs.RegistrationConfig()
    changed = configs.with_values(usual, {"sequence.relax": 0.4, "quality.stretch_fail": 2.0})
    assert (changed.sequence.relax, changed.quality.stretch_fail) == (0.4, 2.0)
    assert dataclasses.replace(changed, sequence=usual.sequence, quality=usual.quality) == usual
    assert usual == configs.RegistrationConfig()  # what was given stays as it is


def test_values_that_go_with_each_other_are_changed_at_once():
    """A partner is refused where the residual is learned."""
    usual = configs.with_values(configs.PRESETS["offsets train"]["default"], {"residual": True})
    changed = configs.with_values(usual, {"partner": True, "residual": False})
    assert (changed.partner, changed.residual) == (True, False)
    with pytest.raises(InputError, match="residual"):
        configs.with_values(usual, {"partner": True})


@pytest.mark.parametrize("presets", configs.PRESETS.values())
def test_the_first_preset_is_the_default(presets: dict[str, object]):
    assert chosen(None, presets) is next(iter(presets.values()))


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("sequence.relaxed", 1.0, "sequence.relaxed: expected one of .*relax.*, found 'relaxed'"),
        ("sequence.relax.more", 1.0, "sequence.relax.more: expected no more names, found 'more'"),
        ("sequence.relax", -1.0, "relax: expected at least 0, found -1"),
    ],
)
def test_a_value_that_is_none_is_one_line(path: str, value: float, said: str):
    with pytest.raises(InputError, match=said):
        configs.with_values(configs.RegistrationConfig(), {path: value})
