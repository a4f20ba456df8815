"""What the snippets of the docs find in the folder where they run."""

import importlib.util
import shutil
from pathlib import Path

import pytest

from capture4d.files.records import load_garment, save_poses
from capture4d.mesh_files.meshes import read_mesh, write_mesh
from tests.command_line import run

# A garment that can be learned is what retarget's tests have.
_SPEC = importlib.util.spec_from_file_location("retarget_world", Path(__file__).parents[1] / "retarget" / "conftest.py")
assert _SPEC is not None
assert _SPEC.loader is not None
_world = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(_world)
body, garment, motion, make_world, write_work = (
    getattr(_world, name) for name in ("body", "garment", "motion", "make_world", "write_work")
)


@pytest.fixture(scope="session")
def shop(tube_capture_once: Path, write_work, motion, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with capture/, template.obj, scan.ply, motion.npz, and the learned garment shirt/."""
    folder = tmp_path_factory.mktemp("docs") / "shop"
    shutil.copytree(tube_capture_once, folder / "capture")
    write_mesh(folder / "template.obj", load_garment(folder / "capture" / "template.npz").template)
    write_mesh(folder / "scan.ply", read_mesh(folder / "capture" / "scans" / "000005.ply").mesh)
    save_poses(folder / "motion.npz", motion(8, 5))
    take = write_work(folder.parent / "take", motion(16, 1))
    quick = ("--shape.max-error-mm", "0.1", "--lstm.layers", "1", "--lstm.size", "16", "--training.epochs", "3")
    assert run("fit", take, "--output", folder / "shirt", "--workers", "1", *quick) == 0
    return folder
