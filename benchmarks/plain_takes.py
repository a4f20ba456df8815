"""Plain takes: a posed body in a stiff shirt, scanned. Seconds instead of the minutes a simulated cloth takes.

The shirt is the body's own trunk and upper arms, pushed outwards, with painted borders; it has no folds. That is enough
wherever a take's bookkeeping matters and its wrinkles do not: preflight checks, damage, demonstrations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import pose_frame, with_shape
from capture4d.geometry.mesh import boundary_loops, connected_components, submesh, vertex_normals
from capture4d.types import Body, Mesh, PoseSequence, Rig, Scan
from data_synth.config import MotionConfig
from data_synth.motions import make_motion
from data_synth.scanner.border_paint import paint_borders
from data_synth.scanner.config import FusionConfig, RigConfig, ScannerConfig
from data_synth.scanner.raycast import Surface
from data_synth.scanner.rig import bounding_sphere, scanner_rig
from data_synth.scanner.scan import LABEL_BODY, LABEL_GARMENT, scan_surfaces

__all__ = ["PlainTake", "PlainTakeConfig", "plain_take"]

Colour = tuple[int, int, int]

MOTION_FPS = 60.0
SHELL_PARTS = ("spine", "clavicle", "shoulder01", "upperarm01", "pelvis")
"""Joints whose surface the shirt covers."""
SHELL_CLEARANCE_M = 0.012
COARSE_SCANNER = ScannerConfig(
    rig=RigConfig(cameras=40, image_size=320),
    fusion=FusionConfig(garment_voxel_m=0.007, body_voxel_m=0.01, min_component_faces=60),
)


@dataclass(frozen=True, slots=True)
class PlainTakeConfig:
    """Who, what they do, and how it is scanned."""

    name: str = "plain"
    seed: int = 0
    body_shape: tuple[float, ...] = ()
    """Standard deviations: the first is height, the second girth."""
    motion: MotionConfig = field(default_factory=lambda: MotionConfig(clip="reach", skip_frames=20))
    frames: int = 12
    step: int = 4
    """Frames of motion (60 a second) per scanned frame."""
    number_step: int = 1
    """Difference of consecutive frame numbers; more than 1 is a take of which only every n-th frame was scanned."""
    heading_deg: float = 0.0
    """Where the subject faces at the start, turned about the vertical."""
    walk_m: tuple[float, float] = (0.0, 0.0)
    """Ground covered during the take along X and Z, metres."""
    turn_deg: float = 0.0
    """Turn about the vertical during the take."""
    whole_body: bool = False
    """A rig around the whole body instead of the upper body."""
    rig_follows_walk: bool = True
    """Off: the rig is set up for where the subject starts, whatever they do then."""
    garment_colour: Colour = (47, 98, 201)
    border_colour: Colour | None = (255, 196, 0)
    suit_colour: Colour = (150, 152, 156)
    skin_colour: Colour = (214, 168, 140)
    border_width_m: float = 0.03
    scanner: ScannerConfig = COARSE_SCANNER


@dataclass(frozen=True, slots=True, eq=False)
class PlainTake:
    """A take in memory."""

    name: str
    fps: float
    garment_colour: Colour
    boundary_colours: Mapping[str, Colour]
    scans: Mapping[int, Scan]
    """By frame number, metres."""
    poses: PoseSequence | None
    body: Body | None
    rig: Rig | None
    units: str = "m"
    """What capture.json says of the scans."""
    files: Mapping[str, bytes | None] = field(default_factory=dict)
    """Files to write over those of the take, by path in its folder; None removes one."""


def plain_take(config: PlainTakeConfig, body: Body) -> PlainTake:
    """Pose, dress and scan a body; the same configuration gives the same take.

    Raises:
        InputError: the motion is unknown or too short.
    """
    rng = np.random.default_rng([config.seed, 0])
    shaped = with_shape(body, np.array(config.body_shape, np.float32))
    simulated = (config.frames - 1) * config.step + 1
    poses = _travel(make_motion(shaped, config.motion, MOTION_FPS, simulated, rng), shaped.joints[0], config)
    kept = np.arange(0, simulated, config.step)
    frame_ids = (1 + np.arange(config.frames) * config.number_step).astype(np.int32)
    fps = MOTION_FPS / config.step * config.number_step
    poses = replace(
        poses,
        rotations=poses.rotations[kept],
        translations=poses.translations[kept],
        frame_ids=frame_ids,
        fps=fps,
    )
    bodies = [pose_frame(shaped, poses, index).vertices() for index in range(config.frames)]
    shell, kept_vertices = _shell(body, shaped.vertices)
    sheet = paint_borders(
        Mesh(shaped.vertices[kept_vertices].astype(np.float32), shell),
        width_m=config.border_width_m if config.border_colour else 0.0,
        garment_colour=config.garment_colour,
        border_colours=[config.border_colour] if config.border_colour else [],
        max_edge_m=config.scanner.fusion.garment_voxel_m,
    )
    shirts = [_shirt(vertices, body.template.faces, kept_vertices) for vertices in bodies]
    rig = _rig(config, bodies if config.whole_body else shirts)
    regions = np.zeros(len(body.template.vertices)) if body.regions is None else body.regions
    dress = np.where((regions > 0)[:, None], config.skin_colour, config.suit_colour).astype(np.uint8)
    fusion = config.scanner.fusion
    scans = {}
    for index, frame_id in enumerate(frame_ids.tolist()):
        surfaces = [
            Surface(sheet.posed(shirts[index]), sheet.colours, LABEL_GARMENT, fusion.garment_voxel_m, sheet.painted),
            Surface(
                Mesh(bodies[index].astype(np.float32), body.template.faces), dress, LABEL_BODY, fusion.body_voxel_m
            ),
        ]
        scans[frame_id], _ = scan_surfaces(
            rig,
            surfaces,
            config=config.scanner,
            rng=np.random.default_rng([config.seed, 1, frame_id]),
            frame_id=frame_id,
            time_s=(frame_id - 1) / fps,
        )
    names = [f"border_{index}" for index in range(len(sheet.loops))]
    paint = dict.fromkeys(names, config.border_colour) if config.border_colour else {}
    return PlainTake(config.name, fps, config.garment_colour, paint, scans, poses, body, rig)


def _travel(poses: PoseSequence, root: np.ndarray, config: PlainTakeConfig) -> PoseSequence:
    """Turn and walk the whole motion about the vertical through the root."""
    count = len(poses.frame_ids)
    share = np.linspace(0, 1, count)
    share = share * share * (3 - 2 * share)
    turn = np.radians(config.heading_deg + share * config.turn_deg)
    yaw = Rotation.from_rotvec(turn[:, None] * (0.0, 1.0, 0.0)).as_matrix()
    rotations = poses.rotations.astype(np.float64)
    rotations[:, 0] = yaw @ rotations[:, 0]
    translations = np.einsum("tab,tb->ta", yaw, poses.translations + root) - root
    translations[:, [0, 2]] += share[:, None] * np.array(config.walk_m)
    return replace(poses, rotations=rotations.astype(np.float32), translations=translations.astype(np.float32))


def _shell(body: Body, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces of the shirt on its own vertices, and those vertices in the body; the largest piece of what is covered."""
    names = np.array(body.joint_names)[np.argmax(body.skin_weights, axis=1)]
    covered = np.logical_or.reduce([np.char.startswith(names, part) for part in SHELL_PARTS])
    hip = body.joints[[index for index, name in enumerate(body.joint_names) if name.startswith("upperleg01")], 1].mean()
    covered &= rest[:, 1] > hip
    faces = body.template.faces
    inside = covered[faces].all(axis=1)
    part = connected_components(faces[inside], len(rest))
    largest = np.bincount(part[faces[inside][:, 0]]).argmax()
    mask = inside & (part[faces[:, 0]] == largest)
    piece, kept = submesh(Mesh(rest.astype(np.float32), faces), mask)
    assert boundary_loops(piece.faces), "a shirt has openings"
    return piece.faces, kept


def _shirt(vertices: np.ndarray, faces: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """The shirt's vertices on a posed body, (S, 3) float32."""
    return (vertices + SHELL_CLEARANCE_M * vertex_normals(vertices, faces))[kept].astype(np.float32)


def _rig(config: PlainTakeConfig, extent: list[np.ndarray]) -> Rig:
    centre, radius = bounding_sphere(np.array(extent if config.rig_follows_walk else extent[:1]))
    return scanner_rig(config.scanner, centre=centre, radius=max(radius, 0.58))
