"""The synthetic scanner as a stage: a configuration in, a capture folder with its truth out."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from capture4d.body import PosedBody, ShapedBody, pose_frame, with_shape
from capture4d.body_anny import load_anny
from capture4d.errors import InputError
from capture4d.motion_retarget import pose_sequence
from capture4d.records import load_rig, save_body, save_garment, save_poses, save_rig
from capture4d.scans import (
    Capture,
    TruthFrame,
    TruthModel,
    write_capture_description,
    write_scan,
    write_truth_frame,
    write_truth_model,
)
from capture4d.types import Mesh, PoseSequence, Rig
from capture4d.workdir import Stage, file_digest, open_stage, run_jobs, write_json, write_npz
from data_synth.cloth_quality import measure_cloth
from data_synth.config import FABRICS, SynthConfig
from data_synth.motions import make_motion
from data_synth.outfits import OUTFITS, Outfit
from data_synth.patterns import PanelMesh, Pattern, grade, locate, mesh_pattern, tshirt_pattern
from data_synth.rig import bounding_sphere, scanner_rig
from data_synth.scan_files import pending_scans
from data_synth.scanner import LABEL_BODY, LABEL_GARMENT, Surface, scan_surfaces
from data_synth.setting_checks import check_synth
from data_synth.simulation import approach_poses, dress, simulate
from data_synth.template import bind_template, carry
from data_synth.wrinkle_relaxation import WrinkleMesh, relax_frame, wrinkle_mesh

__all__ = [
    "Take",
    "finish_take",
    "is_whole",
    "open_take",
    "prepare_take",
    "run",
    "scan_frame",
    "scan_jobs",
    "simulate_clip",
    "simulate_take",
    "simulated_frames",
    "simulation_jobs",
    "take_rig",
    "take_surfaces",
]

SCHEMA = 2
SIMULATED = (
    "capture.json",
    "rig.json",
    "body.npz",
    "poses.npz",
    "template.npz",
    "truth/poses.npz",
    "truth/model.npz",
)
"""Files of a take that the simulation writes, besides the cloth."""
QUALITY = "truth/quality.json"
BORDER_BAND_M = 0.009
"""Width of the painted border."""
RIG_RADIUS_M = 0.58
"""Smallest sphere the rig is set up for: the upper body with room for the garment."""


@dataclass(frozen=True, slots=True, eq=False)
class Take:
    """All that is known before anything is simulated."""

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

    @property
    def lead(self) -> int:
        """Simulated frames before the clip."""
        simulation = self.config.simulation
        return simulation.calm_frames + simulation.approach_frames + simulation.rest_frames


def prepare_take(config: SynthConfig) -> Take:
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
    pattern = tshirt_pattern(shaped, config.style)
    counts = {
        "coarse": config.simulation.vertices,
        "fine": config.relaxation.vertices,
        "template": config.template_vertices,
    }
    first = tshirt_pattern(drafted, config.style)
    meshes = {name: mesh_pattern(first, count, streams[name]) for name, count in counts.items()}
    if config.drafted_for is not None:
        meshes = {name: grade(mesh, first, pattern) for name, mesh in meshes.items()}
    return Take(
        config=config,
        shaped=shaped,
        poses=poses,
        bodies=approach_poses(shaped, motion, config.simulation) + clip,
        pattern=pattern,
        coarse=meshes["coarse"],
        fine=meshes["fine"],
        template=meshes["template"],
        wrinkles=wrinkle_mesh(meshes["coarse"], meshes["fine"], config.relaxation, streams["imperfection"]),
    )


def _person(shape: tuple[float, ...]) -> ShapedBody:
    return with_shape(load_anny(), np.array(shape, np.float32))


def run(output: Path, config: SynthConfig, *, workers: int = 2, overwrite: bool = False) -> str:
    """Simulate and scan a take; the digest of the capture folder.

    Simulation is sequential and starts over when it was interrupted; scans are made in parallel and kept. Files that a
    finished take has lost are made anew, for which the clip is simulated again.

    Raises:
        InputError: a setting is out of range, or the folder holds something else.
    """
    stage = open_take(output, config, overwrite=overwrite)
    for _ in run_jobs(
        simulate_clip,
        simulation_jobs(stage, config),
        workers=1,
        label="Simulating cloth",
        units=lambda _: config.frames,
        finished=lambda: simulated_frames(stage),
    ):
        pass
    for _ in run_jobs(scan_frame, scan_jobs(stage, config), workers=workers, label="Scanning"):
        pass
    return finish_take(stage, config)


def open_take(output: Path, config: SynthConfig, *, overwrite: bool = False) -> Stage:
    """The folder of a take, new or to be continued.

    Raises:
        InputError: a setting is out of range, or the folder holds something else or a take with other settings.
    """
    check_synth(config)
    upstream = {}
    if config.motion.bvh is not None:
        path = Path(config.motion.bvh)
        if not path.is_file():
            raise InputError(f"{path}: no such BVH file")
        upstream["bvh"] = file_digest([path], root=path.parent)
    return open_stage(output, name="synth", schema=SCHEMA, config=config, upstream=upstream, overwrite=overwrite)


@dataclass(frozen=True, slots=True)
class SimulationJob:
    """The whole clip: a simulation is sequential."""

    stage: Stage
    config: SynthConfig


@dataclass(frozen=True, slots=True)
class ScanJob:
    """One frame."""

    stage: Stage
    config: SynthConfig
    frame_id: int


def simulation_jobs(stage: Stage, config: SynthConfig) -> list[SimulationJob]:
    """One, or none if the clip has been simulated. What an interrupted simulation has left is removed."""
    cloth = stage.path / "cloth"
    lost = [name for name in SIMULATED if not (stage.path / name).is_file()]
    if ((cloth / "complete.json").exists() and not lost) or is_whole(stage, config):
        return []
    shutil.rmtree(cloth, ignore_errors=True)
    return [SimulationJob(stage, config)]


def simulated_frames(stage: Stage) -> int:
    """Frames of the clip that lie on disk so far."""
    return len(list((stage.path / "cloth").glob("0*.npz")))


def scan_jobs(stage: Stage, config: SynthConfig) -> list[ScanJob]:
    """The frames that have not been scanned yet, or whose scan or truth is lost or cut off."""
    return [ScanJob(stage, config, frame_id) for frame_id in _unscanned(stage, config)]


def is_whole(stage: Stage, config: SynthConfig) -> bool:
    """Whether every file of the take is there."""
    wanted = [*SIMULATED, QUALITY]
    return all((stage.path / name).is_file() for name in wanted) and not _unscanned(stage, config)


def _unscanned(stage: Stage, config: SynthConfig) -> list[int]:
    frame_ids = range(1, config.frames + 1)
    pending = set(stage.pending(frame_ids, folder="truth"))
    if config.scans:
        pending.update(pending_scans(stage, frame_ids))
    return sorted(pending)


def finish_take(stage: Stage, config: SynthConfig) -> str:
    """Close the folder of a take whose frames are all there; its digest."""
    frame_ids = list(range(1, config.frames + 1))
    _write_quality(stage, frame_ids)
    files = [stage.path / name for name in (*SIMULATED, QUALITY)]
    files += [stage.frame_path(frame_id, folder="truth") for frame_id in frame_ids]
    if config.scans:
        files += [stage.frame_path(frame_id, ".ply", folder="scans") for frame_id in frame_ids]
    digest = stage.finish(files)
    shutil.rmtree(stage.path / "cloth", ignore_errors=True)
    return digest


def simulate_take(take: Take) -> Iterator[tuple[int, np.ndarray, np.ndarray | None]]:
    """Simulate a take, coarse and fine.

    Yields:
        For each simulated frame: its index (negative before the clip), the coarse cloth (C, 3), and for captured
        frames the fine cloth (V, 3), else None.
    """
    fabric, lead, offsets = FABRICS[take.config.fabric], take.lead, None
    faces = take.shaped.body.template.faces
    start = dress(take.shaped, take.coarse, take.pattern, take.bodies[0])

    def relax(coarse: np.ndarray, body: PosedBody) -> np.ndarray:
        nonlocal offsets
        fine, offsets = relax_frame(
            take.wrinkles, coarse, body.vertices(), faces, offsets, fabric, take.config.relaxation
        )
        return fine

    with ThreadPoolExecutor(1) as second_core:  # newton and numba both release the interpreter
        waiting = []
        for step, coarse in enumerate(simulate(take.coarse, start, take.bodies, fabric, take.config.simulation)):
            index = step - lead
            captured = index >= 0 and index % take.config.capture_every == 0
            future = second_core.submit(relax, coarse, take.bodies[step]) if captured else None
            waiting.append((index, coarse, future))
            while waiting and (waiting[0][2] is None or waiting[0][2].done() or len(waiting) > 8):
                index, coarse, future = waiting.pop(0)
                yield index, coarse, None if future is None else future.result()
        for index, coarse, future in waiting:
            yield index, coarse, None if future is None else future.result()


def simulate_clip(job: SimulationJob) -> None:
    """Simulate a clip and write its cloth, and what no scan changes."""
    take, folder, config = prepare_take(job.config), job.stage.path, job.config
    faces = take.shaped.body.template.faces
    dressed, extent = None, []
    for index, coarse, fine in simulate_take(take):
        step = index + take.lead
        if step == config.simulation.calm_frames - 1:
            dressed = carry(take.coarse, take.template, coarse)
        if index == 0:
            assert dressed is not None
            assert fine is not None
            _write_model(take, folder, dressed, coarse, fine)
        if fine is None:
            continue
        frame_id = 1 + index // config.capture_every
        surface = take.bodies[step].vertices()
        quality = measure_cloth(take.fine, take.wrinkles, fine, surface, faces)
        write_json(folder / "cloth" / f"{frame_id:06d}.json", asdict(quality))
        write_npz(folder / "cloth" / f"{frame_id:06d}.npz", vertices=fine, body=surface.astype(np.float32))
        extent.append((fine.min(axis=0), fine.max(axis=0)))
    rig = take_rig(config, np.array(extent))
    save_rig(folder / "rig.json", rig)
    outfit = OUTFITS[config.outfit]
    save_body(folder / "body.npz", take.shaped.body)
    save_poses(folder / "poses.npz", _measured_poses(take))
    save_poses(folder / "truth" / "poses.npz", take.poses)
    write_capture_description(
        Capture(
            folder,
            config.name,
            take.poses.fps,
            tuple(int(frame_id) for frame_id in take.poses.frame_ids),
            outfit.garment,
            dict.fromkeys(take.pattern.borders, outfit.border),
        )
    )
    write_json(folder / "cloth" / "complete.json", {"frames": config.frames})


def _write_model(take: Take, folder: Path, dressed: np.ndarray, coarse: np.ndarray, fine: np.ndarray) -> None:
    """The template, and the truth that no frame changes."""
    body_at = take.config.simulation.calm_frames - 1
    settled = carry(take.coarse, take.template, coarse)
    garment = bind_template(take.template, dressed, take.bodies[body_at], settled, take.bodies[take.lead])
    save_garment(folder / "template.npz", garment)
    faces, weights = locate(take.fine, take.template.vertex_uv)
    write_truth_model(
        folder / "truth" / "model.npz",
        TruthModel(
            fine=Mesh(fine, take.fine.faces, take.fine.uv.astype(np.float32)),
            loops={name: loop.astype(np.int32) for name, loop in take.fine.loops.items()},
            template_faces=faces,
            template_barycentric=weights.astype(np.float32),
        ),
    )


def _measured_poses(take: Take) -> PoseSequence:
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


def painted_band(mesh: PanelMesh) -> np.ndarray:
    """The vertices, (V,) bool, in the painted band along every border of the pattern."""
    border = np.concatenate(list(mesh.loops.values()))
    corners = np.isin(mesh.faces, border)
    return KDTree(mesh.uv[corners]).query(mesh.vertex_uv, distance_upper_bound=BORDER_BAND_M)[0] < BORDER_BAND_M


def dress_colours(shaped: ShapedBody, outfit: Outfit) -> np.ndarray:
    """sRGB per body vertex, (B, 3) uint8: a plain suit; head, hands and feet are bare."""
    regions = shaped.body.regions
    bare = np.zeros(len(shaped.vertices), bool) if regions is None else regions > 0
    return np.where(bare[:, None], outfit.skin, outfit.suit).astype(np.uint8)


def take_rig(config: SynthConfig, extent: np.ndarray) -> Rig:
    """The rig around a garment whose corners, (..., 3) metres, lie within `extent` all through the clip."""
    centre, radius = bounding_sphere(extent)
    return scanner_rig(config.scanner, centre=centre, radius=max(radius, RIG_RADIUS_M))


def take_surfaces(take: Take, fine: np.ndarray, surface: np.ndarray) -> list[Surface]:
    """What the scanner sees of a frame: the painted garment, (V, 3), and the body in its suit, (B, 3); float32."""
    fusion, (cloth, painted, dress) = take.config.scanner.fusion, _colours(take)
    faces = take.shaped.body.template.faces
    return [
        Surface(Mesh(fine, take.fine.faces), cloth, LABEL_GARMENT, fusion.garment_voxel_m, painted),
        Surface(Mesh(surface, faces), dress, LABEL_BODY, fusion.body_voxel_m),
    ]


@lru_cache(maxsize=1)
def _colours(take: Take) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the garment (V, 3), where it is painted (V,), and of the body (B, 3): the same in every frame of a take."""
    outfit, painted = OUTFITS[take.config.outfit], painted_band(take.fine)
    cloth = np.where(painted[:, None], outfit.border, outfit.garment).astype(np.uint8)
    return cloth, painted, dress_colours(take.shaped, outfit)


