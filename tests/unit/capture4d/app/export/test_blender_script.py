"""open_in_blender.py and its command line, before anything is asked of Blender."""

import runpy
import sys
from importlib.resources import files
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest


@pytest.fixture
def script(tmp_path: Path) -> Path:
    text = files("capture4d.app.export").joinpath("open_in_blender.txt").read_text(encoding="utf-8")
    path = tmp_path / "open_in_blender.py"
    path.write_text(text.replace("TAKE = {}", 'TAKE = {"files": ["garment.usdc"], "first": 1}', 1), encoding="utf-8")
    return path


def said(script: Path, monkeypatch: pytest.MonkeyPatch, *argv: str, wheel: bool = False) -> str:
    """What the script ends with: none of its files is there."""
    blender, vectors = ModuleType("bpy"), ModuleType("mathutils")
    vars(blender)["app"], vars(vectors)["Vector"] = SimpleNamespace(module=wheel), tuple
    monkeypatch.setitem(sys.modules, "bpy", blender)
    monkeypatch.setitem(sys.modules, "mathutils", vectors)
    monkeypatch.setattr(sys, "argv", list(argv))
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    return str(ended.value)


def test_blenders_own_command_line_names_no_file_of_the_export(script: Path, monkeypatch: pytest.MonkeyPatch):
    nothing = f"capture4d: none of these files is in {script.parent}: "
    assert said(script, monkeypatch, "blender", "-P", str(script)) == nothing + "garment.usdc"
    assert said(script, monkeypatch, "blender", "-b", "a.blend", "-P", str(script)) == nothing + "garment.usdc"
    after = ("blender", "-P", str(script), "--", "garment.abc")
    assert said(script, monkeypatch, *after) == nothing + "garment.abc"
    assert said(script, monkeypatch, str(script), "garment.glb", wheel=True) == nothing + "garment.glb"


def test_what_is_saved_or_drawn_is_no_file_of_the_export(script: Path, monkeypatch: pytest.MonkeyPatch):
    line = said(script, monkeypatch, str(script), "a.blend", "a.png", "--frame", "12", "garment.glb", wheel=True)
    assert line == f"capture4d: none of these files is in {script.parent}: garment.glb"


@pytest.mark.parametrize("option", ["--scans", "--frame"])
@pytest.mark.parametrize(("given", "found"), [((), "nothing"), (("many",), "many"), (("-1",), "-1")])
def test_an_option_without_a_number_is_one_line(
    option: str, given: tuple[str, ...], found: str, script: Path, monkeypatch: pytest.MonkeyPatch
):
    line = said(script, monkeypatch, "blender", "-P", str(script), "--", option, *given)
    assert line == f"capture4d: {option}: expected a number, found {found}"
