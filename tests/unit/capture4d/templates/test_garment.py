"""Templates of one's own: a mesh that lies on the posed body comes back in the rest pose, bound, its borders named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from capture4d.body.anny import load_anny
from capture4d.body.skinning import PosedBody, ShapedBody, pose_frame, with_pose, with_shape
from capture4d.cli.main import main
from capture4d.errors import InputError
from capture4d.files.records import load_garment, save_body, save_poses
from capture4d.geometry.mesh import boundary_loops, unique_edges
from capture4d.geometry.seams import welded_mesh
from capture4d.geometry.uv_atlas import check_uv, fresh_uv
from capture4d.mesh_files.meshes import write_mesh
from capture4d.templates.body_regions import body_region
from capture4d.templates.config import Region, TemplateConfig
from capture4d.templates.garment import make_template
from capture4d.templates.stage import run
from capture4d.types import Mesh
from data_synth.motions import CLIPS, scripted_clip
from tests.shapes import tube_faces

SHAPE = np.array([0.5, -0.6, 0.3], np.float32)
LOOPS = {
    "tshirt": {"neck", "hem", "cuff_left", "cuff_right"},
    "longsleeve": {"neck", "hem", "cuff_left", "cuff_right"},
    "trousers": {"waist", "leg_left", "leg_right"},
    "shorts": {"waist", "leg_left", "leg_right"},
}


@pytest.fixture(scope="module")
def person() -> ShapedBody:
    return with_shape(load_anny(), SHAPE)


@pytest.mark.parametrize("region", get_args(Region))
def test_a_region_is_a_template_with_its_borders_named(tmp_path: Path, region) -> None:
    result = run(None, tmp_path / "template.npz", TemplateConfig(region=region))
    garment, report = result.garment, result.report
    assert result.path == tmp_path / "template.npz"
    assert set(garment.loops) == LOOPS[region]
    assert report.distance_m < 1e-5
    assert check_uv(garment.template).faults() == ()
    assert len(boundary_loops(garment.template.faces)) == len(garment.loops)
    for name, loop in garment.loops.items():
        if name.endswith("left"):
            assert (garment.template.vertices[loop, 0] > 0).all()
        steps = np.diff(garment.template.vertices[np.append(loop, loop[0])], axis=0)
        assert np.linalg.norm(steps, axis=1).max() < 0.05, "neighbours in a loop are neighbours on the cloth"
    np.testing.assert_array_equal(load_garment(tmp_path / "template.npz").template.uv, garment.template.uv)


def test_borders_of_a_region_are_smooth(person: ShapedBody) -> None:
    """The hem of a shirt lies in a plane, whatever the faces of the body are like."""
    mesh = body_region(person, "tshirt")
    loops = sorted(boundary_loops(mesh.faces), key=lambda loop: mesh.vertices[loop, 1].mean())
    assert np.ptp(mesh.vertices[loops[0], 1]) < 1e-3


def test_a_posed_mesh_in_centimetres_comes_back_to_the_rest_pose(tmp_path: Path, person: ShapedBody) -> None:
    poses = scripted_clip(person, CLIPS["range-of-motion"], 60.0, 40, np.random.default_rng(0))
    posed = pose_frame(person, poses, 25)
    garment, _ = make_template(body_region(person, "tshirt"), _rest(person))
    corners = posed.vertices()[person.body.template.faces[garment.embedding_faces]]
    on_body = np.einsum("vk,vkc->vc", garment.embedding_barycentric, corners)
    write_mesh(tmp_path / "shirt.obj", Mesh((100 * on_body).astype(np.float32), garment.template.faces))
    save_body(tmp_path / "body.npz", person.body)
    save_poses(tmp_path / "poses.npz", replace(poses, frame_ids=poses.frame_ids + np.int32(100)))
    config = TemplateConfig(pose_frame=125, mesh_units="cm")
    output, body, motion = (tmp_path / name for name in ("template.npz", "body.npz", "poses.npz"))
    result = run(tmp_path / "shirt.obj", output, config, body=body, poses=motion)
    found, report = result.garment, result.report
    apart = np.linalg.norm(found.template.vertices - garment.template.vertices, axis=1)
    assert apart.mean() < 0.004
    assert report.distance_m < 1e-4
    assert set(found.loops) == LOOPS["tshirt"]
    np.testing.assert_array_equal(found.body_shape, SHAPE)
    with pytest.raises(InputError, match=r"expected a pose for frame 7, found frames 100 to 139"):
        run(tmp_path / "shirt.obj", tmp_path / "t.npz", TemplateConfig(pose_frame=7), poses=motion)


@pytest.mark.parametrize("kind", ["glb", "ply", "obj"])
def test_seams_are_sewn_up(kind: str, tmp_path: Path, person: ShapedBody) -> None:
    mesh = body_region(person, "shorts")
    split = Mesh(
        mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(3 * len(mesh.faces), dtype=np.int32).reshape(-1, 3)
    )
    sewn, _ = welded_mesh(split)
    assert len(sewn.vertices) == len(mesh.vertices)
    assert len(unique_edges(sewn.faces)) == len(unique_edges(mesh.faces))
    np.testing.assert_array_equal(sewn.vertices[sewn.faces], mesh.vertices[mesh.faces])
    write_mesh(tmp_path / f"shorts.{kind}", split)
    garment = run(tmp_path / f"shorts.{kind}", tmp_path / "template.npz").garment
    assert set(garment.loops) == LOOPS["shorts"]


def test_good_uvs_are_kept_and_bad_ones_replaced(person: ShapedBody) -> None:
    mesh = body_region(person, "tshirt")
    good = replace(mesh, uv=fresh_uv(mesh))
    garment, report = make_template(good, _rest(person))
    assert not report.fresh_uv
    np.testing.assert_array_equal(garment.template.uv, good.uv)

    doubled = np.where((np.arange(len(mesh.faces)) % 2 == 0)[:, None, None], good.uv, np.roll(good.uv, 1, axis=0))
    for uv, fault in (
        (doubled, "used twice"),
        (np.where(np.arange(len(mesh.faces))[:, None, None] % 3 == 0, good.uv[:, ::-1], good.uv), "flipped"),
        (np.zeros_like(good.uv), "without area"),
        (good.uv + 500, "beyond 100"),
    ):
        bad = replace(mesh, uv=np.ascontiguousarray(uv, np.float32))
        assert any(fault in found for found in check_uv(bad).faults()), fault
        _, report = make_template(bad, _rest(person))
        assert report.fresh_uv
        with pytest.raises(InputError, match=f"expected UVs that can be kept, found .*{fault}"):
            make_template(bad, _rest(person), uv="keep")


def test_fresh_uvs_keep_lengths(person: ShapedBody) -> None:
    mesh = body_region(person, "trousers")
    uv = fresh_uv(mesh)
    on_mesh = np.linalg.norm(np.diff(mesh.vertices[mesh.faces], axis=1), axis=2)
    in_atlas = np.linalg.norm(np.diff(uv, axis=1), axis=2)
    assert 0.95 < np.median(in_atlas / np.maximum(on_mesh, 1e-9)) < 1.05


def test_what_cannot_be_a_template_is_told_in_one_line(tmp_path: Path, person: ShapedBody, capsys) -> None:
    mesh, rest = body_region(person, "shorts"), _rest(person)
    for faces, expected in (
        (np.vstack([mesh.faces, mesh.faces[:1]]), "at most two faces at an edge"),
        (np.vstack([mesh.faces[:1, ::-1], mesh.faces[1:]]), "wound alike"),
        (np.vstack([mesh.faces, [[0, 0, 1]]]), "three different corners"),
    ):
        with pytest.raises(InputError, match=expected):
            make_template(Mesh(mesh.vertices, np.ascontiguousarray(faces, np.int32)), rest)
    ball = np.array([[0, 1, 0], [0.1, 1, 0], [0, 1.1, 0], [0, 1, 0.1]], np.float32)
    tetrahedron = Mesh(ball, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32))
    with pytest.raises(InputError, match="expected a garment with open borders, found a closed surface"):
        make_template(tetrahedron, rest)
    with pytest.raises(InputError, match=r"expected a garment on the body, found it \d+ mm off"):
        make_template(mesh.with_vertices(mesh.vertices * np.float32(100)), rest)
    with pytest.raises(InputError, match=r"expected 3 different names for loops of .* vertices, found 2"):
        make_template(mesh, rest, names=("a", "b"))
    stray = Mesh(np.vstack([mesh.vertices, [[0, 1, 0]]]).astype(np.float32), mesh.faces)
    with pytest.raises(InputError, match="expected every vertex in a face, found 1 in none"):
        make_template(stray, rest)
    with pytest.raises(SystemExit) as stopped:
        main(["template", "--output", str(tmp_path / "template.npz")])
    assert stopped.value.code == 1
    assert capsys.readouterr().err == "capture4d: template: expected a mesh or --region, found neither\n"


@pytest.mark.parametrize("follow", ["skin", "distance", "root"])
def test_a_skirt_has_a_waist_and_a_hem(person: ShapedBody, follow) -> None:
    skirt = _tube(person, top=0.1, bottom=-0.45)
    garment, _ = make_template(skirt, _rest(person), follow=follow)
    assert set(garment.loops) == {"waist", "hem"}
    assert skirt.vertices[garment.loops["waist"], 1].min() > skirt.vertices[garment.loops["hem"], 1].max()
    names, weights = person.body.joint_names, garment.skin_weights
    assert weights is not None
    arms = [index for index, name in enumerate(names) if name.startswith(("upperarm", "lowerarm", "wrist"))]
    assert weights[:, arms].sum(axis=1).max() < (0.3 if follow == "distance" else 1.1)
    assert (weights[:, 0] == 1).all() == (follow == "root")


def test_a_tube_around_the_chest_has_a_neck(person: ShapedBody) -> None:
    garment, _ = make_template(_tube(person, top=0.4, bottom=-0.1), _rest(person))
    assert set(garment.loops) == {"neck", "hem"}


def _tube(person: ShapedBody, *, top: float, bottom: float) -> Mesh:
    """Around the trunk, from so far above the root joint to so far below, metres."""
    root = person.joints[person.body.joint_names.index("root")]
    angle = np.tile(2 * np.pi * np.arange(60) / 60, 24)
    height = np.repeat(np.linspace(bottom, top, 24), 60)
    ring = np.stack([0.2 * np.sin(angle), height, 0.16 * np.cos(angle)], axis=1)
    return Mesh((root + ring).astype(np.float32), tube_faces(60, 24))


def _rest(person: ShapedBody) -> PosedBody:
    return with_pose(person, np.repeat(np.eye(3)[None], len(person.joints), axis=0), np.zeros(3))
