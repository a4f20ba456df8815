"""How garments lie shrunk onto a body, and what cages carry.

Limits this was built against: the spread of the edges' ratios to their rest lengths after equalisation at most 0.85 of
that after the push-out, at most 1.5 % of the faces flipped, on a T-shirt, trousers and a garment from elsewhere
(`shared/data/makehuman-garments` beside the project; left out where it is absent); bases that sum to one to 1e-12.

Of the demonstrations of a cage (`benchmarks.cage_demos`): how high the middle of the patch lies over its side, which
faces a leaning bump turns over, and the error of a sine against its differential equation. Of curves through markers:
the error on a hoop with four, over that of a periodic spline.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from rich.console import Console
from scipy.interpolate import CubicSpline

from benchmarks.cage_demos import (
    BUMPS,
    DEMOS,
    FOLD_RATIO,
    SINE_HEIGHT,
    Patch,
    boundary,
    facing_down_percent,
    sine_exact,
)
from benchmarks.cage_drapes import drapes_by_cage
from benchmarks.metric import Metric
from capture4d.app.drawing.render import Drawn, View, frame_view, render
from capture4d.body.anny import load_anny
from capture4d.body.skinning import PosedBody, with_pose, with_shape
from capture4d.geometry.cages.marker_curves import curve_through
from capture4d.geometry.cages.shrink_wrap import edge_ratio_spread
from capture4d.geometry.mesh import edge_lengths, face_areas, flat_edge_lengths, unique_edges, vertex_normals
from capture4d.geometry.seams import welded_mesh
from capture4d.mesh_files.meshes import read_mesh
from capture4d.templates.config import UvChoice
from capture4d.templates.garment import TemplateReport, make_template
from capture4d.templates.wrapping import Wrap
from capture4d.types import Body, Garment, Mesh
from data_synth.cloth.patterns import PanelMesh, mesh_pattern
from data_synth.cloth.simulation import dress
from data_synth.drapes.config import STYLES, DrapesConfig, GarmentName
from data_synth.drapes.draping import Draper
from data_synth.drapes.dressing import hung
from data_synth.drapes.garments import GARMENTS

OTHERS = Path(__file__).resolve().parents[2] / "shared" / "data" / "makehuman-garments"
OTHER, OTHER_SCALE, OTHER_LIFT_M = "male_casualsuit06", 0.095, 0.85
"""An outfit for another body, in decimetres about the body's middle; so it lies nearest to the mean person."""
CLOTH, CAGE, SKIN = (190, 205, 230), (200, 30, 30), (214, 190, 172)
STRETCHED = 0.6
"""Logarithm of the area's ratio at which the colours end."""
WIDTH, HEIGHT = 330, 380


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    """A garment on a body."""

    name: str
    mesh: Mesh
    body: PosedBody
    is_pattern: bool
    draper: Draper | None = None
    """Of a garment that came to rest."""


