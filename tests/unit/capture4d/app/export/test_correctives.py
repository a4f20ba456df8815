"""Shapes that correct a skeleton: laws of the weights, and errors held against a slow evaluation."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.app.export.clip import read_clip
from capture4d.app.export.correctives import FitLimits, exact_targets, fit_targets
from capture4d.app.export.glb_check import largest_glb_difference
from capture4d.app.export.skeleton import four_influences
from capture4d.captures.work_folder import open_work
from capture4d.cli.exit_codes import GOOD
from capture4d.errors import InputError
from tests.command_line import run
from tests.moving_garment import write_moving_work


def fitted(clip, scratch: Path, *, p99_mm: float = 0.5, max_mm: float = 2.0, most: int = 128):
    return fit_targets(clip.moving, clip.skeleton, scratch, FitLimits(p99_mm, max_mm, most))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_error_is_kept_with_weights_that_every_client_takes(seed: int, tmp_path: Path):
    write_moving_work(tmp_path / "work", 24, seed=seed)
    clip = read_clip(open_work(tmp_path / "work"))
    targets, error = fitted(clip, tmp_path / "rest")
    assert targets.weights.min() >= 0
    assert targets.weights.max() <= 1
    assert error.p99_mm <= 0.5
    assert error.max_mm <= 2
    fewer, worse = fitted(clip, tmp_path / "rest", most=len(targets.directions) - 1)
    assert len(fewer.directions) == len(targets.directions) - 1
    assert worse.p99_mm > 0.5 or worse.max_mm > 2, "no fewer would do"


def test_enough_shapes_are_exact_though_weights_are_cut_to_four(tmp_path: Path):
    vertices = write_moving_work(tmp_path / "work", 9)
    clip = read_clip(open_work(tmp_path / "work"))
    assert clip.skeleton is not None
    assert (np.count_nonzero(clip.skeleton.weights, axis=1) <= 4).all()
    targets, error = fitted(clip, tmp_path / "rest", p99_mm=1e-4, max_mm=1e-3)
    assert len(targets.directions) == len(vertices) - 1
    assert error.max_mm < 1e-3


def test_four_influences_are_the_largest_and_add_up_to_one():
    weights = np.random.default_rng(0).dirichlet(np.ones(9), 50).astype(np.float32)
    cut = four_influences(weights)
    assert (np.count_nonzero(cut, axis=1) == 4).all()
    assert np.allclose(cut.sum(axis=1), 1, atol=1e-6)
    kept = cut > 0
    assert (np.where(kept, weights, 1).min(axis=1) >= np.where(kept, 0, weights).max(axis=1)).all()
    ratio = np.where(kept, cut / weights, np.nan)
    assert np.allclose(np.nanmin(ratio, axis=1), np.nanmax(ratio, axis=1), rtol=1e-4)


def test_a_shape_for_each_frame_is_exact(tmp_path: Path):
    vertices = write_moving_work(tmp_path / "work", 5)
    targets, error = exact_targets(read_clip(open_work(tmp_path / "work")).moving)
    assert error.max_mm < 1e-4
    assert np.allclose(targets.base + np.tensordot(targets.weights, targets.directions, axes=1), vertices, atol=1e-7)


# --- the file ----------------------------------------------------------------------------------------------------


class Glb:
    """A GLB as its specification reads, slowly: no code of ours."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        length = struct.unpack_from("<I", data, 12)[0]
        self.tree, self.binary = json.loads(data[20 : 20 + length]), data[28 + length :]

    def array(self, index: int) -> np.ndarray:
        accessor = self.tree["accessors"][index]
        view = self.tree["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
        kind = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}[accessor["componentType"]]
        values = np.frombuffer(self.binary, kind, accessor["count"] * width, view["byteOffset"])
        return values.reshape(-1, width).astype(np.float64)

    def at(self, frame: int) -> np.ndarray:
        """Vertices (V, 3) of the mesh before it was split, in the world."""
        tree = self.tree
        state = [{"rotation": [0, 0, 0, 1], "translation": [0, 0, 0], **node} for node in tree["nodes"]]
        animation = tree["animations"][0]
        for channel in animation["channels"]:
            sampler, target = animation["samplers"][channel["sampler"]], channel["target"]
            values = self.array(sampler["output"]).reshape(len(self.array(sampler["input"])), -1)
            state[target["node"]][target["path"]] = values[frame]
        primitive = tree["meshes"][0]["primitives"][0]
        points = self.array(primitive["attributes"]["POSITION"]).copy()
        for weight, shape in zip(state[0].get("weights", []), primitive.get("targets", []), strict=True):
            points += weight * self.array(shape["POSITION"])
        if "skins" in tree:
            points = self.skinned(points, state, primitive["attributes"])
        number = self.array(primitive["attributes"]["_VERTEX"])[:, 0].astype(int)
        whole = np.full((number.max() + 1, 3), np.nan)
        whole[number] = points
        return whole

    def skinned(self, points: np.ndarray, state: list[dict], attributes: dict) -> np.ndarray:
        parent = {child: at for at, node in enumerate(state) for child in node.get("children", [])}

        def world(node: int) -> np.ndarray:
            own = np.eye(4)
            own[:3, :3] = Rotation.from_quat(state[node]["rotation"]).as_matrix()
            own[:3, 3] = state[node]["translation"]
            return world(parent[node]) @ own if node in parent else own

        skin = self.tree["skins"][0]
        inverse = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        bones = [world(joint) @ back for joint, back in zip(skin["joints"], inverse, strict=True)]
        joints, weights = self.array(attributes["JOINTS_0"]).astype(int), self.array(attributes["WEIGHTS_0"])
        moved = np.zeros_like(points)
        for vertex, point in enumerate(np.column_stack([points, np.ones(len(points))])):
            for joint, weight in zip(joints[vertex], weights[vertex], strict=True):
                moved[vertex] += weight * (bones[joint] @ point)[:3]
        return moved


