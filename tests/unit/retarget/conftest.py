"""A tube of cloth around a bending bone, whose unposed shape is a known mix of a few waves."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.body.skinning import pose_frame, skin, with_shape
from capture4d.captures.work_folder import REGISTER, VERDICTS, stack_vertices
from capture4d.cli.main import main
from capture4d.files.atomic import write_bytes, write_npz
from capture4d.files.records import save_body, save_garment, save_poses
from capture4d.geometry.mesh import boundary_loops
from capture4d.geometry.ray_casting import closest_points
from capture4d.runs.stage import open_stage
from capture4d.types import Body, Garment, PoseSequence, RegisteredSequence
from tests.shapes import tube

NAMES = ("root", "middle", "top")


def bone_weights(height: np.ndarray) -> np.ndarray:
    """Weights (V, 3) of a chain with joints at 0, 0.2 and 0.4 m, blended over 0.1 m."""
    middle, top = np.clip((height - 0.15) / 0.1, 0, 1), np.clip((height - 0.35) / 0.1, 0, 1)
    return np.stack([1 - middle, middle - top, top], axis=1).astype(np.float32)


@pytest.fixture(scope="session")
def body() -> Body:
    """A limb, 0.1 m in radius; its first shape component makes it 2 cm thicker, its second a tenth longer."""
    mesh = tube(24, 16, 0.1, 0.7, -0.1)
    vertices = mesh.vertices
    joints = np.array([[0, 0, 0], [0, 0.2, 0], [0, 0.4, 0]], np.float32)
    return Body(
        template=mesh,
        shape_directions=np.stack([vertices * (0.2, 0, 0.2), vertices * (0, 0.1, 0)]).astype(np.float32),
        joints=joints,
        joint_directions=np.stack([joints * 0, joints * (0, 0.1, 0)]).astype(np.float32),
        joint_names=NAMES,
        parents=np.array([-1, 0, 1], np.int32),
        skin_weights=bone_weights(vertices[:, 1]),
    )


@pytest.fixture(scope="session")
def garment(body: Body) -> Garment:
    mesh = tube(20, 14, 0.13)
    low, high = sorted(boundary_loops(mesh.faces), key=lambda loop: mesh.vertices[loop, 1].mean())
    _, faces, barycentric = closest_points(body.template, mesh.vertices)
    return Garment(
        mesh, {"hem": low, "neck": high}, faces, barycentric, bone_weights(mesh.vertices[:, 1]), np.zeros(2, np.float32)
    )


def some_motion(frames: int, seed: int, fps: float = 60.0) -> PoseSequence:
    """Smooth random bending of both joints, while the root walks and turns."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames) / fps
    phases, rates = rng.uniform(0, 2 * np.pi, (3, 3)), rng.uniform(1.5, 4, (3, 3))
    turns = np.sin(time[:, None, None] * rates + phases) * np.array([0.4, 0.5, 0.6])[:, None]
    rotations = np.stack([Rotation.from_rotvec(turns[:, joint]).as_matrix() for joint in range(3)], axis=1)
    translations = 0.1 * np.sin(time[:, None] * rates[0] + phases[1])
    return PoseSequence(
        rotations.astype(np.float32), translations.astype(np.float32), np.zeros(2, np.float32),
        np.arange(1, frames + 1, dtype=np.int32), fps, NAMES,
    )  # fmt: skip


