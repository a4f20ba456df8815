"""Array shapes and types are checked on every call while tests run, and only then; and a capture to test with."""

import ast
from pathlib import Path

import jaxtyping
import jaxtyping._import_hook
import numpy as np
import pytest

_ROOT = Path(__file__).parents[1]
# tyro puts its own placeholders into the fields of a command that are still to be given, and the front door names
# types that are not loaded before they are needed.
_UNCHECKED = ("capture4d.cli.", "capture4d.pipeline", "capture4d.steps", "capture4d.one_shot")


def _install_shape_checks() -> None:
    """Check every function of ours but compiled kernels, whose source is not Python's to wrap."""
    packages = ("capture4d", "data_synth", "registration", "retarget", "wrinkles", "benchmarks")
    files = [path for package in packages for path in (_ROOT / package).rglob("*.py") if path.name != "__init__.py"]
    modules = {".".join(path.relative_to(_ROOT).with_suffix("").parts) for path in files}
    modules = {name for name in modules if not name.startswith(_UNCHECKED)}

    marked_unchecked = jaxtyping._import_hook._is_no_type_check

    def is_unchecked(decorator: ast.expr) -> bool:
        return marked_unchecked(decorator) or ast.unparse(decorator).startswith(("njit", "wp."))

    jaxtyping._import_hook._is_no_type_check = is_unchecked
    # As for any other type checker, an int will do for a float.
    checker = "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"
    jaxtyping.install_import_hook(sorted(modules), checker)


_install_shape_checks()


def write_tube_capture(folder: Path) -> Path:
    """Three frames of a blue tube of cloth, 0.6 m long, that bends; its two borders are painted yellow.

    No body, no poses; the template is the same tube, unbent, with a tenth of the vertices.
    """
    from capture4d.captures.capture import Capture, write_capture_description, write_scan
    from capture4d.files.records import save_garment
    from capture4d.geometry.mesh import boundary_loops
    from capture4d.types import Garment, Mesh, Scan
    from tests.shapes import tube_faces

    def tube(around: int, along: int, bend_m: float) -> Mesh:
        angle = np.tile(2 * np.pi * np.arange(around) / around, along)
        height = np.repeat(np.linspace(0, 0.6, along), around)
        shift = bend_m * (height / 0.6) ** 2
        vertices = np.stack([0.15 * np.sin(angle) + shift, height, 0.15 * np.cos(angle)], axis=1)
        return Mesh(vertices.astype(np.float32), tube_faces(around, along))

    paint = {"neck": (255, 210, 0), "hem": (255, 210, 0)}
    capture = Capture(folder, "tube", 60.0, (5, 6, 7), (47, 98, 201), paint)
    for frame_id in capture.frame_ids:
        mesh = tube(90, 80, 0.01 * (frame_id - 4))
        painted = (mesh.vertices[:, 1] < 0.012) | (mesh.vertices[:, 1] > 0.588)
        colours = np.where(painted[:, None], paint["hem"], capture.garment_colour).astype(np.uint8)
        write_scan(folder / "scans" / f"{frame_id:06d}.ply", Scan(mesh, colours, frame_id, capture.time_s(frame_id)))
    template = tube(36, 20, 0.0)
    hem, neck = sorted(boundary_loops(template.faces), key=lambda loop: template.vertices[loop, 1].mean())
    save_garment(folder / "template.npz", Garment(template, {"hem": hem, "neck": neck}))
    write_capture_description(capture)
    return folder


@pytest.fixture
def tube_capture(tmp_path: Path) -> Path:
    return write_tube_capture(tmp_path / "capture")


@pytest.fixture(scope="session")
def tube_capture_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same for the whole session, to be copied or read."""
    return write_tube_capture(tmp_path_factory.mktemp("tube") / "capture")