@pytest.mark.parametrize("more", [[], ["--glb.motion", "exact"]])
def test_a_glb_shows_what_it_says_by_the_letter_of_the_specification(more: list[str], tmp_path: Path):
    vertices = write_moving_work(tmp_path / "work", 6, seed=4, first=11, fps=50, maps=16)
    assert run("export", tmp_path / "work", "--format", "glb", "--quiet", *more) == GOOD
    glb = Glb(tmp_path / "work" / "exports" / "garment.glb")
    said = glb.tree["asset"]["extras"]["capture4d"]["error"]
    largest = max(1000 * np.linalg.norm(glb.at(row) - vertices[row], axis=1).max() for row in range(6))
    assert largest == pytest.approx(said["max_mm"], abs=0.002)
    times = glb.array(glb.tree["animations"][0]["samplers"][0]["input"])[:, 0]
    assert np.allclose(times, np.arange(6) / 50)
    assert glb.tree["scenes"][0]["extras"] == {"fps": 50.0, "first_frame": 11}
    assert glb.tree["materials"][0]["normalTexture"] == {"index": 0}


def test_reading_back_finds_a_vertex_that_is_elsewhere(tmp_path: Path):
    write_moving_work(tmp_path / "work", 4)
    moving = read_clip(open_work(tmp_path / "work")).moving
    assert run("export", tmp_path / "work", "--format", "glb", "--quiet", "--glb.motion", "exact") == GOOD
    path = tmp_path / "work" / "exports" / "garment.glb"
    assert largest_glb_difference(path, moving) < 1e-6
    glb, data = Glb(path), bytearray(path.read_bytes())
    start = len(data) - len(glb.binary)
    accessor = glb.tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    place = start + glb.tree["bufferViews"][glb.tree["accessors"][accessor]["bufferView"]]["byteOffset"]
    (x,) = struct.unpack_from("<f", data, place)
    struct.pack_into("<f", data, place, x + 0.0002)
    path.write_bytes(data)
    assert largest_glb_difference(path, moving) == pytest.approx(0.0002, rel=1e-2)
    path.write_bytes(data[:-8])
    with pytest.raises(InputError, match=r"garment\.glb"):
        largest_glb_difference(path, moving)
