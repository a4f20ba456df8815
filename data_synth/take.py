"""A synthetic take before it is written: its person, motion and meshes, its simulated cloth, and what the rig sees."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, UInt8
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from capture4d.body.anny import load_anny
from capture4d.body.skinning import PosedBody, ShapedBody, pose_frame, with_shape
from capture4d.motions.retargeting import pose_sequence
from capture4d.types import Mesh, PoseSequence, Rig
from data_synth.cloth.fabrics import FABRICS
from data_synth.cloth.panels import Pattern
from data_synth.cloth.patterns import PanelMesh, grade, mesh_pattern
from data_synth.cloth.simulation import approach_poses, simulate
from data_synth.cloth.tailoring import Made, tailor
from data_synth.cloth.wrinkle_relaxation import Finish, Level, WrinkleMesh, relax_levels, wrinkle_mesh
from data_synth.config import SynthConfig
from data_synth.motions import make_motion
from data_synth.outfits import OUTFITS, Outfit
from data_synth.prints import printed_cloth
from data_synth.scanner.raycast import Print
from data_synth.scanner.rig import bounding_sphere, scanner_rig
from data_synth.scanner.scan import LABEL_BODY, LABEL_GARMENT, Surface
from data_synth.worn import draft, dressing_pose, is_held_at_waist, put_on

__all__ = [
    "Paint",
    "TakePlan",
    "dress_colours",
    "in_view",
    "measured_poses",
    "painted_band",
    "plan_take",
    "simulate_take",
    "take_rig",
    "take_surfaces",
]

WHITE = (255, 255, 255)
WIDE_STREAM = 400
"""Of a take's seed: the mesh of its wide folds."""
PRINT_STREAM = 300
"""Added to the seed of a take for that of its print."""
BORDER_BAND_M = 0.009
"""Width of the painted border."""
WIDE_BAND_M = 0.015
"""The same of trousers and skirts: the rig stands farther away, and loses more of what is at an edge."""
RIG_RADIUS_M = 0.58
"""Smallest sphere the rig is set up for: the upper body with room for the garment."""


IN_VIEW_STRIDE = 16
"""Every so many vertices of the body tell how large it is."""


@dataclass(frozen=True, slots=True, eq=False)
class Paint:
    """Colours of garment and body, the same in every frame of a take."""

    garment: UInt8[np.ndarray, "verts 3"]
    """sRGB per vertex of the fine cloth."""
    is_border: Bool[np.ndarray, " verts"]
    """Where the fine cloth is painted."""
    body: UInt8[np.ndarray, "body_verts 3"]
    print: Print | None = None
    """On the fine cloth, which is white below it."""


@dataclass(frozen=True, slots=True, eq=False)
class TakePlan:
    """All that is known of a take before anything is simulated."""

    config: SynthConfig
    shaped: ShapedBody
    poses: PoseSequence
    """The captured frames."""
    bodies: list[PosedBody]
    """Every simulated frame: the approach, then the clip."""
    pattern: Pattern
    coarse: PanelMesh
    fine: PanelMesh
    template: PanelMesh
    wrinkles: WrinkleMesh
    paint: Paint
    levels: tuple[Level, ...]
    """How the simulated sheet is folded; the last is that of `wrinkles`."""
    made: Made | None
    """The making of the coarse mesh; None where `config.folds` is."""

    @property
    def lead(self) -> int:
        """Simulated frames before the clip."""
        simulation = self.config.simulation
        return simulation.calm_frames + simulation.approach_frames + simulation.rest_frames


