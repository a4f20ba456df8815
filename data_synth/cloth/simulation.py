"""Coarse cloth on a moving body: newton's vertex block descent on the triangulated pattern.

The rest shape is the flat pattern, so seams, ease and grain are real. It is shrunk a little against the true cloth: the
coarse sheet is the low-frequency surrogate of a garment that has more material than the sheet can buckle, and the
excess becomes fine folds in `data_synth.cloth.wrinkle_relaxation`.

Frames: world, Y up, metres. The sequence is dressing pose -> first pose -> rest a little -> the clip.
References: Chen et al., Vertex Block Descent (SIGGRAPH 2024); the shrunk pattern is ours.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation, Slerp

from capture4d.body.skinning import PosedBody, ShapedBody, with_pose
from capture4d.geometry.mesh import unique_edges
from capture4d.geometry.ray_casting import TriangleScene
from capture4d.geometry.triangles import count_intersecting_faces
from capture4d.heavy_imports import import_warp
from capture4d.types import PoseSequence
from data_synth.cloth.fabrics import Fabric
from data_synth.cloth.holding import Hold, Walls
from data_synth.cloth.panels import Pattern
from data_synth.cloth.patterns import PanelMesh
from data_synth.cloth.stencils import rest_lengths
from data_synth.cloth.tailoring import Made, bending_factors, shrunk
from data_synth.cloth.untangling import Room, untangle
from data_synth.config import SimulationConfig

__all__ = ["approach_poses", "clear_of_body", "dress", "dressing_rotations", "simulate"]

DRESSING_ARM_RAISE_DEG = 42.0
"""Raises the arms of the rest pose to about the horizontal, so that a flat T fits over them."""

LIFT_M = 0.035
"""The panels start this far above their place, clear of the shoulders."""
BODY_MARGIN_M = 0.002
"""Room that the sheet keeps to the body."""
UNTANGLE_M = 0.003
"""Farthest that a vertex moves in one frame to part from cloth that it has passed through."""
PILLOW_M = 0.13
"""Distance from the seams over which front and back part."""


def dressing_rotations(shaped: ShapedBody) -> np.ndarray:
    """Joint rotations, (J, 3, 3), with the arms held out sideways."""
    names = shaped.body.joint_names
    rotations = np.repeat(np.eye(3)[None], len(names), axis=0)
    for side, sign in (("L", 1), ("R", -1)):
        raised = Rotation.from_euler("z", sign * DRESSING_ARM_RAISE_DEG, degrees=True)
        rotations[names.index(f"upperarm01.{side}")] = raised.as_matrix()
    return rotations


def approach_poses(
    shaped: ShapedBody, poses: PoseSequence, config: SimulationConfig, rotations: np.ndarray | None = None
) -> list[PosedBody]:
    """The way into a clip: calm frames in the dressing pose, a motion to its first pose, and a rest there.

    Args:
        rotations: joints of the dressing pose, (J, 3, 3), as for `dress`.
    """
    start = dressing_rotations(shaped) if rotations is None else rotations.copy()
    end = poses.rotations[0].astype(np.float64)
    start[0] = end[0]
    ramp = np.linspace(0, 1, config.approach_frames)
    ramp = ramp * ramp * (3 - 2 * ramp)
    paths = [
        Slerp([0, 1], Rotation.from_matrix(np.stack([start[joint], end[joint]])))(ramp).as_matrix()
        for joint in range(len(start))
    ]
    moving = [with_pose(shaped, rotations, poses.translations[0]) for rotations in np.stack(paths, axis=1)]
    return [moving[0]] * config.calm_frames + moving + [moving[-1]] * config.rest_frames


def dress(
    shaped: ShapedBody,
    mesh: PanelMesh,
    pattern: Pattern,
    first: PosedBody,
    rotations: np.ndarray | None = None,
) -> np.ndarray:
    """Hang the panels around the body in the dressing pose.

    Front and back stand off the trunk as pillows that meet at the side seams; sleeves are tubes around the arms. The
    surface is outside the body everywhere, not yet at its rest lengths.

    Args:
        first: the first of `approach_poses`; only the place of its root matters.
        rotations: joints of the dressing pose, (J, 3, 3), the arms held out; those of `dressing_rotations` if None.
    Returns:
        Vertex positions (V, 3), metres.
    """
    rotations = dressing_rotations(shaped) if rotations is None else rotations
    surface = with_pose(shaped, rotations, np.zeros(3)).vertices()
    body = _Surface(TriangleScene((surface, shaped.body.template.faces)))
    names = shaped.body.joint_names
    shoulder = shaped.joints[names.index("upperarm01.L")]
    trunk = surface[(np.abs(surface[:, 0]) < 0.12) & (np.abs(surface[:, 1] - shoulder[1] + 0.15) < 0.25)]
    middle_z, depth = np.mean([trunk[:, 2].min(), trunk[:, 2].max()]), np.ptp(trunk[:, 2]) / 2 + 0.04
    names_of_panels, origins = zip(*((panel.name, panel.origin) for panel in pattern.panels), strict=True)
    panel = np.array(names_of_panels)[mesh.face_panels[mesh.vertex_faces]]
    draft = mesh.vertex_uv - np.array(origins)[mesh.face_panels[mesh.vertex_faces]]
    placed = np.zeros((mesh.vertex_count, 3))
    for name, sign in (("front", 1.0), ("back", -1.0)):
        rows = panel == name
        placed[rows, 0], placed[rows, 1] = sign * draft[rows, 0], draft[rows, 1] + LIFT_M
    seam_rows = np.unique(np.concatenate(list(mesh.seams.values())))
    seams = KDTree(placed[seam_rows[np.char.find(panel[seam_rows], "sleeve") < 0], :2])
    for name, sign in (("front", 1.0), ("back", -1.0)):
        rows = panel == name
        near = np.minimum(seams.query(placed[rows, :2])[0] / PILLOW_M, 1)
        placed[rows, 2] = middle_z + sign * depth * np.sqrt(1 - (1 - near) ** 2)
        # Out of the arms on the panel's own side: sewn to the other side, cloth would have to pass through them.
        placed[rows] = _push_outside_along(placed[rows], sign, body, clearance=0.008)
    half = np.abs(draft[panel == "front", 0]).max()
    for side, sign in (("left", 1.0), ("right", -1.0)):
        rows = panel == f"sleeve_{side}"
        arm = surface[(sign * surface[:, 0] > half) & (sign * surface[:, 0] < half + 0.12)]
        placed[rows] = _tube(draft[rows], arm, sign, half)
    placed = clear_of_body(placed, mesh, body.scene)
    root = first.transforms[0]
    return placed @ root[:3, :3].T + root[:3, 3]


def clear_of_body(points: np.ndarray, mesh: PanelMesh, body: TriangleScene) -> np.ndarray:
    """Panels hung around a body, (V, 3), moved to where no vertex and no edge of them is in it."""
    surface = _Surface(body)
    points = _push_outside(points, surface, clearance=0.008)
    points = _push_edges_outside(points, unique_edges(mesh.faces), surface)
    # Where panels coincide triangles have no area, and newton would leave them out.
    return points + np.random.default_rng(0).normal(scale=2e-4, size=points.shape)


def _tube(draft: np.ndarray, arm: np.ndarray, sign: float, start_x: float) -> np.ndarray:
    """Wrap a sleeve, top of the cap upwards, around an arm that points along sign * X."""
    u, v = draft.T
    middle = (arm[:, 1:].min(axis=0) + arm[:, 1:].max(axis=0)) / 2
    bins = np.linspace(v.min(), v.max() + 1e-9, 24)
    row = np.digitize(v, bins)
    width = np.array([np.abs(u[row == r]).max(initial=0) for r in range(len(bins) + 1)])
    widest = width.max()
    angle = np.pi * u / np.where(v > 0, widest, np.maximum(width[row], 0.5 * widest))
    radius = max(widest / np.pi, np.ptp(arm[:, 1:], axis=0).max() / 2 + 0.015)
    around = np.stack([np.cos(angle), -sign * np.sin(angle)], axis=1) * radius
    return np.column_stack([sign * (start_x - v), middle + around])


@dataclass(frozen=True, slots=True, eq=False)
class _Surface:
    """A body that is looked up many times."""

    scene: TriangleScene

    def heights(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Height over the nearest face, (V,) metres, negative inside; that face's nearest point and normal, (V, 3)."""
        found = self.scene.nearest(points)
        heights = np.einsum("vc,vc->v", points.astype(np.float32) - found.points, found.normals)
        return heights, found.points, found.normals