@dataclass(frozen=True)
class World:
    """A garment whose unposed shape is `mean + coefficients @ waves`, the coefficients a function of the pose."""

    body: Body
    garment: Garment
    waves: np.ndarray
    mixing: np.ndarray
    lag: float

    def coefficients(self, poses: PoseSequence) -> np.ndarray:
        """Linear in the joints' rotation vectors; with a lag, of the pose some frames ago, and squared."""
        turns = (
            Rotation.from_matrix(poses.rotations[:, 1:].reshape(-1, 3, 3)).as_rotvec().reshape(len(poses.frame_ids), -1)
        )
        late = turns[np.maximum(np.arange(len(turns)) - 2, 0)]
        linear = turns @ self.mixing
        return linear + self.lag * (late @ self.mixing) * np.abs(linear)

    def unposed(self, poses: PoseSequence) -> np.ndarray:
        flat = self.coefficients(poses) @ self.waves.reshape(len(self.waves), -1)
        return self.garment.template.vertices.astype(float) + flat.reshape(len(flat), -1, 3)

    def registered(self, poses: PoseSequence) -> RegisteredSequence:
        shaped = with_shape(self.body, poses.shape)
        vertices = [
            skin(rest, self.garment.skin_weights, pose_frame(shaped, poses, row).transforms)
            for row, rest in enumerate(self.unposed(poses))
        ]
        residual = np.zeros((len(vertices), len(vertices[0])), np.float32)
        return RegisteredSequence(self.garment, np.array(vertices, np.float32), residual, poses.frame_ids)


@pytest.fixture(scope="session")
def motion():
    return some_motion


@pytest.fixture(scope="session")
def make_world(body: Body, garment: Garment):
    def make(lag: float = 0.0, waves: int = 4) -> World:
        rng = np.random.default_rng(5)
        count = len(garment.template.vertices)
        directions = np.linalg.qr(rng.standard_normal((3 * count, waves)))[0].T.reshape(waves, count, 3)
        return World(body, garment, directions, 0.05 * rng.standard_normal((6, waves)), lag)

    return make


@pytest.fixture(scope="session")
def write_work(make_world):
    """A work folder with a finished registration of the world's garment, its body tracked."""

    def write(work: Path, poses: PoseSequence, *, world: World | None = None, flagged: tuple[int, ...] = ()) -> Path:
        world = world or make_world()
        registered = world.registered(poses)
        tracked = open_stage(work / "body", name="track", schema=1, config={}, upstream={})
        save_body(tracked.path / "body.npz", world.body)
        save_poses(tracked.path / "poses.npz", poses)
        upstream = {"body": tracked.finish([tracked.path / "poses.npz"]).digest, "garment": work.name}
        stage = open_stage(work / "registration", name=REGISTER, schema=1, config={}, upstream=upstream)
        save_garment(stage.path / "garment.npz", registered.garment)
        records = []
        for row, frame_id in enumerate(poses.frame_ids.tolist()):
            verdict = 2 if row in flagged else 0
            vertices = registered.vertices[row] + (5.0 if row in flagged else 0.0)
            residual = registered.residual_m[row]
            write_npz(stage.frame_path(frame_id), vertices=vertices, residual_m=residual, verdict=np.uint8(verdict))
            records.append({"frame_id": frame_id, "verdict": VERDICTS[verdict], "reasons": []})
        stack_vertices(stage, poses.frame_ids.tolist())
        lines = "".join(json.dumps(record) + "\n" for record in records)
        write_bytes(stage.path / "metrics.jsonl", lines.encode())
        stage.finish([stage.path / "vertices.npy"])
        return work

    return write


@pytest.fixture(scope="session")
def quick() -> tuple[str, ...]:
    """Options with which `fit` takes seconds."""
    shape = ("--shape.max-error-mm", "0.1")
    return *shape, "--lstm.layers", "1", "--lstm.size", "16", "--training.epochs", "3", "--workers", "1"


@pytest.fixture(scope="session")
def works(write_work, make_world, tmp_path_factory) -> list[Path]:
    """Three takes, one frame of each flagged."""
    world, folder = make_world(waves=3), tmp_path_factory.mktemp("works")
    return [write_work(folder / f"take{seed}", some_motion(16, seed), world=world, flagged=(4,)) for seed in range(3)]


@pytest.fixture(scope="session")
def learned(works, quick, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("fit") / "learned"
    options = ["--output", str(output), "--split.validation", "take2", "--licence", "CC0", *quick]
    with pytest.raises(SystemExit) as exit_:
        main(["fit", *map(str, works), *options])
    assert not exit_.value.code
    return output


@pytest.fixture
def model(learned: Path, tmp_path: Path) -> Path:
    """A copy of a learned garment, to be spoilt."""
    shutil.copytree(learned, tmp_path / "learned")
    return tmp_path / "learned" / "retarget"
