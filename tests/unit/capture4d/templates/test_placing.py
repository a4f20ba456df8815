"""A garment mesh in any unit, turned any way, is understood by the body it lies on."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from capture4d.body.anny import load_anny
from capture4d.body.skinning import PosedBody, pose_frame, with_shape
from capture4d.captures.placement import place
from capture4d.files.atomic import write_json
from capture4d.files.records import load_garment, save_poses
from capture4d.geometry.mesh import vertex_normals
from capture4d.mesh_files.meshes import write_mesh
from capture4d.templates.body_regions import body_region
from capture4d.templates.config import Axis
from capture4d.templates.garment import make_template
from capture4d.templates.placing import axis_name, find_placement
from capture4d.types import Mesh
from capture4d.units import METRES, Units
from data_synth.motions import CLIPS, scripted_clip
from tests.command_line import run

TURNS = {
    "as it is": np.eye(3),
    "Z up": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "Z down": np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "X up": np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    "back to front": np.diag([-1, 1, -1]),
    "to the side": np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
}


@pytest.fixture(scope="module")
def worn() -> tuple[Mesh, PosedBody]:
    """A shirt 15 mm off a body that stands with its arms out."""
    person = with_shape(load_anny(), np.array([0.4, 0.8], np.float32))
    poses = scripted_clip(person, CLIPS["range-of-motion"], 60.0, 2, np.random.default_rng(0))
    posed = pose_frame(person, poses, 0)
    garment, _ = make_template(body_region(person, "tshirt"), pose_frame(person, poses, 0), uv="none")
    corners = posed.vertices()[person.body.template.faces[garment.embedding_faces]]
    on_body = np.einsum("vk,vkc->vc", garment.embedding_barycentric, corners)
    mesh = Mesh(on_body.astype(np.float32), garment.template.faces)
    normals = vertex_normals(mesh.vertices.astype(np.float64), mesh.faces)
    return mesh.with_vertices((mesh.vertices + 0.015 * normals).astype(np.float32)), posed


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("unit", METRES)
def test_units_and_axes_are_found(worn: tuple[Mesh, PosedBody], turn: str, unit: Units) -> None:
    mesh, body = worn
    filed = mesh.with_vertices((mesh.vertices @ TURNS[turn].T / METRES[unit]).astype(np.float32))
    found = find_placement(filed, body)
    assert found.units == unit
    np.testing.assert_array_equal(found.placement.axes, TURNS[turn].T)
    np.testing.assert_allclose(place(filed, found.placement).vertices, mesh.vertices, atol=1e-5)
    assert found.turned == (turn != "as it is")
    told = find_placement(filed, body, units=unit, up=_file_axis(found.placement.axes[1]))
    np.testing.assert_array_equal(told.placement.axes, found.placement.axes)


def _file_axis(row: np.ndarray) -> Axis:
    return next(axis for axis in get_args(Axis) if axis_name(row) in (axis.upper(), f"+{axis.upper()}"))


def test_what_is_said_is_not_doubted(worn: tuple[Mesh, PosedBody]) -> None:
    mesh, body = worn
    assert find_placement(mesh, body, units="cm").units == "cm"
    found = find_placement(mesh, body, up="z")
    assert axis_name(found.placement.axes[1]) == "+Z"


def test_the_command_says_how_it_read_a_mesh(tmp_path: Path, worn: tuple[Mesh, PosedBody], capsys) -> None:
    mesh, body = worn
    person = body.shaped
    poses = scripted_clip(person, CLIPS["range-of-motion"], 60.0, 2, np.random.default_rng(0))
    save_poses(tmp_path / "poses.npz", poses)
    arguments = ("--poses", tmp_path / "poses.npz")
    write_json(tmp_path / "capture.json", {"boundary_colours": {"bottom": "#ffc400", "neck": "#c81e96"}})
    templates = []
    for name, turn, metres in (("plain", np.eye(3), 1.0), ("turned", TURNS["Z up"], 0.001)):
        write_mesh(
            tmp_path / f"{name}.obj",
            mesh.with_vertices((mesh.vertices @ turn.T / metres).astype(np.float32)),
        )
        output = tmp_path / f"{name}.npz"
        assert run("template", tmp_path / f"{name}.obj", "--output", output, *arguments) == 0
        templates.append(load_garment(output).template)
    out = capsys.readouterr().out
    assert out.count("so it lies on the body") == 1
    assert "read in mm, up is +Z, front is -Y: so it lies on the body" in out
    assert "UVs: cut afresh (no UVs); they are no sewing pattern, so lengths of the cloth are those of the mesh" in out
    assert "boundary_colours names bottom, which the template does not have; rename the paints there" in out
    np.testing.assert_allclose(templates[1].vertices, templates[0].vertices, atol=2e-5)
