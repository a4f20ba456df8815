"""The data types that pass between stages: plain frozen dataclasses over numpy arrays.

Metres, seconds, right-handed, Y up, +Z is where the subject faces in the rest pose, +X the subject's left. Arrays are
float32 and int32 here and on disk; solvers use float64 inside. Frames are named by the capture's own frame number.

Validation lives in `__post_init__` and nowhere else: what a type holds can be relied upon.
"""

from __future__ import annotations

import unicodedata
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from capture4d.errors import InputError
from capture4d.value_checks import (
    require_array,
    require_finite,
    require_frame_rate,
    require_frames,
    require_indices,
    require_loop,
    require_names,
    require_rotations,
    require_weights,
)

__all__ = [
    "BlendshapeModel",
    "Body",
    "Garment",
    "GarmentScan",
    "LensModel",
    "Mesh",
    "PoseSequence",
    "RegisteredSequence",
    "Rig",
    "Scan",
]


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """A triangle mesh, optionally with a UV per face corner."""

    vertices: Float32[np.ndarray, "verts 3"]
    """Positions, metres."""
    faces: Int32[np.ndarray, "faces 3"]
    """Vertex indices, counter-clockwise seen from outside."""
    uv: Float32[np.ndarray, "faces 3 2"] | None = None
    """Texture coordinates per face corner; garment patterns keep them in metres on the panel."""

    def __post_init__(self) -> None:
        require_array("Mesh", "vertices", self.vertices, (None, 3), np.float32)
        require_array("Mesh", "faces", self.faces, (None, 3), np.int32)
        require_finite("Mesh", "vertices", self.vertices)
        require_indices("Mesh", "faces", self.faces, len(self.vertices))
        if self.uv is not None:
            require_array("Mesh", "uv", self.uv, (len(self.faces), 3, 2), np.float32)
            require_finite("Mesh", "uv", self.uv)

    def with_vertices(self, vertices: Float32[np.ndarray, "verts 3"]) -> Mesh:
        """The same faces and UVs at other positions."""
        return Mesh(vertices, self.faces, self.uv)