def _push_outside(points: np.ndarray, surface: _Surface, clearance: float) -> np.ndarray:
    """Move every point nearer than `clearance`, or inside, to that distance outside the surface."""
    heights, foot, normals = surface.heights(points)
    return np.where((heights < clearance)[:, None], foot + clearance * normals, points)


def _push_outside_along(points: np.ndarray, sign: float, surface: _Surface, clearance: float) -> np.ndarray:
    """Move every point nearer than `clearance`, or inside, along sign * Z until it is outside."""
    points = points.copy()
    for _ in range(200):
        near = surface.heights(points)[0] < clearance
        if not near.any():
            break
        points[near, 2] += sign * 0.5 * clearance
    return points


def _push_edges_outside(points: np.ndarray, edges: np.ndarray, surface: _Surface) -> np.ndarray:
    """Move the ends, (V, 3), of edges, (E, 2), that cut into the surface, until none does or 60 steps are made."""
    shares = np.array([0.25, 0.5, 0.75])[:, None]
    points, low = points.copy(), np.arange(len(edges))
    for _ in range(60):
        start, end = points[edges[low]].transpose(1, 0, 2)
        samples = start[:, None] * (1 - shares) + end[:, None] * shares
        heights, _, normals = surface.heights(samples.reshape(-1, 3))
        heights, normals = heights.reshape(-1, 3), normals.reshape(-1, 3, 3)
        rows, deepest = np.arange(len(low)), np.argmin(heights, axis=1)
        inside = heights[rows, deepest] < 0
        if not inside.any():
            break
        rows, deepest = rows[inside], deepest[inside]
        step = (0.002 - heights[rows, deepest])[:, None] * normals[rows, deepest]
        push = np.zeros((len(points), 4))
        np.add.at(push, edges[low[rows]], np.column_stack([step, np.ones(len(rows))])[:, None])
        points += push[:, :3] / np.maximum(push[:, 3:], 1)
        low = np.flatnonzero((push[edges, 3] > 0).any(axis=1))
    return points


