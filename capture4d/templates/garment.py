"""A template for registration from any garment mesh that lies on a body, or from a part of the body itself.

What registration needs beside the mesh: the rest pose, skin weights and the body point under every vertex, border loops
in order and by name, UVs that can be used. Loops are named by the part of the body they go around.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64, Int32

from capture4d.body.binding import WEIGHT_SMOOTHING, diffuse, loose_weights
from capture4d.body.posed_surface import Matches, PosedSurface, match, tracked_body
from capture4d.body.sewing_pattern import PatternFit, as_pattern, fit_pattern
from capture4d.body.skinning import PosedBody, unskin
from capture4d.captures.names import require_plain_names
from capture4d.errors import InputError
from capture4d.geometry.cages.dirichlet import flattened
from capture4d.geometry.mesh import boundary_loops, edge_uses, half_edges, vertex_normals
from capture4d.geometry.seams import welded_mesh
from capture4d.geometry.uv_atlas import UvReport, check_uv, fresh_uv
from capture4d.templates.config import Follow, UvChoice
from capture4d.templates.wrapping import CageMarks, Wrap, found_cage, wrap_garment
from capture4d.types import Body, Garment, Mesh

__all__ = ["TemplateReport", "make_template", "name_loops"]

FAR_M = 0.25
"""A garment whose vertices lie farther than this from the body, in the median, is not on it."""
LEAST_SIZE_M = 0.05
"""A smaller mesh is no garment in these units, though it may lie near a foot."""
NORMAL_WEIGHT = 4.0
"""How much more facing counts than in tracking: loose cloth hangs centimetres away from its limb."""
ARM = r"upperarm|lowerarm|wrist|elbow|_shoulder|_hand"
ARM_SHARE = 0.3
"""Skin that arms move by more than this is no skin of trunk or legs."""
LEG = r"upperleg|lowerleg|foot|knee|ankle|_hip"
NECK = r"neck|head"


@dataclass(frozen=True, slots=True)
class TemplateReport:
    """What was found, and done."""

    vertices: int
    faces: int
    distance_m: float
    """Of the vertices from the body, median."""
    uv: UvReport
    """Of the mesh as it came."""
    fresh_uv: bool
    pattern: PatternFit | None = None
    """How the UVs that were kept compare with a sewing pattern; None where none were kept."""
    wrap: Wrap | None = None
    """How the mesh lies shrunk onto the body; None where its vertices are bound to their nearest body points."""


def make_template(
    mesh: Mesh,
    body: PosedBody,
    *,
    uv: UvChoice = "auto",
    uv_is_pattern: bool = False,
    follow: Follow = "skin",
    names: Sequence[str] = (),
    wrap: bool | CageMarks = False,
    source: str = "mesh",
) -> tuple[Garment, TemplateReport]:
    """Bind a mesh to the body it lies on, and take it to the rest pose.

    Args:
        mesh: metres, in the world of the posed body. Where it is split at seams, the template is joined; UVs, which
            belong to face corners, stay.
        uv: keep the mesh's, cut `fresh` ones, have `none`; `auto` keeps them if nothing is wrong with them.
        uv_is_pattern: the UVs are the sewing pattern, whatever they look like; else they are compared with one.
        follow: what moves it, as `TemplateConfig.follow` says.
        names: of the loops, the one with the most vertices first; found by position if empty.
        wrap: bind each vertex to where it comes to lie when the mesh is shrunk onto the body, not to its nearest point;
            along a cage that is found, or that is marked on the mesh as it came.
        source: what errors call the mesh.
    Raises:
        InputError: the mesh cannot be a template; says what was expected.
    """
    mesh, welded = welded_mesh(mesh)
    _require_surface(mesh, source, against=welded.against)
    size = float(np.ptp(mesh.vertices, axis=0).max())
    if size < LEAST_SIZE_M:
        raise InputError(f"expected a garment, found a mesh of {1e3 * size:.2g} mm; its units differ", where=source)
    binding = _Binding.to_nearest(mesh, body)
    distance = float(np.median(np.linalg.norm(mesh.vertices - binding.nearest.points, axis=1)))
    if distance > FAR_M:
        raise InputError(
            f"expected a garment on the body, found it {1e3 * distance:.0f} mm off in the median; "
            "its units, its place or the pose differ",
            where=source,
        )
    found = check_uv(mesh)
    if uv_is_pattern and uv in ("fresh", "none"):
        raise InputError(f"expected UVs that are kept, being the pattern; found --uv {uv}", where=source)
    kept, fresh = (mesh.uv, False) if uv_is_pattern else _choose_uv(mesh, found, uv, source)
    own = fresh or (kept is None and not uv_is_pattern)
    metres, pattern = _pattern(mesh, source, own=own, told=uv_is_pattern)
    wrapped = None
    if wrap is not False:
        panels = None if own else kept
        marked = found_cage(mesh, binding.weights, panels) if wrap is True else wrap.on(mesh, welded.of_vertex)
        flat = metres * kept.astype(np.float64) if metres and kept is not None else flattened(mesh.vertices, mesh.faces)
        wrapped = wrap_garment(mesh, binding.surface, binding.normals, binding.nearest.points, cage=marked, flat=flat)
        binding = binding.moved_to(mesh, wrapped.placed.faces, wrapped.placed.barycentric)
    weights = binding.weights
    if follow != "skin":
        arms = _share_of(body.shaped.body, ARM)
        weights = loose_weights(mesh.vertices, body, near=arms < ARM_SHARE, follow=follow).astype(np.float32)
    rest, flagged = unskin(mesh.vertices, weights, body.transforms)
    if flagged.any():
        raise InputError(
            f"expected a pose that can be undone, found {flagged.sum()} vertices between limbs", where=source
        )
    loops = boundary_loops(mesh.faces)
    garment = Garment(
        template=Mesh(rest.astype(np.float32), mesh.faces, kept),
        loops=dict(zip(_loop_names(loops, names, weights, rest, body.shaped.body, source), loops, strict=True)),
        embedding_faces=binding.faces,
        embedding_barycentric=binding.barycentric.astype(np.float32),
        skin_weights=weights,
        body_shape=np.asarray(body.shaped.shape, np.float32),
        pattern_metres=metres,
    )
    return garment, TemplateReport(len(mesh.vertices), len(mesh.faces), distance, found, fresh, pattern, wrapped)


@dataclass(frozen=True, slots=True, eq=False)
class _Binding:
    """Body point and skin weights of each vertex of a mesh that lies on a posed body."""

    surface: PosedSurface
    normals: Float64[np.ndarray, "verts 3"]
    """Of the mesh, turned as the body faces, as long as they weigh in a match."""
    nearest: Matches
    faces: Int32[np.ndarray, " verts"]
    barycentric: Float64[np.ndarray, "verts 3"]
    weights: Float32[np.ndarray, "verts joints"]

    @staticmethod
    def to_nearest(mesh: Mesh, body: PosedBody) -> _Binding:
        """To the nearest body points that face the same way.

        The inside of a sleeve hangs nearer to the trunk than to the arm. Which way the garment faces is what most of it
        agrees on with the body.
        """
        model, skin = tracked_body(body.shaped.body), body.vertices()
        surface = PosedSurface(model, body, skin, vertex_normals(skin, body.shaped.body.template.faces))
        vertices = mesh.vertices.astype(np.float64)
        normals = vertex_normals(vertices, mesh.faces)
        plain = match(surface, vertices, np.zeros_like(normals))
        if np.einsum("va,va->v", plain.normals, normals).sum() < 0:
            normals = -normals
        normals = NORMAL_WEIGHT * normals
        nearest = match(surface, vertices, normals)
        weights = _smooth_weights(mesh, body.shaped.body, nearest.faces, nearest.barycentric)
        return _Binding(surface, normals, nearest, nearest.faces, nearest.barycentric, weights)

    def moved_to(self, mesh: Mesh, faces: np.ndarray, barycentric: np.ndarray) -> _Binding:
        """To other body points."""
        weights = _smooth_weights(mesh, self.surface.model.body, faces, barycentric)
        return replace(self, faces=faces, barycentric=barycentric, weights=weights)


def _smooth_weights(
    mesh: Mesh, body: Body, faces: np.ndarray, barycentric: np.ndarray
) -> Float32[np.ndarray, "verts joints"]:
    """Skin weights of the body under each vertex, diffused over the mesh."""
    weights = np.einsum("vk,vkj->vj", barycentric, body.skin_weights[body.template.faces[faces]])
    weights = diffuse(weights, mesh.faces, WEIGHT_SMOOTHING)
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


def _require_surface(mesh: Mesh, source: str, *, against: int) -> None:
    edges, uses = edge_uses(mesh.faces)
    if (edges[:, 0] == edges[:, 1]).any():
        bad = int(np.flatnonzero((np.diff(np.sort(mesh.faces, axis=1), axis=1) == 0).any(axis=1))[0])
        raise InputError(f"expected three different corners in every face, face {bad} uses one twice", where=source)
    if (uses > 2).any():
        count = int((uses > 2).sum())
        raise InputError(
            f"expected at most two faces at an edge, found more at {count} of {len(uses)} edges", where=source
        )
    unused = len(mesh.vertices) - len(np.unique(mesh.faces))
    if unused:
        raise InputError(f"expected every vertex in a face, found {unused} in none", where=source)
    if not (uses == 1).any():
        raise InputError("expected a garment with open borders, found a closed surface", where=source)
    if against or _has_mixed_winding(mesh):
        raise InputError("expected faces wound alike, found neighbours wound against each other", where=source)


def _has_mixed_winding(mesh: Mesh) -> bool:
    directed = half_edges(mesh.faces)
    return len(np.unique(directed, axis=0)) < len(directed)


def _choose_uv(mesh: Mesh, found: UvReport, choice: UvChoice, source: str) -> tuple[np.ndarray | None, bool]:
    faults = found.faults()
    if choice == "none":
        return None, False
    if choice == "keep" and faults:
        raise InputError(f"expected UVs that can be kept, found {', '.join(faults)}", where=source)
    if choice == "fresh" or faults:
        return fresh_uv(mesh), True
    return mesh.uv, False


def _pattern(mesh: Mesh, source: str, *, own: bool, told: bool) -> tuple[float, PatternFit | None]:
    """Metres in a unit of the UVs, 0 where they are no sewing pattern, and how they compare with one.

    Args:
        own: the UVs are ours, or there are none; what was cut out of the mesh knows no more of lengths than the mesh.
        told: somebody says that they are the pattern.
    """
    if own:
        return 0.0, None
    if told:
        try:
            return as_pattern(mesh), None
        except InputError as error:
            raise error.at(source) from None
    fit = fit_pattern(mesh)
    return (0.0 if fit is None or fit.faults() else fit.metres), fit


def _loop_names(
    loops: list[np.ndarray], names: Sequence[str], weights: np.ndarray, rest: np.ndarray, body: Body, source: str
) -> tuple[str, ...]:
    if not names:
        return name_loops(loops, weights, rest, body)
    require_plain_names(names, "border")
    if len(names) != len(loops) or len(set(names)) != len(names):
        sizes = ", ".join(str(len(loop)) for loop in loops)
        raise InputError(f"expected {len(loops)} different names for loops of {sizes} vertices, "
                         f"found {len(names)}", where=source)  # fmt: skip
    return tuple(names)


def name_loops(
    loops: Sequence[Int32[np.ndarray, " _"]],
    weights: Float32[np.ndarray, "verts joints"],
    rest: Float64[np.ndarray, "verts 3"],
    body: Body,
) -> tuple[str, ...]:
    """neck, hem, cuff_left and cuff_right of a shirt; waist, leg_left and leg_right of trousers; waist, hem of a skirt.

    A loop goes around what moves it most. What is on the trunk is the hem at the bottom, the neck on top; of a garment
    with legs it is the waist, as is the top of one that ends nearer to the hips than to the neck. Several of one kind
    are counted.
    """
    kinds = []
    for loop in loops:
        share = weights[loop].mean(axis=0)
        parts = {part: _share(share, body, pattern) for part, pattern in (("arm", ARM), ("leg", LEG), ("neck", NECK))}
        parts["trunk"] = 1.0 - sum(parts.values())
        part = max(parts, key=lambda each: parts[each])
        x = float(rest[loop, 0].mean())
        around = abs(x) < 0.25 * float(np.ptp(rest[loop, 0]))
        kinds.append((part if part != "leg" or not around else "trunk", "left" if x > 0 else "right"))
    has_legs = any(part == "leg" for part, _ in kinds)
    trunk = [i for i, (part, _) in enumerate(kinds) if part == "trunk"]
    has_neck = any(part == "neck" for part, _ in kinds)
    highest = max(trunk, key=lambda i: rest[loops[i], 1].mean()) if len(trunk) > 1 and not has_neck else None
    names = []
    for index, (part, side) in enumerate(kinds):
        if part == "arm":
            names.append(f"cuff_{side}")
        elif part == "leg":
            names.append(f"leg_{side}")
        elif part == "neck" or index == highest:
            names.append("waist" if part != "neck" and _is_at_hips(rest[loops[index]], body) else "neck")
        else:
            names.append("waist" if has_legs else "hem")
    seen: Counter[str] = Counter()
    counted = []
    for name in names:
        seen[name] += 1
        counted.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return tuple(counted)


def _is_at_hips(loop: np.ndarray, body: Body) -> bool:
    """Whether a loop around the trunk, (N, 3) at rest, is nearer to the hips than to the neck."""
    hips, neck = (body.joints[_named(body, pattern), 1] for pattern in (LEG, NECK))
    return len(hips) > 0 and len(neck) > 0 and float(loop[:, 1].mean()) < float(hips.max() + neck.min()) / 2


def _share(weights: np.ndarray, body: Body, pattern: str) -> float:
    return float(weights[_named(body, pattern)].sum())


def _share_of(body: Body, pattern: str) -> np.ndarray:
    """Of each vertex of the body, (B,), what moves it that is named so."""
    return body.skin_weights[:, _named(body, pattern)].sum(axis=1)


def _named(body: Body, pattern: str) -> list[bool]:
    return [bool(re.search(pattern, name)) for name in body.joint_names]