def plan_take(config: SynthConfig) -> TakePlan:
    """Body, motion and meshes of a configuration. Each random part has its own stream of the one seed."""
    streams = {
        name: np.random.default_rng([config.seed, number])
        for number, name in enumerate(("motion", "coarse", "fine", "template", "imperfection"))
    }
    if config.motion.seed:
        streams["motion"] = np.random.default_rng([config.seed, 0, config.motion.seed])
    shaped = _person(config.body_shape)
    simulated = (config.frames - 1) * config.capture_every + 1
    drafted = shaped if config.drafted_for is None else _person(config.drafted_for)
    motion = make_motion(drafted, config.motion, config.simulation.fps, simulated, streams["motion"])
    if config.drafted_for is not None:  # who wears the graded garment moves as who wore the first
        motion = pose_sequence(
            shaped, motion.rotations.astype(np.float64), motion.fps, motion.translations.astype(np.float64)
        )
    kept = slice(None, None, config.capture_every)
    poses = PoseSequence(
        motion.rotations[kept],
        motion.translations[kept],
        motion.shape,
        np.arange(1, config.frames + 1, dtype=np.int32),
        config.simulation.fps / config.capture_every,
        motion.joint_names,
    )
    clip = [pose_frame(shaped, motion, index) for index in range(simulated)]
    pattern = draft(config, shaped)
    counts = {
        "coarse": config.simulation.vertices,
        "fine": config.relaxation.vertices,
        "template": config.template_vertices,
    }
    if config.folds is not None:
        counts["wide"] = config.folds.wide.vertices
        streams["wide"] = np.random.default_rng([config.seed, WIDE_STREAM])
    first = draft(config, drafted)
    meshes = {name: mesh_pattern(first, count, streams[name]) for name, count in counts.items()}
    if config.drafted_for is not None:
        meshes = {name: grade(mesh, first, pattern) for name, mesh in meshes.items()}
    made, levels = _folded(config, pattern, meshes, streams["imperfection"])
    return TakePlan(
        config=config,
        shaped=shaped,
        poses=poses,
        bodies=approach_poses(shaped, motion, config.simulation, dressing_pose(config, shaped)) + clip,
        pattern=pattern,
        coarse=meshes["coarse"],
        fine=meshes["fine"],
        template=meshes["template"],
        wrinkles=levels[-1].mesh,
        paint=_paint(config, meshes["fine"], shaped),
        levels=levels,
        made=made,
    )


def _folded(
    config: SynthConfig, pattern: Pattern, meshes: Mapping[str, PanelMesh], rng: np.random.Generator
) -> tuple[Made | None, tuple[Level, ...]]:
    """The making of the coarse mesh, and the levels of folds over it."""
    folds, fabric = config.folds, FABRICS[config.fabric]
    if folds is None:
        mesh = wrinkle_mesh(meshes["coarse"], meshes["fine"], config.relaxation, rng)
        return None, (Level(mesh, fabric, config.relaxation),)
    made = {name: Made(tailor(mesh, pattern, folds), folds) for name, mesh in meshes.items() if name != "template"}
    finish = Finish(folds.last_sweeps, folds.last_bending, folds.over_relaxation, folds.slack, folds.untangle_steps)
    soft = replace(fabric, fold_bending=folds.wide_bending)
    left = 1 - folds.wide_share
    wide = wrinkle_mesh(
        meshes["coarse"], meshes["wide"], folds.wide, rng, fabric=soft, made=made["wide"], excess_left=left
    )
    fine = wrinkle_mesh(meshes["wide"], meshes["fine"], config.relaxation, rng, fabric=fabric, made=made["fine"])
    # Folds remember for as long, whatever share of the simulated frames is captured.
    wide_folds, fine_folds = (
        replace(each, warm_start=each.warm_start**config.capture_every) for each in (folds.wide, config.relaxation)
    )
    return made["coarse"], (Level(wide, soft, wide_folds, finish), Level(fine, fabric, fine_folds, finish))


def _paint(config: SynthConfig, fine: PanelMesh, shaped: ShapedBody) -> Paint:
    outfit = OUTFITS[config.outfit]
    is_border = painted_band(fine, WIDE_BAND_M if is_held_at_waist(config) else BORDER_BAND_M)
    cloth = outfit.garment if config.print is None else WHITE
    garment = np.where(is_border[:, None], outfit.border, cloth).astype(np.uint8)
    return Paint(garment, is_border, dress_colours(shaped, outfit), _print(config, outfit, fine, is_border))


def _print(config: SynthConfig, outfit: Outfit, fine: PanelMesh, is_border: np.ndarray) -> Print | None:
    if config.print is None:
        return None
    return printed_cloth(
        fine, config.print, outfit, feature_mm=config.print_mm, painted=is_border, seed=config.seed + PRINT_STREAM
    )


def _person(shape: tuple[float, ...]) -> ShapedBody:
    return with_shape(load_anny(), np.array(shape, np.float32))