def run(
    *,
    quick: bool = False,
    vertices: int = 3000,
    drapes: int = 12,
    seed: int = 0,
    pictures: Path | None = None,
    others: Path = OTHERS,
) -> list[Metric]:
    """Wrap garments; carry values into a patch.

    Args:
        quick: a third of the vertices, as the panels hang around the body before anything is simulated; rest lengths
            are then those of the hanging panels, not the pattern's.
        vertices: of each garment of ours.
        drapes: of the T-shirt, of which it is measured what its cage tells; none if quick.
        seed: of the patch's mesh and of the garments'.
        pictures: folder for cage-demos.png and shrink-wrap.png.
        others: folder with the garment from elsewhere.
    """
    metrics = [*_cages(np.random.default_rng(seed)), _hoop()]
    rows = []
    for case in _cases(vertices // 3 if quick else vertices, seed, others, hanging=quick):
        garment, report = _template(case, wrap=True)
        assert report.wrap is not None
        metrics += _measured(case, garment, report.wrap)
        Console(stderr=True).print(f"{case.name}: {metrics[-3].value:.2f}, {report.wrap.flipped_percent:.1f} % flipped")
        if case.name == "tshirt" and case.draper is not None and drapes:
            metrics += drapes_by_cage(case.draper, garment, report.wrap, drapes, seed)
        if pictures is not None:
            rows.append(_pictures(case, report.wrap, _flat(garment)))
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        _save(pictures / "shrink-wrap.png", np.concatenate(rows))
        _save(pictures / "cage-demos.png", _demo_pictures(seed))
    return metrics


# --- garments ----------------------------------------------------------------------------------------------------


def _cases(vertices: int, seed: int, others: Path, *, hanging: bool) -> Iterator[_Case]:
    body = load_anny()
    names: tuple[GarmentName, ...] = ("tshirt", "trousers")
    for name in names:
        if hanging:
            yield _hanging(name, body, vertices, seed)
        else:
            draper = Draper(DrapesConfig(garment=name, vertices=vertices, garment_seed=seed), body)
            worn = with_pose(draper.person, draper.dressing, np.zeros(3))
            yield _Case(name, _mesh(draper.dressed, draper.mesh), worn, True, draper)
    path = others / f"{OTHER}.obj"
    if path.is_file():
        mesh = read_mesh(path).mesh
        places = OTHER_SCALE * mesh.vertices + np.array([0, OTHER_LIFT_M, 0])
        person = with_shape(body, np.zeros(0, np.float32))
        rest = with_pose(person, np.repeat(np.eye(3)[None], len(person.joints), axis=0), np.zeros(3))
        yield _Case("suit", Mesh(places.astype(np.float32), mesh.faces, mesh.uv), rest, is_pattern=False)


def _hanging(name: GarmentName, body: Body, vertices: int, seed: int) -> _Case:
    """A garment whose panels hang around the body, not yet at their lengths."""
    kind, person = GARMENTS[name], with_shape(body, np.zeros(0, np.float32))
    pattern = kind.draft(person, STYLES[name]())
    mesh = mesh_pattern(pattern, vertices, np.random.default_rng(seed))
    posed = with_pose(person, kind.dressing(person), np.zeros(3))
    places = (
        dress(person, mesh, pattern, posed, posed.rotations) if kind.hang is None else hung(name, mesh, pattern, posed)
    )
    return _Case(name, Mesh(places.astype(np.float32), mesh.faces.astype(np.int32)), posed, is_pattern=False)


def _template(case: _Case, *, wrap: bool) -> tuple[Garment, TemplateReport]:
    uv: UvChoice = "auto" if case.is_pattern else "none"
    return make_template(case.mesh, case.body, uv=uv, uv_is_pattern=case.is_pattern, wrap=wrap)


def _mesh(places: np.ndarray, mesh: PanelMesh) -> Mesh:
    return Mesh(places.astype(np.float32), mesh.faces.astype(np.int32), mesh.uv.astype(np.float32))


def _flat(garment: Garment) -> np.ndarray | None:
    """(F, 3, 2) the pattern in metres; None without."""
    uv = garment.template.uv
    return garment.pattern_metres * uv.astype(float) if garment.pattern_metres and uv is not None else None


def _rest_lengths(case: _Case, garment: Garment) -> np.ndarray:
    edges, flat = unique_edges(garment.template.faces), _flat(garment)
    if flat is not None:
        return flat_edge_lengths(flat, garment.template.faces, edges)
    return edge_lengths(welded_mesh(case.mesh)[0].vertices.astype(float), edges)


def _measured(case: _Case, garment: Garment, wrap: Wrap) -> list[Metric]:
    plain, _ = _template(case, wrap=False)
    assert plain.embedding_faces is not None
    assert plain.embedding_barycentric is not None
    corners = case.body.vertices()[case.body.shaped.body.template.faces[plain.embedding_faces]]
    nearest = np.einsum("vk,vkc->vc", plain.embedding_barycentric, corners)
    of_nearest = edge_ratio_spread(nearest, garment.template.faces, _rest_lengths(case, garment))
    return [
        Metric(f"wrap_{case.name}_spread_ratio", wrap.spread / wrap.spread_before),
        Metric(f"wrap_{case.name}_spread_to_nearest_ratio", wrap.spread / of_nearest),
        Metric(f"wrap_{case.name}_flipped_percent", wrap.flipped_percent, "%"),
    ]


# --- cages -------------------------------------------------------------------------------------------------------


def _cages(rng: np.random.Generator) -> list[Metric]:
    patch = Patch.jittered(56, rng)
    places = patch.points[patch.border]
    metrics = []
    for kind, folds in (("isotropic", False), ("folds", True)):
        extension = patch.extension(folds=folds)
        moved = {demo: extension(boundary(demo, places)) for demo in DEMOS}
        exact = sine_exact(patch.points, FOLD_RATIO if folds else 1.0)
        error = float(np.sqrt(np.mean((moved["sine"][:, 2] - exact) ** 2))) / SINE_HEIGHT
        down = facing_down_percent(patch.surface(moved["wave"]), patch.faces)
        middle = {demo: patch.height_at(moved[demo], 0.5, 0.5) / height for demo, height in BUMPS.items()}
        bases = extension.bases()
        metrics += [
            Metric(f"cage_{kind}_sum_error", float(np.abs(bases.sum(axis=1) - 1).max())),
            Metric(f"cage_{kind}_undershoot", float(max(-bases.min(), 0.0))),
            *(
                Metric(f"cage_{kind}_{demo}_middle_share", share, better="higher" if folds else "lower")
                for demo, share in middle.items()
            ),
            Metric(f"cage_{kind}_sine_error", error),
            Metric(f"cage_{kind}_wave_down_percent", down, "%", "higher" if folds else "lower"),
        ]
    return metrics


def _hoop() -> Metric:
    """A circle from four markers."""
    angle, fine = 0.5 * np.pi * np.arange(4), np.linspace(0, 2 * np.pi, 400)
    markers = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    curve = curve_through(markers, np.full(4, 0.5 * np.pi), closed=True)
    spline = CubicSpline(np.arange(5) * 0.5 * np.pi, np.concatenate([markers, markers[:1]]), bc_type="periodic")
    off = [np.abs(np.linalg.norm(each(fine), axis=1) - 1).max() for each in (curve, spline)]
    return Metric("marker_hoop_error_to_spline_ratio", float(off[0] / off[1]))


# --- pictures ----------------------------------------------------------------------------------------------------


def _pictures(case: _Case, wrap: Wrap, flat: np.ndarray | None) -> np.ndarray:
    """The cage on the garment; areas on the body after the push-out, and equalised: red is stretched, blue crowded."""
    body = Drawn(case.body.shaped.body.template.with_vertices(case.body.vertices().astype(np.float32)), SKIN)
    low, high = case.mesh.vertices.min(axis=0), case.mesh.vertices.max(axis=0)
    view = frame_view(low, high, "front", aspect=WIDTH / HEIGHT)
    first = welded_mesh(case.mesh)[0]
    faces = first.faces
    paints = np.tile(np.array(CLOTH, np.uint8), (len(wrap.placed.points), 1))
    paints[wrap.cage.vertices] = CAGE
    if flat is None:
        rest = face_areas(first.vertices.astype(float), faces)
    else:
        along, across = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
        rest = np.abs(along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]) / 2
    drawn = [Drawn(first, paints)]
    for placed in (wrap.pushed_out, wrap.placed):
        off = placed.points + 0.003 * vertex_normals(placed.points, faces)
        ratio = np.log(np.maximum(face_areas(placed.points, faces) / np.maximum(rest, 1e-12), 1e-3))
        drawn.append(Drawn(Mesh(off.astype(np.float32), faces), _diverging(ratio - np.median(ratio), faces)))
    return np.concatenate([render([each, body], view, width=WIDTH, height=HEIGHT) for each in drawn], axis=1)


