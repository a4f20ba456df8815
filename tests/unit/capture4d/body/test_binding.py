"""Binding: what lies on the body moves as it does, and a template follows its wearer to another shape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from capture4d.body.anny import load_anny
from capture4d.body.binding import bind, diffuse, with_body_shape
from capture4d.body.skinning import pose_frame, skin, with_pose, with_shape
from capture4d.errors import InputError
from capture4d.geometry.mesh import submesh, vertex_normals
from capture4d.types import Body, Garment, Mesh
from data_synth.motions import CLIPS, scripted_clip

SHAPE = np.array([0.7, -0.4, 0.5], np.float32)


def shirt_like(body: Body, shape: np.ndarray, gap_m: float) -> Garment:
    """The trunk of a person, so far outside of the skin, bound to it."""
    person = with_shape(body, shape)
    rest = with_pose(person, np.repeat(np.eye(3)[None], len(body.joint_names), axis=0), np.zeros(3))
    trunk = body.skin_weights[:, [name.startswith("spine") for name in body.joint_names]].sum(axis=1) > 0.9
    skin_mesh = Mesh(person.vertices.astype(np.float32), body.template.faces)
    mesh, kept = submesh(skin_mesh, trunk[body.template.faces].all(axis=1))
    normals = vertex_normals(person.vertices, body.template.faces)[kept]
    mesh = mesh.with_vertices((person.vertices[kept] + gap_m * normals).astype(np.float32))
    faces, barycentric, weights = bind(mesh.vertices, mesh.faces, rest)
    return Garment(mesh, {}, faces, barycentric, weights.astype(np.float32), shape)


def test_what_lies_on_the_skin_is_carried_by_it() -> None:
    body = load_anny()
    garment = shirt_like(body, SHAPE, 0.0)
    person = with_shape(body, SHAPE)
    poses = scripted_clip(person, CLIPS["twist"], 60.0, 30, np.random.default_rng(0))
    posed = pose_frame(person, poses, 29)
    carried = skin(garment.template.vertices, garment.skin_weights, posed.transforms)
    corners = posed.vertices()[body.template.faces[garment.embedding_faces]]
    on_body = np.einsum("vk,vkc->vc", garment.embedding_barycentric, corners)
    assert np.linalg.norm(carried - on_body, axis=1).mean() < 0.003


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_template_follows_its_wearer_to_another_shape_and_back(seed: int) -> None:
    body = load_anny()
    garment = shirt_like(body, SHAPE, 0.01)
    other = np.random.default_rng(seed).normal(0, 1, 6).astype(np.float32)
    moved = with_body_shape(garment, body, other)
    wanted = shirt_like(body, other, 0.01)
    before = np.linalg.norm(garment.template.vertices - wanted.template.vertices, axis=1).mean()
    after = np.linalg.norm(moved.template.vertices - wanted.template.vertices, axis=1).mean()
    assert after < min(0.1 * before, 0.003)
    back = with_body_shape(moved, body, SHAPE)
    np.testing.assert_allclose(back.template.vertices, garment.template.vertices, atol=1e-6)


def test_the_same_shape_and_an_unknown_wearer_change_nothing() -> None:
    body = load_anny()
    garment = shirt_like(body, SHAPE, 0.01)
    same = with_body_shape(garment, body, np.append(SHAPE, 0).astype(np.float32))
    np.testing.assert_array_equal(same.template.vertices, garment.template.vertices)
    unknown = replace(garment, body_shape=None)
    assert with_body_shape(unknown, body, SHAPE + 1) is unknown


def test_another_body_is_refused() -> None:
    body = load_anny()
    garment = shirt_like(body, SHAPE, 0.01)
    fewer = replace(body, template=Mesh(body.template.vertices, body.template.faces[:100]))
    with pytest.raises(InputError, match="expected an embedding in the body's 100 faces, found face"):
        with_body_shape(garment, fewer, SHAPE + 1)


def test_diffusion_keeps_constants_and_lone_vertices() -> None:
    faces = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    values = np.array([[1.0], [1.0], [1.0], [1.0], [9.0]])
    np.testing.assert_allclose(diffuse(values, faces, 5), values)