_PREPARED: dict[SynthConfig, tuple[Take, Rig]] = {}
"""What a scanning process prepares once; a process serves one take."""


def scan_frame(job: ScanJob) -> int:
    """Scan a simulated frame and write its truth; its number."""
    if job.config not in _PREPARED:
        _PREPARED.clear()
        _PREPARED[job.config] = prepare_take(job.config), load_rig(job.stage.path / "rig.json")
    take, rig = _PREPARED[job.config]
    folder, frame_id, config = job.stage.path, job.frame_id, job.config
    with np.load(folder / "cloth" / f"{frame_id:06d}.npz", allow_pickle=False) as cloth:
        fine, surface = cloth["vertices"], cloth["body"]
    labels = np.zeros(0, np.uint8)
    if config.scans:
        scan, labels = scan_surfaces(
            rig,
            take_surfaces(take, fine, surface),
            config=config.scanner,
            rng=np.random.default_rng([config.seed, 200, frame_id]),
            frame_id=frame_id,
            time_s=(frame_id - 1) / take.poses.fps,
        )
        write_scan(folder / "scans" / f"{frame_id:06d}.ply", scan)
    position = frame_id - 1
    write_truth_frame(
        folder / "truth" / f"{frame_id:06d}.npz",
        TruthFrame(fine, take.poses.rotations[position], take.poses.translations[position], labels),
    )
    return frame_id


def _write_quality(stage: Stage, frame_ids: list[int]) -> None:
    """Gather the measures of every simulated frame; bad frames are reported, not hidden."""
    path = stage.path / QUALITY
    if path.exists():
        return
    rows = [
        {"frame_id": frame_id, **json.loads((stage.path / "cloth" / f"{frame_id:06d}.json").read_text())}
        for frame_id in frame_ids
    ]
    write_json(path, rows)
    bad = [row for row in rows if row["reasons"]]
    for row in bad[:10]:
        print(f"frame {row['frame_id']}: {'; '.join(row['reasons'])}")
    if len(bad) > 10:
        print(f"... and {len(bad) - 10} more flagged frames, all in {path}")