def simulate_take(take: TakePlan) -> Iterator[tuple[int, np.ndarray, np.ndarray | None]]:
    """Simulate a take, coarse and fine.

    Yields:
        For each simulated frame: its index (negative before the clip), the coarse cloth (C, 3), and for captured
        frames the fine cloth (V, 3), else None.
    """
    fabric, lead, offsets = FABRICS[take.config.fabric], take.lead, None
    worn = put_on(take.config, take.shaped, take.coarse, take.pattern, take.bodies[0])

    def relax(coarse: np.ndarray, body: PosedBody) -> np.ndarray:
        nonlocal offsets
        fine, offsets = relax_levels(take.levels, coarse, body, offsets)
        return fine

    with ThreadPoolExecutor(1) as second_core:  # newton and numba both release the interpreter
        waiting = []
        sheet = simulate(
            take.coarse,
            worn.vertices,
            take.bodies,
            fabric,
            take.config.simulation,
            made=take.made,
            held_from=worn.held_from,
        )
        for step, coarse in enumerate(sheet):
            index = step - lead
            captured = index >= 0 and index % take.config.capture_every == 0
            future = second_core.submit(relax, coarse, take.bodies[step]) if captured else None
            waiting.append((index, coarse, future))
            while waiting and (waiting[0][2] is None or waiting[0][2].done() or len(waiting) > 8):
                index, coarse, future = waiting.pop(0)
                yield index, coarse, None if future is None else future.result()
        for index, coarse, future in waiting:
            yield index, coarse, None if future is None else future.result()


def measured_poses(take: TakePlan) -> PoseSequence:
    """The poses as motion capture would give them: each joint off by a slowly varying rotation."""
    rng = np.random.default_rng([take.config.seed, 100])
    poses = take.poses
    noise = gaussian_filter1d(rng.standard_normal((*poses.rotations.shape[:2], 3)), 6, axis=0, mode="nearest")
    noise *= np.radians(take.config.mocap_noise_deg) / max(noise.std(), 1e-12) / np.sqrt(3)
    turned = Rotation.from_rotvec(noise.reshape(-1, 3)).as_matrix().reshape(poses.rotations.shape)
    return PoseSequence(
        (turned @ poses.rotations).astype(np.float32),
        poses.translations,
        poses.shape,
        poses.frame_ids,
        poses.fps,
        poses.joint_names,
    )


def painted_band(mesh: PanelMesh, width_m: float = BORDER_BAND_M) -> np.ndarray:
    """The vertices, (V,) bool, in the painted band along every border of the pattern."""
    border = np.concatenate(list(mesh.loops.values()))
    corners = np.isin(mesh.faces, border)
    return KDTree(mesh.uv[corners]).query(mesh.vertex_uv, distance_upper_bound=width_m)[0] < width_m


def dress_colours(shaped: ShapedBody, outfit: Outfit) -> np.ndarray:
    """sRGB per body vertex, (B, 3) uint8: a plain suit; head, hands and feet are bare."""
    regions = shaped.body.regions
    bare = np.zeros(len(shaped.vertices), bool) if regions is None else regions > 0
    return np.where(bare[:, None], outfit.skin, outfit.suit).astype(np.uint8)


def in_view(config: SynthConfig, fine: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """Points, (N, 3), that the rig is set up around in a frame: the corners of the garment's box.

    Of legs that trousers or a skirt hide the rest of the person tells most, so there it is the whole person.
    """
    if is_held_at_waist(config):
        return surface[::IN_VIEW_STRIDE]
    return np.array([fine.min(axis=0), fine.max(axis=0)])


def take_rig(config: SynthConfig, extent: np.ndarray) -> Rig:
    """The rig around points, (..., 3) metres, that have to be in view all through the clip (`in_view`)."""
    centre, radius = bounding_sphere(extent)
    return scanner_rig(config.scanner, centre=centre, radius=max(radius, RIG_RADIUS_M))


def take_surfaces(take: TakePlan, fine: np.ndarray, surface: np.ndarray) -> list[Surface]:
    """What the scanner sees of a frame: the painted garment, (V, 3), and the body in its suit, (B, 3); float32."""
    fusion, paint = take.config.scanner.fusion, take.paint
    faces = take.shaped.body.template.faces
    return [
        Surface(
            Mesh(fine, take.fine.faces),
            paint.garment,
            LABEL_GARMENT,
            fusion.garment_voxel_m,
            paint.is_border,
            paint.print,
        ),
        Surface(Mesh(surface, faces), paint.body, LABEL_BODY, fusion.body_voxel_m),
    ]
