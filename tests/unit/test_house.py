"""The house stays in order: every module has a layer, and settings cost nothing to import."""

import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("capture4d", "data_synth", "registration", "retarget", "wrinkles")


def test_every_module_has_a_layer():
    """import-linter checks the modules it is told of; a new one in the foundation has to be put in its place."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = next(contract for contract in contracts if contract["id"] == "layers")["layers"]
    placed = {name.strip(" ()") for layer in layers for name in layer.replace("|", ":").split(":")}
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
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    protected = {
        name for contract in contracts if contract["type"] == "protected" for name in contract["protected_modules"]
    }
    assert protected == {"capture4d.cli", "capture4d.app", "data_synth", "registration", "retarget", "wrinkles"}


def test_settings_import_the_standard_library_only():
    script = (
        "import sys, capture4d.cli.main\n"
        "heavy = {'numpy', 'torch', 'open3d', 'numba', 'warp', 'trimesh', 'jaxtyping'} & set(sys.modules)\n"
        "sys.exit(f'loaded {heavy}' if heavy else 0)"
    )
    subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT)