def simulate(
    mesh: PanelMesh,
    start: np.ndarray,
    bodies: Sequence[PosedBody],
    fabric: Fabric,
    config: SimulationConfig,
    *,
    made: Made | None = None,
    held_from: float | None = None,
) -> Iterator[np.ndarray]:
    """Move the cloth through a sequence of body poses, `1 / config.fps` apart.

    In the first `config.calm_frames` gravity is halved and motion damped, while the panels close on the body.

    Args:
        start: (V, 3) cloth in the first frame, metres.
        made: how the garment was made; of one layer, without a share of its cloth that is the same everywhere, if None.
        held_from: height in the rest pose below which the cloth is held less, metres; that of the shoulders if None.
    Yields:
        Cloth vertices (V, 3) float64 for each frame, the first included.
    """
    import_warp()
    import newton

    model, body = _build_model(mesh, start, bodies, fabric, made)
    solver = newton.solvers.SolverVBD(model, iterations=config.iterations)
    pipeline = newton.CollisionPipeline(model, soft_contact_gap=config.contact_gap_m)
    contacts, control = pipeline.contacts(), model.control()
    state, scratch = model.state(), model.state()
    step = 1 / config.fps / config.substeps
    gravity = np.array([0.0, -9.81, 0.0], np.float32)
    hold: Hold | None = None
    yield start
    current = bodies[0].vertices()
    for frame in range(1, len(bodies)):
        previous, current = current, bodies[frame].vertices()
        if frame == config.calm_frames and config.hold_hz > 0:
            cloth = state.particle_q.numpy().astype(np.float64)
            masses = model.particle_mass.numpy()
            hold = Hold.take(mesh, cloth, bodies[frame - 1], masses, config, made=made, held_from=held_from)
        held = None if hold is None else (hold.places(bodies[frame - 1]), hold.places(bodies[frame]))
        slides = None if hold is None else hold.slides(bodies[frame])
        calm = frame <= config.calm_frames
        between = Walls.of(made, bodies[frame], model.particle_mass.numpy())
        model.set_gravity(tuple(gravity * (0.5 if calm else 1.0)))
        for substep in range(config.substeps):
            blend = (substep + 1) / config.substeps
            body.mesh.points.assign(((1 - blend) * previous + blend * current).astype(np.float32))
            body.mesh.refit()
            if body.mesh.velocities is not None:
                body.mesh.velocities.assign(((current - previous) * config.fps).astype(np.float32))
            state.clear_forces()
            if hold is not None and held is not None and slides is not None:
                points = state.particle_q.numpy()
                forces = hold.forces((1 - blend) * held[0] + blend * held[1], slides, points)
                if between is not None:
                    between.push(points, forces)
                state.particle_f.assign(forces.astype(np.float32))
            if substep % config.contact_substeps == 0:
                pipeline.collide(state, contacts)
            solver.step(state, scratch, control, contacts, step)
            state, scratch = scratch, state
            keep = config.calm_damping if calm else config.damping
            state.particle_qd.assign(state.particle_qd.numpy() * np.float32(keep))
        if made is not None and not calm:
            parted = _untangled(mesh, made, state.particle_q.numpy(), current, bodies[0].shaped.body.template.faces)
            state.particle_q.assign(parted)
        yield state.particle_q.numpy().astype(np.float64)