LensModel = Literal["brown", "fisheye"]
"""OpenCV's pinhole camera with radial and tangential distortion, and its equidistant fisheye."""
ROTATION_TOLERANCE = 1e-4
"""How far rounding in a file may take a rotation from one."""


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Calibrated cameras. Camera axes are OpenCV's: x right, y down, z forward; pixel centres lie at integers."""

    names: tuple[str, ...]
    """Different from each other, and fit to be names of files and folders."""
    intrinsics: np.ndarray
    """(C, 3, 3) float64, pixels."""
    distortion: np.ndarray
    """(C, 5) float64, OpenCV order k1 k2 p1 p2 k3; of a fisheye k1 k2 k3 k4 and 0."""
    T_camera_world: np.ndarray
    """(C, 4, 4) float64: a world point, metres, in the camera's axes."""
    image_sizes: np.ndarray
    """(C, 2) int32: width, height."""
    lenses: tuple[LensModel, ...] = ()
    """Of each camera; all `brown` if left out."""

    def __post_init__(self) -> None:
        count = len(self.names)
        require_array("Rig", "intrinsics", self.intrinsics, (count, 3, 3), np.float64)
        require_array("Rig", "distortion", self.distortion, (count, 5), np.float64)
        require_array("Rig", "T_camera_world", self.T_camera_world, (count, 4, 4), np.float64)
        require_array("Rig", "image_sizes", self.image_sizes, (count, 2), np.int32)
        for name in ("intrinsics", "distortion", "T_camera_world"):
            require_finite("Rig", name, getattr(self, name))
        if not self.lenses:
            object.__setattr__(self, "lenses", ("brown",) * count)
        if len(self.lenses) != count:
            raise InputError(f"Rig.lenses: expected a lens for each of {count} cameras, found {len(self.lenses)}")
        twice = [name for name, times in Counter(self.names).items() if times > 1]
        for camera in range(count):
            self._require_camera(camera, twice[:1])

    def _require_camera(self, camera: int, twice: list[str]) -> None:
        """Raise unless its numbers can be those of a camera."""
        name, K, T = self.names[camera], self.intrinsics[camera], self.T_camera_world[camera]
        width, height = self.image_sizes[camera].tolist()
        lens, turn = self.lenses[camera], T[:3, :3]
        fault = None
        if name in ("", ".", "..") or any(c in "/\\" or unicodedata.category(c) in ("Cc", "Cs") for c in name):
            fault = "a name without separators and control characters", f"{name!r}"
        elif name in twice:
            fault = "a name of its own", "it twice"
        elif width <= 0 or height <= 0:
            fault = "the size of an image", f"{width} x {height}"
        elif not (K[0, 0] > 0 and K[1, 1] > 0):
            fault = "positive focal lengths in its intrinsics", f"{K[0, 0]:g} and {K[1, 1]:g}"
        elif K[2].tolist() != [0, 0, 1]:
            fault = "intrinsics with a last row of 0 0 1", " ".join(f"{value:g}" for value in K[2])
        elif lens not in get_args(LensModel):
            fault = f"a lens of {', '.join(get_args(LensModel))}", f"{lens!r}"
        elif lens == "fisheye" and self.distortion[camera, 4] != 0:
            fault = "four coefficients of a fisheye", f"a fifth of {self.distortion[camera, 4]:g}"
        elif np.abs(T[3] - (0, 0, 0, 1)).max() > ROTATION_TOLERANCE:
            fault = "a T_camera_world with a last row of 0 0 0 1", " ".join(f"{value:g}" for value in T[3])
        elif not np.abs(turn @ turn.T - np.eye(3)).max() < ROTATION_TOLERANCE:
            lengths = ", ".join(f"{length:g}" for length in np.linalg.norm(turn, axis=1))
            fault = "a rotation in T_camera_world", f"rows that are not orthonormal, of lengths {lengths}"
        elif np.linalg.det(turn) < 0:
            fault = "a rotation in T_camera_world", "a mirror image"
        if fault is not None:
            raise InputError(f"Rig: camera {ascii(name)[:80]}: expected {fault[0]}, found {fault[1][:120]}")

    @property
    def centres(self) -> np.ndarray:
        """(C, 3) float64: where the cameras stand, metres, world."""
        return -np.einsum("cji,cj->ci", self.T_camera_world[:, :3, :3], self.T_camera_world[:, :3, 3])


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One coloured frame of a 4D capture."""

    mesh: Mesh
    colours: UInt8[np.ndarray, "verts 3"]
    """sRGB per vertex."""
    frame_id: int
    time_s: float

    def __post_init__(self) -> None:
        require_array("Scan", "colours", self.colours, (len(self.mesh.vertices), 3), np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class GarmentScan:
    """The garment cut out of a scan: its surface, and the points on its painted borders."""

    mesh: Mesh
    boundary_points: Float32[np.ndarray, "points 3"]
    """Points on the true border of the garment, metres."""
    boundary_loops: Int32[np.ndarray, " points"]
    """Index into `loop_names` for each boundary point, or -1 where the paint does not tell the loops apart."""
    loop_names: tuple[str, ...]
    frame_id: int
    colours: UInt8[np.ndarray, "verts 3"] | None = None
    """sRGB per vertex, as scanned; None where nobody has kept them."""

    def __post_init__(self) -> None:
        if self.colours is not None:
            require_array("GarmentScan", "colours", self.colours, (len(self.mesh.vertices), 3), np.uint8)
        require_array("GarmentScan", "boundary_points", self.boundary_points, (None, 3), np.float32)
        require_array("GarmentScan", "boundary_loops", self.boundary_loops, (len(self.boundary_points),), np.int32)
        require_finite("GarmentScan", "boundary_points", self.boundary_points)
        require_names("GarmentScan", "loop_names", self.loop_names)
        require_indices(
            "GarmentScan", "boundary_loops", self.boundary_loops.astype(np.int64) + 1, len(self.loop_names) + 1
        )


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A skinned parametric body in its rest pose.

    `template + shape_directions @ shape` are the rest vertices, `joints + joint_directions @ shape` the rest joints.
    Functions in `capture4d.body.skinning` shape, pose and skin it.
    """

    template: Mesh
    shape_directions: Float32[np.ndarray, "shapes verts 3"]
    """Displacement for one standard deviation of each shape component, metres."""
    joints: Float32[np.ndarray, "joints 3"]
    """Rest joint positions of the mean shape, metres."""
    joint_directions: Float32[np.ndarray, "shapes joints 3"]
    joint_names: tuple[str, ...]
    parents: Int32[np.ndarray, " joints"]
    """Parent of each joint; -1 for the root, which is joint 0. Parents come before their children."""
    skin_weights: Float32[np.ndarray, "verts joints"]
    pose_directions: Float32[np.ndarray, "features verts 3"] | None = None
    """SMPL-family pose correctives on the flattened (R - I) of all joints but the root; None where there are none."""
    regions: UInt8[np.ndarray, " verts"] | None = None
    """0 body, 1 head, 2 hand, 3 foot: what a suit leaves bare."""

    def __post_init__(self) -> None:
        verts, joints = len(self.template.vertices), len(self.joint_names)
        require_array("Body", "shape_directions", self.shape_directions, (None, verts, 3), np.float32)
        require_array("Body", "joints", self.joints, (joints, 3), np.float32)
        shapes = len(self.shape_directions)
        require_array("Body", "joint_directions", self.joint_directions, (shapes, joints, 3), np.float32)
        require_array("Body", "parents", self.parents, (joints,), np.int32)
        require_array("Body", "skin_weights", self.skin_weights, (verts, joints), np.float32)
        for name in ("shape_directions", "joints", "joint_directions"):
            require_finite("Body", name, getattr(self, name))
        require_names("Body", "joint_names", self.joint_names)
        if not joints:
            raise InputError("Body.joint_names: expected at least one joint, found none")
        if self.pose_directions is not None:
            features = 9 * (joints - 1)
            require_array("Body", "pose_directions", self.pose_directions, (features, verts, 3), np.float32)
            require_finite("Body", "pose_directions", self.pose_directions)
        if self.regions is not None:
            require_array("Body", "regions", self.regions, (verts,), np.uint8)
            require_indices("Body", "regions", self.regions, 4)
        if self.parents[0] != -1 or (self.parents[1:] >= np.arange(1, joints)).any() or (self.parents[1:] < 0).any():
            raise InputError("Body.parents: expected joint 0 as the root and every parent before its children")
        require_weights("Body", "skin_weights", self.skin_weights)


