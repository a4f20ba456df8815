"""A part of the body's own surface as a garment: what a T-shirt or a pair of trousers covers.

The part is cut along planes across trunk, neck and limbs; faces that a plane crosses are split, so that the borders are
smooth. Joints are found by name, anny's or SMPL's.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import assert_never

import numpy as np
from jaxtyping import Bool, Float, Float64

from capture4d.body.skinning import ShapedBody
from capture4d.errors import InputError
from capture4d.geometry.mesh import connected_components, submesh
from capture4d.templates.config import Region
from capture4d.types import Mesh

__all__ = ["body_region"]

JOINTS: dict[str, tuple[str, ...]] = {
    "neck": (r"^neck01$", r"^neck$"),
    "head": (r"^head$",),
    "waist": (r"^spine04$", r"^spine1$"),
    "shoulder": (r"^upperarm01\.{side}$", r"^{word}_shoulder$"),
    "elbow": (r"^lowerarm01\.{side}$", r"^{word}_elbow$"),
    "wrist": (r"^wrist\.{side}$", r"^{word}_wrist$"),
    "hip": (r"^upperleg01\.{side}$", r"^{word}_hip$"),
    "knee": (r"^lowerleg01\.{side}$", r"^{word}_knee$"),
    "ankle": (r"^foot\.{side}$", r"^{word}_ankle$"),
}
SLEEVE = 0.6
"""Length of a short sleeve, as a share of the upper arm."""
LONG_SLEEVE = 0.92
"""Length of a long sleeve, as a share of the forearm."""
SHORTS, TROUSERS = 0.75, 0.88
"""Lengths of the legs, as shares of thigh and shin."""
HEM_DROP = 0.12
"""How far below the hip joints a shirt ends, as a share of the thigh."""


@dataclass(frozen=True, slots=True, eq=False)
class _Skeleton:
    shaped: ShapedBody

    def at(self, part: str, side: str = "") -> Float64[np.ndarray, "3"]:
        return self.shaped.joints[self.index(part, side)]

    def index(self, part: str, side: str = "") -> int:
        word = {"L": "left", "R": "right"}.get(side, "")
        names = self.shaped.body.joint_names
        for pattern in JOINTS[part]:
            wanted = re.compile(pattern.replace("{side}", side).replace("{word}", word))
            found = next((joint for joint, name in enumerate(names) if wanted.search(name)), None)
            if found is not None:
                return found
        raise InputError(
            f"body: expected joints named as the built-in body's or SMPL's, found no {part} {word}".strip()
        )

    def below(self, joint: int) -> Bool[np.ndarray, " verts"]:
        """Vertices that a joint and all that hangs from it move more than anything else."""
        parents = self.shaped.body.parents
        moved = np.zeros(len(parents), bool)
        moved[joint] = True
        for child in range(joint + 1, len(parents)):
            moved[child] |= parents[child] >= 0 and moved[parents[child]]
        return self.shaped.body.skin_weights[:, moved].sum(axis=1) > 0.5


def body_region(shaped: ShapedBody, region: Region) -> Mesh:
    """The part of a person's surface in the rest pose that a garment covers, with smooth open borders.

    Raises:
        InputError: the body's joints have names of which nothing is known.
    """
    skeleton = _Skeleton(shaped)
    match region:
        case "tshirt":
            inside = _shirt(skeleton, ("shoulder", "elbow"), SLEEVE)
        case "longsleeve":
            inside = _shirt(skeleton, ("elbow", "wrist"), LONG_SLEEVE)
        case "trousers":
            inside = _trousers(skeleton, ("knee", "ankle"), TROUSERS)
        case "shorts":
            inside = _trousers(skeleton, ("hip", "knee"), SHORTS)
        case _:
            assert_never(region)
    cut = _cut(Mesh(shaped.vertices.astype(np.float32), shaped.body.template.faces), inside)
    component = connected_components(cut.faces, len(cut.vertices))[cut.faces[:, 0]]
    return submesh(cut, component == np.argmax(np.bincount(component)))[0]


def _shirt(skeleton: _Skeleton, bone: tuple[str, str], share: float) -> Float64[np.ndarray, " verts"]:
    """Metres inside of the nearest border, negative outside."""
    vertices = skeleton.shaped.vertices
    neck, head = skeleton.at("neck"), skeleton.at("head")
    hip, knee = (skeleton.at(part, "L")[1] for part in ("hip", "knee"))
    hem = vertices[:, 1] - (hip - HEM_DROP * (hip - knee))
    collar = (neck - vertices) @ _unit(head - neck)
    inside = np.minimum(hem, collar)
    for side in "LR":
        arm = skeleton.below(skeleton.index("shoulder", side))
        inside[arm] = _short_of(vertices[arm], skeleton, bone, side, share)
    return inside


def _trousers(skeleton: _Skeleton, bone: tuple[str, str], share: float) -> Float64[np.ndarray, " verts"]:
    vertices = skeleton.shaped.vertices
    inside = skeleton.at("waist")[1] - vertices[:, 1]
    for side in "LR":
        arm = skeleton.below(skeleton.index("shoulder", side))
        inside[arm] = -np.abs(inside[arm]) - 1e-3
        leg = skeleton.below(skeleton.index("hip", side))
        inside[leg] = np.minimum(inside[leg], _short_of(vertices[leg], skeleton, bone, side, share))
    return inside


def _short_of(
    vertices: Float[np.ndarray, "part 3"], skeleton: _Skeleton, bone: tuple[str, str], side: str, share: float
) -> Float64[np.ndarray, " part"]:
    """Metres short of the plane across a bone, at a share of its length."""
    start, end = skeleton.at(bone[0], side), skeleton.at(bone[1], side)
    return (start + share * (end - start) - vertices) @ _unit(end - start)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _cut(mesh: Mesh, inside: Float64[np.ndarray, " verts"]) -> Mesh:
    """The part of a mesh where a function of its vertices, linear on every face, is positive."""
    inside = np.where(np.abs(inside) < 1e-6, 1e-6, inside)  # no border through a vertex: it would leave slivers
    added: dict[tuple[int, int], int] = {}
    places, faces = list(mesh.vertices), []

    def crossing(a: int, b: int) -> int:
        key = (min(a, b), max(a, b))
        if key not in added:
            share = inside[key[0]] / (inside[key[0]] - inside[key[1]])
            share = float(np.clip(share, 0.02, 0.98))
            places.append((1 - share) * mesh.vertices[key[0]] + share * mesh.vertices[key[1]])
            added[key] = len(places) - 1
        return added[key]

    for face in mesh.faces.tolist():
        kept = [inside[corner] > 0 for corner in face]
        polygon = []
        for corner, following, is_in, next_in in zip(face, face[1:] + face[:1], kept, kept[1:] + kept[:1], strict=True):
            if is_in:
                polygon.append(corner)
            if is_in != next_in:
                polygon.append(crossing(corner, following))
        faces += [[polygon[0], polygon[i], polygon[i + 1]] for i in range(1, len(polygon) - 1)]
    whole = Mesh(np.array(places, np.float32), np.array(faces, np.int32).reshape(-1, 3))
    return submesh(whole, np.ones(len(faces), bool))[0]