def _untangled(
    mesh: PanelMesh, made: Made, points: np.ndarray, surface: np.ndarray, body_faces: np.ndarray
) -> np.ndarray:
    """The sheet, (V, 3) float32, where faces of it that cut each other have been drawn apart, outside of the body."""
    if not made.folds.sheet_steps or not count_intersecting_faces(points.astype(np.float64), mesh.faces):
        return points
    edges, lengths = rest_lengths(shrunk(mesh, made.tailoring.scale))
    _, foot, normals = _Surface(TriangleScene((surface, body_faces))).heights(points)
    room = Room(points, UNTANGLE_M, foot.astype(np.float32), normals.astype(np.float32), BODY_MARGIN_M)
    return untangle(
        points, mesh.faces, edges.astype(np.int32), lengths.astype(np.float32), room, steps=made.folds.sheet_steps
    )


def _build_model(
    mesh: PanelMesh, start: np.ndarray, bodies: Sequence[PosedBody], fabric: Fabric, made: Made | None
) -> tuple[Any, Any]:
    """newton's model of cloth and collider, and the collider whose points each substep moves."""
    import newton

    wp = import_warp()
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
    builder.add_cloth_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=wp.quat(0.0, 0.0, 0.0, 1.0),
        scale=1.0,
        vel=wp.vec3(0.0, 0.0, 0.0),
        vertices=[wp.vec3(*point) for point in start],
        indices=mesh.faces.ravel().tolist(),
        density=fabric.density,
        tri_ke=fabric.stretch_stiffness,
        tri_ka=fabric.stretch_stiffness * (1 if made is None else made.folds.sideways),
        tri_kd=1e-3,
        edge_ke=fabric.coarse_bending,
        edge_kd=1e-3,
        particle_radius=0.003,
    )
    a, b, c = (mesh.uv * (fabric.shrink if made is None else made.tailoring.scale)).transpose(1, 0, 2)
    length = np.linalg.norm(b - a, axis=1)
    along = (b - a) / length[:, None]
    side = c - a
    x = np.einsum("fc,fc->f", side, along)
    y = along[:, 0] * side[:, 1] - along[:, 1] * side[:, 0]
    areas = 0.5 * length * y
    builder.tri_poses = [
        wp.mat22(*np.linalg.inv([[base, p], [0.0, q]]).ravel()) for base, p, q in zip(length, x, y, strict=True)
    ]
    builder.tri_areas = areas.tolist()
    builder.edge_rest_angle = [0.0] * len(builder.edge_rest_angle)
    mass = np.bincount(mesh.faces.ravel(), np.repeat(areas * fabric.density / 3, 3), minlength=mesh.vertex_count)
    if made is not None:
        mass *= np.where(made.tailoring.strip, made.folds.strip_mass, 1)
        factors = bending_factors(mesh, made, fabric, np.array(builder.edge_indices)[:, 2:])
        builder.edge_bending_properties = [
            (stiffness * factor, damping)
            for factor, (stiffness, damping) in zip(factors.tolist(), builder.edge_bending_properties, strict=True)
        ]
    builder.particle_mass = mass.tolist()
    faces = bodies[0].shaped.body.template.faces
    body = newton.Mesh(bodies[0].vertices().astype(np.float32), faces.ravel(), compute_inertia=False)
    builder.add_shape_mesh(body=-1, mesh=body, cfg=newton.ModelBuilder.ShapeConfig(margin=BODY_MARGIN_M))
    builder.color(include_bending=True)
    model = builder.finalize(device="cpu")
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = 1e4, 1e-3, fabric.friction
    # newton computes the box of a collider once: make it hold the whole motion.
    joints = np.concatenate([each.joint_centres() for each in bodies])
    lower, upper = model.shape_collision_aabb_lower, model.shape_collision_aabb_upper
    assert lower is not None
    assert upper is not None
    lower.assign((joints.min(axis=0) - 2.0).astype(np.float32)[None])
    upper.assign((joints.max(axis=0) + 2.0).astype(np.float32)[None])
    return model, body