@dataclass(frozen=True, slots=True, eq=False)
class PoseSequence:
    """Joint rotations over time, for one body shape.

    Rotations are relative to the rest pose and about world-aligned axes, as SMPL's are: identity everywhere is the
    rest pose.
    """

    rotations: Float32[np.ndarray, "frames joints 3 3"]
    translations: Float32[np.ndarray, "frames 3"]
    """Displacement of the root joint from its rest position, metres."""
    shape: Float32[np.ndarray, " shapes"]
    frame_ids: Int32[np.ndarray, " frames"]
    fps: float
    joint_names: tuple[str, ...]

    def __post_init__(self) -> None:
        frames, joints = len(self.frame_ids), len(self.joint_names)
        require_array("PoseSequence", "rotations", self.rotations, (frames, joints, 3, 3), np.float32)
        require_array("PoseSequence", "translations", self.translations, (frames, 3), np.float32)
        require_array("PoseSequence", "shape", self.shape, (None,), np.float32)
        require_array("PoseSequence", "frame_ids", self.frame_ids, (frames,), np.int32)
        require_finite("PoseSequence", "rotations", self.rotations)
        require_finite("PoseSequence", "translations", self.translations)
        require_finite("PoseSequence", "shape", self.shape)
        require_rotations("PoseSequence", "rotations", self.rotations)
        require_names("PoseSequence", "joint_names", self.joint_names)
        require_frame_rate("PoseSequence.fps", self.fps)
        require_frames("PoseSequence", self.frame_ids)

    def row(self, frame_id: int) -> int:
        """Where a frame's pose is.

        Raises:
            InputError: the motion has no such frame.
        """
        rows = np.flatnonzero(self.frame_ids == frame_id)
        if not len(rows):
            span = f"frames {self.frame_ids[0]} to {self.frame_ids[-1]}" if len(self.frame_ids) else "no frames"
            raise InputError(f"expected a pose for frame {frame_id}, found {span}")
        return int(rows[0])

    def of_frames(self, frame_ids: Int32[np.ndarray, " wanted"]) -> PoseSequence:
        """The poses of these frames, in this order.

        Raises:
            InputError: a frame has none.
        """
        at = {int(frame_id): row for row, frame_id in enumerate(self.frame_ids)}
        missing = [int(frame_id) for frame_id in frame_ids if int(frame_id) not in at]
        if missing:
            raise InputError(f"poses: expected one for every registered frame, found none for frame {missing[0]}")
        rows = [at[int(frame_id)] for frame_id in frame_ids]
        return replace(self, rotations=self.rotations[rows], translations=self.translations[rows], frame_ids=frame_ids)


