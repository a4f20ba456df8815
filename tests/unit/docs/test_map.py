"""The map in CONTRIBUTING and the pages of docs name what is there: rooms, files, functions."""

import ast
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
PACKAGES = ("capture4d", "data_synth", "registration", "retarget", "wrinkles")
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text()
TO_COME = next((line for line in CONTRIBUTING.splitlines() if line.startswith("Rooms for what comes")), "")
MAP = CONTRIBUTING.replace(TO_COME, "")
DOTTED = re.compile(rf"`((?:{'|'.join((*PACKAGES, 'benchmarks'))})(?:\.\w+)+)`")


def rooms() -> list[str]:
    """Folders with code, but for those that only hold other rooms."""
    folders = {path.parent for package in PACKAGES for path in (ROOT / package).rglob("*.py")}
    held = {folder for folder in folders if any(path.name != "__init__.py" for path in folder.glob("*.py"))}
    return sorted(
        f"{folder.relative_to(ROOT)}/" for folder in held - {ROOT / "capture4d", ROOT / "retarget", ROOT / "wrinkles"}
    )


def test_every_room_has_a_row():
    named = re.findall(r"^\| `([\w/]+/)` \|", MAP, re.MULTILINE)
    assert [room for room in rooms() if room not in named] == []
    assert [room for room in named if not (ROOT / room).is_dir()] == []


def test_every_layer_is_in_the_picture():
    picture = MAP.partition("## A map of the house")[2].split("```")[1]
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = next(contract for contract in contracts if contract["id"] == "layers")["layers"]
    names = {name for layer in layers for name in re.findall(r"[\w.]+", layer)} - {"capture4d.__main__"}
    assert [name for name in sorted(names) if name.rpartition(".")[2] not in picture] == []


def test_every_file_of_the_map_exists():
    named = re.findall(r"`((?:capture4d|data_synth|registration|retarget|wrinkles)/[\w/.]+)`", MAP)
    assert len(named) > 60
    assert [name for name in named if not (ROOT / name).exists()] == []


ASKED = """Eq. 1, Eq. 2, Eq. 3, Eq. 4, Eq. 5, pose regression, temporal loss, offset encoding, stereo scanner, resume,
preflight's verdict, pose normalisation, blendshapes, body tracking, kernel regression"""


@pytest.mark.parametrize("asked", re.split(r",\s+", ASKED))
def test_a_reader_of_the_papers_finds(asked: str):
    rows = [line for line in MAP.splitlines() if line.startswith("| ") and asked in line.split(" | ")[0]]
    assert rows
    assert all(re.search(r"`[\w/]+\.py`", row) for row in rows)


def code_lines() -> list[tuple[str, str]]:
    """What pages say their code is."""
    found = []
    for path in sorted((ROOT / "docs").rglob("*.md")):
        for sentence in re.findall(r"Code: (.*?)\.\s", path.read_text(), re.DOTALL):
            found += [(path.name, name) for name in re.findall(r"`([\w/.]+)`", sentence)]
    return found


def test_code_lines_name_folders_and_files():
    lines = code_lines()
    assert len({page for page, _ in lines}) >= 9
    assert [line for line in lines if not (ROOT / line[1]).exists()] == []


def is_there(name: str) -> bool:
    """Whether a dotted name is a module or what a module says: a name at its top level, or one of a class of it."""
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        path = ROOT.joinpath(*parts[:cut])
        if path.with_suffix(".py").is_file():
            return _says(ast.parse(path.with_suffix(".py").read_text()).body, parts[cut:])
        if path.is_dir():  # the face of a package says what it hands on as text
            return cut == len(parts) or bool(re.search(rf"\b{parts[cut]}\b", (path / "__init__.py").read_text()))
    return False


def _says(body: list[ast.stmt], names: list[str]) -> bool:
    found = {name: node for node in body for name in _names(node)}
    if not names:
        return True
    node = found.get(names[0])
    return node is not None and (len(names) == 1 or (isinstance(node, ast.ClassDef) and _says(node.body, names[1:])))


def _names(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return [target.id for target in targets if isinstance(target, ast.Name)]


@pytest.mark.parametrize("path", sorted((ROOT / "docs").rglob("*.md")), ids=lambda path: path.stem)
def test_dotted_names_exist(path: Path):
    names = DOTTED.findall(path.read_text())
    assert [name for name in names if not is_there(name)] == []


def test_dotted_names_that_do_not_exist_are_found():
    assert is_there("capture4d.runs.stage.Stage.finish")
    assert not is_there("capture4d.runs.stage.Stage.begin_again")
    assert not is_there("capture4d.no_such_room")
