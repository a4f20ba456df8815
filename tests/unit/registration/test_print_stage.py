"""What a print is made from: the first frames, or a picture; and whose settings it decides."""

from pathlib import Path

import pytest

from capture4d.errors import InputError
from capture4d.runs.made import Ledger, make
from registration.config import ColourConfig
from registration.print_stage import PRINT, print_inputs, settings_with_print


def inputs(garments: list[str], config: ColourConfig | None = None) -> dict[str, str]:
    return print_inputs(config or ColourConfig(), "settings", garments, [""] * len(garments), 20.0)


def test_a_learned_print_is_made_from_the_first_frames() -> None:
    garments = [f"garment {frame}" for frame in range(100)]
    first, late = garments.copy(), garments.copy()
    first[3], late[60] = "another", "another"
    assert inputs(late) == inputs(garments)
    assert inputs(first) != inputs(garments)


def test_a_given_print_is_made_from_its_picture_alone(tmp_path: Path) -> None:
    config = ColourConfig(print=str(tmp_path / "print.png"))
    with pytest.raises(InputError, match=r"print.png: no such picture"):
        inputs(["a"], config)
    (tmp_path / "print.png").write_bytes(b"stripes")
    stripes = inputs(["a"], config)
    assert inputs(["b"], config) == stripes
    (tmp_path / "print.png").write_bytes(b"checks")
    assert inputs(["a"], config) != stripes


@pytest.mark.parametrize("printed", [False, True])
def test_a_print_is_among_the_settings_of_all_frames_where_there_is_one(tmp_path: Path, printed: bool) -> None:
    assert settings_with_print("settings", Ledger.read(tmp_path)) == "settings"
    make(tmp_path, tmp_path / PRINT, lambda: (tmp_path / PRINT).write_bytes(b"x"), inputs={}, said={"printed": printed})
    assert (settings_with_print("settings", Ledger.read(tmp_path)) != "settings") == printed