@dataclass(frozen=True, slots=True, eq=False)
class Garment:
    """A garment template, bound to a body.

    The template lies in the body's rest pose. `embedding_faces` and `embedding_barycentric` name the body surface
    point each vertex belongs to; `skin_weights` move it with the skeleton.
    """

    template: Mesh
    loops: Mapping[str, Int32[np.ndarray, " loop"]] = field(default_factory=dict)
    """Named boundary loops: vertex indices in order along the open edge, the first not repeated at the end."""
    embedding_faces: Int32[np.ndarray, " verts"] | None = None
    embedding_barycentric: Float32[np.ndarray, "verts 3"] | None = None
    skin_weights: Float32[np.ndarray, "verts joints"] | None = None
    """None for a garment (or any other template) without a body."""
    body_shape: Float32[np.ndarray, " shapes"] | None = None
    """Shape of the person in whose rest pose the template lies; None if nobody knows."""
    pattern_metres: float | None = None
    """Metres in a unit of the UVs if these are the sewing pattern; 0 if they are not; None if nobody has said."""

    def __post_init__(self) -> None:
        verts = len(self.template.vertices)
        if self.pattern_metres is not None and not 0 <= self.pattern_metres < float("inf"):
            raise InputError(f"Garment.pattern_metres: expected metres, or 0, found {self.pattern_metres}")
        for name, loop in self.loops.items():
            require_array("Garment", f"loops[{name!r}]", loop, (None,), np.int32)
            require_indices("Garment", f"loops[{name!r}]", loop, verts)
            require_loop(name, loop)
        if (self.embedding_faces is None) != (self.embedding_barycentric is None):
            raise InputError("Garment.embedding_faces, embedding_barycentric: expected both or neither, found one")
        if self.embedding_faces is not None and self.embedding_barycentric is not None:
            require_array("Garment", "embedding_faces", self.embedding_faces, (verts,), np.int32)
            require_indices("Garment", "embedding_faces", self.embedding_faces, 2**31)
            require_array("Garment", "embedding_barycentric", self.embedding_barycentric, (verts, 3), np.float32)
            require_weights("Garment", "embedding_barycentric", self.embedding_barycentric)
        if self.body_shape is not None:
            require_array("Garment", "body_shape", self.body_shape, (None,), np.float32)
            require_finite("Garment", "body_shape", self.body_shape)
        if self.skin_weights is not None:
            require_array("Garment", "skin_weights", self.skin_weights, (verts, None), np.float32)
            require_weights("Garment", "skin_weights", self.skin_weights)


@dataclass(frozen=True, slots=True, eq=False)
class RegisteredSequence:
    """One template on every frame of a take: the same vertex is the same piece of cloth."""

    garment: Garment
    vertices: Float32[np.ndarray, "frames verts 3"]
    residual_m: Float32[np.ndarray, "frames verts"]
    """Distance to the scan surface; NaN where the scan has no data near the vertex."""
    frame_ids: Int32[np.ndarray, " frames"]

    def __post_init__(self) -> None:
        frames, verts = len(self.frame_ids), len(self.garment.template.vertices)
        require_array("RegisteredSequence", "vertices", self.vertices, (frames, verts, 3), np.float32)
        require_array("RegisteredSequence", "residual_m", self.residual_m, (frames, verts), np.float32)
        require_array("RegisteredSequence", "frame_ids", self.frame_ids, (frames,), np.int32)
        require_finite("RegisteredSequence", "vertices", self.vertices)
        require_frames("RegisteredSequence", self.frame_ids)


@dataclass(frozen=True, slots=True, eq=False)
class BlendshapeModel:
    """A garment learned from registered frames: a mean and its principal directions, in the unposed space.

    A frame is `mean + coefficients @ basis`, skinned with `garment.skin_weights` (DeepWrinkles, Eq. 3, whose sum runs
    over l = 1..k).
    """

    garment: Garment
    """Template, borders and skin weights; its `body_shape` is that of the person who was captured."""
    mean: Float32[np.ndarray, "verts 3"]
    """Metres, on the captured person in the rest pose."""
    basis: Float32[np.ndarray, "shapes verts 3"]
    """Orthonormal directions, the strongest first."""
    std: Float32[np.ndarray, " shapes"]
    """Standard deviation of each coefficient over the training frames, metres."""
    joint_names: tuple[str, ...]
    """Of the skeleton that moves the garment, in the order of the skin weights' columns."""
    fps: float
    """Frame rate of the takes it was learned from."""
    licence: str = ""
    """Who may do what with it; goes wherever the file goes."""

    def __post_init__(self) -> None:
        verts, shapes = len(self.garment.template.vertices), len(self.std)
        require_array("BlendshapeModel", "mean", self.mean, (verts, 3), np.float32)
        require_array("BlendshapeModel", "basis", self.basis, (shapes, verts, 3), np.float32)
        require_array("BlendshapeModel", "std", self.std, (shapes,), np.float32)
        for name in ("mean", "basis", "std"):
            require_finite("BlendshapeModel", name, getattr(self, name))
        if self.std.min(initial=0) < 0:
            raise InputError(f"BlendshapeModel.std: expected no negative deviation, found {self.std.min():.4g}")
        require_names("BlendshapeModel", "joint_names", self.joint_names)
        weights = self.garment.skin_weights
        if weights is None or weights.shape[1] != len(self.joint_names):
            found = "none" if weights is None else f"weights for {weights.shape[1]}"
            raise InputError(
                f"BlendshapeModel: expected skin weights for {len(self.joint_names)} joints, found {found}"
            )
        require_frame_rate("BlendshapeModel.fps", self.fps)
