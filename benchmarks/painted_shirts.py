"""Shirts with painted borders as somebody else might make them: cut from a dressed person's surface, meshed anew.

Each has a cut of its own (sleeves, hem, neck), paints of its own, a pattern of blobs on its cloth, and a template that
quadric errors thinned; the scan is fused from virtual depth cameras after a small motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8

from benchmarks.dressed_people import SUBJECTS, Clothes, draw_shape, standing, way_to
from capture4d.body.anny import load_anny
from capture4d.body.skinning import with_shape
from capture4d.geometry.mesh import boundary_loops, connected_components
from capture4d.geometry.ray_casting import closest_points
from capture4d.heavy_imports import import_open3d
from capture4d.types import Mesh
from data_synth.motions import random_pose
from data_synth.scanner.border_paint import paint_borders
from data_synth.scanner.config import FusionConfig, RigConfig, ScannerConfig
from data_synth.scanner.rig import bounding_sphere, scanner_rig
from data_synth.scanner.scan import LABEL_GARMENT, Surface, scan_surfaces

__all__ = ["PaintedShirt", "make_shirt"]

COLOURS = ((47, 98, 201), (186, 52, 58), (118, 128, 58), (150, 152, 156), (90, 60, 120))
PAINTS = ((255, 210, 0), (52, 210, 96), (240, 72, 170), (0, 210, 220), (250, 140, 20))
VOXEL_M = 0.0035


@dataclass(frozen=True, slots=True, eq=False)
class PaintedShirt:
    """A template, a coloured scan, and the truth; metres."""

    template: Mesh
    scan: Mesh
    colours: UInt8[np.ndarray, "points 3"]
    paint: str
    """RRGGBB."""
    truth: Mesh
    places: Float64[np.ndarray, "verts 3"]
    """Where the template's vertices truly are."""
    true_borders: Mapping[str, np.ndarray]
    loops: Mapping[str, np.ndarray]
    """The template's loops under the same names."""


def make_shirt(seed: int, *, drawn: bool = False) -> PaintedShirt:
    """One shirt, in 2 to 4 CPU seconds.

    Args:
        drawn: of somebody whose shape is drawn, too.
    """
    rng = np.random.default_rng([7, seed])
    shape = draw_shape(rng) if drawn else SUBJECTS[seed % len(SUBJECTS)]
    clothes = Clothes.tailor(with_shape(load_anny(), np.array(shape)), rng)
    first, last = standing(clothes.shaped, rng), random_pose(clothes.shaped, rng)
    before, after = way_to(clothes, first, last, rng.uniform(0.015, 0.05))
    faces = _cut(clothes, rng)
    used, renumbered = np.unique(faces, return_inverse=True)
    faces = renumbered.reshape(-1, 3).astype(np.int32)
    own, truth = (Mesh(points[used].astype(np.float32), faces) for points in (before, after))
    template = _thinned(own, int(rng.uniform(2000, 6000)))
    _, face, barycentric = closest_points(own, template.vertices)
    paint = PAINTS[rng.integers(len(PAINTS))]
    scan, colours = _scan(truth, paint, rng)
    loops = boundary_loops(template.faces)
    curves = boundary_loops(faces)
    middles = np.array([own.vertices[curve].mean(axis=0) for curve in curves])
    nearest = [int(np.linalg.norm(middles - template.vertices[loop].mean(axis=0), axis=1).argmin()) for loop in loops]
    return PaintedShirt(
        template=template,
        scan=scan,
        colours=colours,
        paint="{:02x}{:02x}{:02x}".format(*paint),
        truth=truth,
        places=np.einsum("vc,vca->va", barycentric, truth.vertices[faces[face]].astype(np.float64)),
        true_borders={f"border_{index}": truth.vertices[curve] for index, curve in enumerate(curves)},
        loops={f"border_{curve}": loop for curve, loop in zip(nearest, loops, strict=True)},
    )


def _cut(clothes: Clothes, rng: np.random.Generator) -> np.ndarray:
    """Faces of the person's surface that become a shirt: one piece with a neck, a hem and two cuffs."""
    shaped, rest = clothes.shaped, clothes.rest
    names = np.array(shaped.body.joint_names)
    joint = {name: shaped.joints[index] for index, name in enumerate(names)}
    weights = clothes.weights
    arms = weights[:, [name.startswith(("upperarm", "lowerarm", "wrist")) for name in names]].sum(axis=1)
    sleeve, hem = rng.uniform(0.3, 0.8), joint["upperleg01.L"][1] + rng.uniform(-0.02, 0.08)
    reach = np.abs(joint["upperarm01.L"][0]) + sleeve * np.linalg.norm(joint["wrist.L"] - joint["upperarm01.L"]) * 0.66
    neck = joint["neck01"]
    collar = np.linalg.norm(rest - neck, axis=1) < rng.uniform(0.085, 0.11)
    kept = np.where(arms > 0.5, np.abs(rest[:, 0]) < reach, rest[:, 1] > hem)
    kept &= ~collar & (rest[:, 1] < neck[1] + 0.08)
    faces = clothes.faces[kept[clothes.faces].all(axis=1)]
    part = connected_components(faces, len(rest))[faces[:, 0]]
    return faces[part == np.bincount(part).argmax()]


def _thinned(mesh: Mesh, vertices: int) -> Mesh:
    o3d = import_open3d()
    legacy = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices.astype(float)), o3d.utility.Vector3iVector(mesh.faces)
    )
    simple = legacy.simplify_quadric_decimation(2 * vertices, boundary_weight=10.0)
    return Mesh(np.asarray(simple.vertices, np.float32), np.asarray(simple.triangles, np.int32))


def _scan(truth: Mesh, paint: tuple[int, int, int], rng: np.random.Generator) -> tuple[Mesh, np.ndarray]:
    cloth = COLOURS[rng.integers(len(COLOURS))]
    loops = len(boundary_loops(truth.faces))
    sheet = paint_borders(
        truth,
        width_m=rng.uniform(0.009, 0.016),
        garment_colour=cloth,
        border_colours=[paint] * loops,
        max_edge_m=VOXEL_M,
    )
    mesh, colours = sheet.posed(truth.vertices), sheet.colours.copy()
    waves = np.sin(mesh.vertices @ rng.normal(0, 60, (3, 2))).prod(axis=1)
    dark = (waves > 0.3) & ~sheet.painted
    colours[dark] = (colours[dark] * 0.75).astype(np.uint8)
    scanner = ScannerConfig(rig=RigConfig(cameras=32, image_size=480), fusion=FusionConfig(garment_voxel_m=VOXEL_M))
    centre, radius = bounding_sphere(mesh.vertices)
    rig = scanner_rig(scanner, centre=centre, radius=radius)
    scan, _ = scan_surfaces(
        rig, [Surface(mesh, colours, LABEL_GARMENT, VOXEL_M, sheet.painted)], config=scanner, rng=rng
    )
    return scan.mesh, scan.colours