def _diverging(values: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Colours of vertices from values of faces: blue below 0, red above."""
    count = int(faces.max()) + 1
    mean = np.bincount(faces.ravel(), np.repeat(values, 3), count) / np.maximum(np.bincount(faces.ravel()), 1)
    share = np.clip(mean / STRETCHED, -1, 1)[:, None]
    end = np.where(share > 0, np.array([200, 20, 20]), np.array([20, 40, 200]))
    return ((1 - np.abs(share)) * 235 + np.abs(share) * end + 0.5).astype(np.uint8)


def _demo_pictures(seed: int) -> np.ndarray:
    """Four columns, isotropic above."""
    patch, rows = Patch.jittered(56, np.random.default_rng(seed)), []
    view = View((0.5, 0.0, 0.5), 30.0, 35.0, 1.15, 5.0)
    for folds in (False, True):
        extension = patch.extension(folds=folds)
        row = []
        for demo in DEMOS:
            x, y, z = patch.surface(extension(boundary(demo, patch.points[patch.border]))).T
            mesh = Mesh(np.column_stack([x, z, 1 - y]).astype(np.float32), patch.faces)
            row.append(render([Drawn(mesh, CLOTH)], view, width=WIDTH, height=240))
        rows.append(np.concatenate(row, axis=1))
    return np.concatenate(rows)


def _save(path: Path, picture: np.ndarray) -> None:
    Image.fromarray(picture).quantize(256).save(path, optimize=True)  # a third of the file
