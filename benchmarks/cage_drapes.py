"""What a cage tells of drapes: offsets carried into its patches, and its curves from sparse markers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.interpolate import CubicSpline

from benchmarks.metric import Metric
from capture4d.body.skinning import with_pose
from capture4d.geometry.cages.dirichlet import Extension, conductivity_along, dirichlet_form
from capture4d.geometry.cages.marker_curves import fill_curve
from capture4d.geometry.mesh import flat_edge_lengths, unique_edges
from capture4d.templates.wrapping import Wrap
from capture4d.types import Garment
from data_synth.drapes.draping import Draper
from data_synth.drapes.garments import GARMENTS
from data_synth.drapes.poses import draw_pose
from wrinkles.offset_images.layout import OffsetLayout, encode

GRAIN = 4.0
"""How much better anisotropic bases conduct along the pattern's grain."""
EVERY = (4, 8)
"""Vertices of a curve from marker to marker."""


def drapes_by_cage(draper: Draper, garment: Garment, wrap: Wrap, count: int, seed: int) -> list[Metric]:
    """Errors inside the patches, cm, and along the curves, mm, over random poses."""
    rng = np.random.default_rng(seed)
    limbs = GARMENTS[draper.config.garment].limbs
    poses = [draw_pose(draper.person, limbs, draper.config.poses, rng)[0] for _ in range(count)]
    drapes = [draper.drape(pose).vertices for pose in poses]
    layout = OffsetLayout.create(garment, 64)
    pixel = np.unique(layout.vertex, return_index=True)[1]
    offsets = np.stack(
        [
            100 * encode(layout.anchors(with_pose(draper.person, pose, np.zeros(3))), drape[layout.vertex])[pixel]
            for pose, drape in zip(poses, drapes, strict=True)
        ]
    )
    return [*_carried(garment, wrap, offsets), *_marked(draper, drapes)]


def _carried(garment: Garment, wrap: Wrap, offsets: np.ndarray) -> Iterator[Metric]:
    """How far offsets inside the patches are off when those on the cage are known, beside their mean over all poses."""
    mesh, mean = garment.template, offsets.mean(axis=0)
    assert mesh.uv is not None
    inside = np.setdiff1d(np.arange(len(mean)), wrap.cage.vertices)
    yield Metric("cage_mean_offsets_cm", float(np.linalg.norm((offsets - mean)[:, inside], axis=2).mean()), "cm")
    for kind, conductivity in (("isotropic", None), ("grain", conductivity_along(np.array([0.0, 1.0]), GRAIN))):
        form = dirichlet_form(mesh.faces, mesh.uv, len(mean), conductivity=conductivity)
        extension = Extension(form, wrap.cage.vertices)
        errors = [
            np.linalg.norm(extension((each - mean)[wrap.cage.vertices]) - (each - mean), axis=1)[inside].mean()
            for each in offsets
        ]
        yield Metric(f"cage_{kind}_offsets_cm", float(np.mean(errors)), "cm")


def _marked(draper: Draper, drapes: list[np.ndarray]) -> Iterator[Metric]:
    """How far the garment's seams and borders are off when every so many of their vertices are known."""
    mesh = draper.mesh
    edges = unique_edges(mesh.faces)
    rest = dict(zip(map(tuple, edges.tolist()), flat_edge_lengths(mesh.uv, mesh.faces, edges), strict=True))
    curves = [*mesh.seams.values(), *(np.append(loop, loop[0]) for loop in mesh.loops.values())]
    for every in EVERY:
        kept, splined = [], []
        for curve in curves:
            if len(curve) < every + 2:
                continue
            sides = np.sort(np.column_stack([curve[:-1], curve[1:]]), axis=1).tolist()
            arc = np.concatenate([[0.0], np.cumsum([rest[tuple(side)] for side in sides])])
            marked = np.unique(np.append(np.arange(0, len(curve), every), len(curve) - 1))
            for drape in drapes:
                truth = drape[curve]
                kept.append(np.linalg.norm(fill_curve(arc, marked, truth[marked]) - truth, axis=1).mean())
                spline = CubicSpline(arc[marked], truth[marked])(arc)
                splined.append(np.linalg.norm(spline - truth, axis=1).mean())
        yield Metric(f"marker_every_{every}_mm", 1e3 * float(np.mean(kept)), "mm")
        yield Metric(f"marker_every_{every}_to_spline_ratio", float(np.mean(kept) / np.mean(splined)))
