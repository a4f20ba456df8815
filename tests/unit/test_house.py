"""The house stays in order: every module has a layer, rooms are small, and settings cost nothing to import."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
PACKAGES = ("capture4d", "data_synth", "registration", "retarget", "wrinkles")


def contracts() -> list[dict[str, Any]]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]


def layers() -> list[str]:
    return next(contract for contract in contracts() if contract["id"] == "layers")["layers"]


def test_every_module_has_a_layer():
    """import-linter checks the modules it is told of; a new one in the foundation has to be put in its place."""
    placed = {name.strip(" ()") for layer in layers() for name in layer.replace("|", ":").split(":")}
    modules = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for package in PACKAGES
        for path in (ROOT / package).rglob("*.py")
        if path.name != "__init__.py"
    }
    assert {
        name for name in modules if not any(name == layer or name.startswith(f"{layer}.") for layer in placed)
    } == set()


def test_every_wing_is_protected():
    protected = {
        name for contract in contracts() if contract["type"] == "protected" for name in contract["protected_modules"]
    }
    assert protected == {"capture4d.cli", "capture4d.app", "data_synth", "registration", "retarget", "wrinkles"}


def test_settings_import_the_standard_library_only():
    script = (
        "import sys, capture4d.cli.main\n"
        "heavy = {'numpy', 'torch', 'open3d', 'numba', 'warp', 'trimesh', 'jaxtyping'} & set(sys.modules)\n"
        "sys.exit(f'loaded {heavy}' if heavy else 0)"
    )
    subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT)


# --- rooms -------------------------------------------------------------------------------------------------------

LARGEST_ROOM = 12
"""Modules of a folder of `capture4d`, and of `capture4d` itself; a wing may be one idea in more."""
LONGEST_MODULE, LONGEST_FUNCTION = 450, 80
MOST_PARAMETERS = 8
"""But for `self`; a compiled kernel takes its arrays one by one."""
KERNELS = ("njit", "wp.")
"""What the decorators of compiled kernels begin with."""
SENTENCE = re.compile(r"[^.!?]+\.")


def rooms(packages: Iterable[str] = PACKAGES) -> list[Path]:
    """Every folder with modules, the packages among them."""
    return sorted({path.parent for package in packages for path in (ROOT / package).rglob("*.py")})


def sources() -> dict[str, str]:
    """Text of every module that is shipped or measured with, by its place."""
    paths = (path for package in (*PACKAGES, "benchmarks") for path in (ROOT / package).rglob("*.py"))
    return {str(path.relative_to(ROOT)): path.read_text() for path in sorted(paths)}


def functions() -> dict[str, ast.FunctionDef | ast.AsyncFunctionDef]:
    """Every function and method, by place and line."""
    return {
        f"{place}:{node.lineno} {node.name}": node
        for place, text in sources().items()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    }


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """How many values a caller may hand over."""
    every = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    return len([each for each in every if each.arg not in ("self", "cls")])


def test_the_layers_are_few_enough_to_be_held_in_the_head():
    assert len(layers()) <= 10


def test_no_room_is_crowded():
    counts = {
        str(room.relative_to(ROOT)): sum(path.name != "__init__.py" for path in room.glob("*.py"))
        for room in rooms(["capture4d"])
    }
    assert {room: count for room, count in counts.items() if count > LARGEST_ROOM} == {}


def test_a_room_says_what_it_is_in_one_sentence_and_hands_nothing_on():
    """One door for a function: `capture4d` alone is a face, for users."""
    wrong = {}
    for room in rooms():
        place = str((room / "__init__.py").relative_to(ROOT))
        tree = ast.parse((room / "__init__.py").read_text()) if (room / "__init__.py").is_file() else ast.Module([])
        sentence = ast.get_docstring(tree) or ""
        if place != "capture4d/__init__.py" and not (SENTENCE.fullmatch(sentence) and len(tree.body) == 1):
            wrong[place] = sentence
    assert wrong == {}


def test_the_map_shows_every_room():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    assert [place for room in rooms() if (place := str(room.relative_to(ROOT))) not in text] == []


def test_no_module_is_long():
    lengths = {place: len(text.splitlines()) for place, text in sources().items()}
    assert {place: length for place, length in lengths.items() if length > LONGEST_MODULE} == {}


def test_a_function_fits_a_screen():
    lengths = {place: (node.end_lineno or 0) - node.lineno + 1 for place, node in functions().items()}
    assert {place: length for place, length in lengths.items() if length > LONGEST_FUNCTION} == {}


def test_a_function_takes_what_a_reader_can_keep_apart():
    kernels = {
        place
        for place, node in functions().items()
        if any(ast.unparse(decorator).startswith(KERNELS) for decorator in node.decorator_list)
    }
    assert kernels, "compiled kernels are told by their decorators"
    counts = {place: parameters(node) for place, node in functions().items() if place not in kernels}
    assert {place: count for place, count in counts.items() if count > MOST_PARAMETERS} == {}
