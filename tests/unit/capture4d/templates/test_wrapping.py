"""Garments shrunk onto the body: where each vertex belongs is known of a garment made of the body's own surface."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.body.anny import load_anny
from capture4d.body.skinning import PosedBody, with_pose, with_shape
from capture4d.cli.main import main
from capture4d.errors import InputError
from capture4d.files.records import load_garment
from capture4d.geometry.cages.cage import cage_of_curves, cage_of_labels
from capture4d.geometry.mesh import edge_lengths, unique_edges, vertex_normals
from capture4d.mesh_files.meshes import write_mesh
from capture4d.templates.body_regions import body_region
from capture4d.templates.cage_files import read_cage
from capture4d.templates.garment import make_template
from capture4d.templates.wrapping import CageMarks
from capture4d.types import Garment, Mesh


@pytest.fixture(scope="module")
def body() -> PosedBody:
    person = with_shape(load_anny(), np.array([0.3, 0.5], np.float32))
    return with_pose(person, np.repeat(np.eye(3)[None], len(person.joints), axis=0), np.zeros(3))


@pytest.fixture(scope="module")
def skin(body: PosedBody) -> Mesh:
    """Trousers' part of the body."""
    return body_region(body.shaped, "shorts")


def worn(skin: Mesh, bulge_m: float) -> Mesh:
    """The skin moved off itself, with folds, and without UVs."""
    vertices = skin.vertices.astype(float)
    normals = vertex_normals(vertices, skin.faces)
    height = bulge_m * (1 + 0.5 * np.sin(60 * vertices[:, :1]) * np.sin(50 * vertices[:, 1:2]))
    return Mesh((vertices + height * normals).astype(np.float32), skin.faces)


def on_body(garment: Garment, body: PosedBody) -> np.ndarray:
    corners = body.vertices()[body.shaped.body.template.faces[garment.embedding_faces]]
    return np.einsum("vk,vkc->vc", garment.embedding_barycentric, corners)


def test_cloth_comes_back_to_the_skin_it_was_lifted_from(body: PosedBody) -> None:
    """Without the crowds and gaps of nearest points, which are exact elsewhere: cloth was lifted along the normals."""
    skin = body_region(body.shaped, "tshirt")
    edges = unique_edges(skin.faces)
    lengths = edge_lengths(skin.vertices.astype(float), edges)
    worst_mm, spread = {}, {}
    for wrap in (False, True):
        garment, report = make_template(worn(skin, 0.02), body, uv="none", wrap=wrap)
        places = on_body(garment, body)
        worst_mm[wrap] = 1e3 * np.linalg.norm(places - skin.vertices, axis=1).max()
        spread[wrap] = float((edge_lengths(places, edges) / lengths).std())
    assert worst_mm[True] < 0.5 * worst_mm[False]
    assert spread[True] < 0.3 * spread[False]
    assert report.wrap is not None
    assert report.wrap.spread < 0.6 * report.wrap.spread_before
    assert report.wrap.flipped_percent < 1.5
    assert report.wrap.cage.patch_count > 6


def test_the_command_takes_labels_and_curves(tmp_path: Path, body: PosedBody, skin: Mesh, capsys) -> None:
    cloth = worn(body_region(with_shape(load_anny(), np.zeros(0)), "shorts"), 0.015)
    mesh, output = str(tmp_path / "shorts.obj"), tmp_path / "template.npz"
    write_mesh(mesh, cloth)
    left = cloth.vertices[cloth.faces].mean(axis=1)[:, 0] > 0
    np.save(tmp_path / "sides.npy", left.astype(np.uint8))
    front = np.flatnonzero(np.abs(cloth.vertices[:, 0]) < 0.03)
    curve = front[np.argsort(cloth.vertices[front, 1])][[0, -1]].tolist()
    (tmp_path / "middle.json").write_text(json.dumps({"curves": [curve]}))
    found = []
    by_labels = cage_of_labels(cloth.faces, left.astype(np.uint8))
    by_curve = cage_of_curves(cloth.vertices, cloth.faces, [np.array(curve)])
    for cage, patches in (("sides.npy", by_labels.patch_count), ("middle.json", by_curve.patch_count)):
        options = ["--wrap", "--cage", str(tmp_path / cage), "--uv", "none", "--overwrite", "--output", str(output)]
        with pytest.raises(SystemExit) as ended:
            main(["template", mesh, *options])
        assert ended.value.code == 0
        assert f"wrapped: {patches} patches in a cage of" in capsys.readouterr().out
        found.append(load_garment(output))
    assert (found[0].embedding_faces != found[1].embedding_faces).mean() > 0.02


def test_a_cage_that_does_not_fit_is_told_by_its_file(tmp_path: Path, body: PosedBody, skin: Mesh) -> None:
    np.save(tmp_path / "labels.npy", np.zeros(7, np.int32))
    with pytest.raises(InputError, match=r"labels\.npy: expected a label for each of \d+ triangles, found \(7,\)"):
        make_template(skin, body, wrap=read_cage(tmp_path / "labels.npy"))
    marks = CageMarks(curves=(np.array([0, 10**6], np.int32),), source="curves.json")
    with pytest.raises(InputError, match=r"curves\.json: expected vertices from 0 to \d+, found 1000000"):
        make_template(skin, body, wrap=marks)
    np.save(tmp_path / "floats.npy", np.zeros(7))
    (tmp_path / "short.json").write_text('{"curves": [[1]]}')
    (tmp_path / "words.txt").write_text("1 2")
    for name, expected in (
        ("floats.npy", "expected a whole number below"),
        ("short.json", r"expected two or more vertices, found 1 in curves\[0\]"),
        ("words.txt", r"expected a cage as \.npy or \.json, found '\.txt'"),
        ("none.npy", "no such cage"),
    ):
        with pytest.raises(InputError, match=expected):
            read_cage(tmp_path / name)
    with pytest.raises(SystemExit):
        main(["template", "--region", "tshirt", "--cage", "a.npy", "--output", str(tmp_path / "t.npz")])


def test_a_garment_that_is_wound_inside_out_is_wrapped_alike(body: PosedBody, skin: Mesh) -> None:
    cloth = worn(skin, 0.015)
    inside_out = replace(cloth, faces=np.ascontiguousarray(cloth.faces[:, ::-1]))
    places = [on_body(make_template(each, body, uv="none", wrap=True)[0], body) for each in (cloth, inside_out)]
    assert np.linalg.norm(places[0] - places[1], axis=1).mean() < 0.001
