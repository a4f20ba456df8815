"""What a value must be to be accepted: the rules of SECURITY.md, and files that break each of them."""

from __future__ import annotations

import json
import random
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.reader_damage import with_arrays
from benchmarks.reader_kinds import whole
from benchmarks.reader_values import BODY, GARMENT, POSES

__all__ = ["RULES", "Rule"]

Files = dict[str, bytes]


@dataclass(frozen=True)
class Rule:
    """One thing that no value may be."""

    name: str
    """As SECURITY.md has it."""
    breakers: tuple[tuple[str, Callable[[random.Random, bytes], bytes]], ...]
    """Kinds of files, and what makes of a whole one a file that breaks the rule."""

    @property
    def kinds(self) -> tuple[str, ...]:
        """Of its mutants, several of each breaker."""
        return tuple(name for name, _ in self.breakers for _ in range(TIMES))

    def broken(self, chance: random.Random, number: int) -> Files:
        name, breaker = self.breakers[number // TIMES]
        files = whole(name)
        return files | {name: breaker(chance, files[name])}


TIMES = 3
"""Mutants of each breaker."""


# --- how a file is made to break a rule ------------------------------------------------------------------------------


def _arrays(**changes: Callable[[random.Random], Any]) -> Callable[[random.Random, bytes], bytes]:
    """An npz file with other arrays."""
    return lambda chance, data: with_arrays(data, {name: change(chance) for name, change in changes.items()})


def _json(*path: Any, to: Callable[[random.Random, Any], Any]) -> Callable[[random.Random, bytes], bytes]:
    """A JSON file with another entry."""

    def change(chance: random.Random, data: bytes) -> bytes:
        tree = json.loads(data)
        owner = tree
        for key in path[:-1]:
            owner = owner[key]
        owner[path[-1]] = to(chance, owner.get(path[-1]) if isinstance(owner, dict) else owner[path[-1]])
        return json.dumps(tree).encode()

    return change


def _note(*path: Any, to: Callable[[random.Random, Any], Any]) -> Callable[[random.Random, bytes], bytes]:
    """A safetensors file with another entry in its note."""

    def change(chance: random.Random, data: bytes) -> bytes:
        length = struct.unpack_from("<Q", data)[0]
        header = json.loads(data[8 : 8 + length])
        note = header["__metadata__"]["capture4d"].encode()
        header["__metadata__"]["capture4d"] = _json(*path, to=to)(chance, note).decode()
        text = json.dumps(header).encode()
        return struct.pack("<Q", len(text)) + text + data[8 + length :]

    return change


def _tensor(name: str, change: Callable[[random.Random, np.ndarray], np.ndarray]) -> Callable[..., bytes]:
    """A safetensors file with another tensor."""

    def broken(chance: random.Random, data: bytes) -> bytes:
        import safetensors.numpy

        length = struct.unpack_from("<Q", data)[0]
        about = json.loads(data[8 : 8 + length])["__metadata__"]
        tensors = safetensors.numpy.load(data)
        return safetensors.numpy.save(
            {**tensors, name: np.ascontiguousarray(change(chance, tensors[name]))}, metadata=about
        )

    return broken


def _swapped(pattern: bytes, *choices: bytes) -> Callable[[random.Random, bytes], bytes]:
    """A text file with something else in one place."""

    def change(chance: random.Random, data: bytes) -> bytes:
        found = list(re.finditer(pattern, data))
        chosen = chance.choice(found)
        return data[: chosen.start(1)] + chance.choice(choices) + data[chosen.end(1) :]

    return change


def _with_entry(array: np.ndarray, *choices: Any) -> Callable[[random.Random], np.ndarray]:
    """An array with one number changed."""

    def change(chance: random.Random) -> np.ndarray:
        changed = array.copy()
        changed.reshape(-1)[chance.randrange(array.size)] = chance.choice(choices)
        return changed

    return change


def _with_row(array: np.ndarray, row: Callable[[np.ndarray], Any]) -> Callable[[random.Random], np.ndarray]:
    """An array with one row changed."""

    def change(chance: random.Random) -> np.ndarray:
        changed = array.copy()
        at = chance.randrange(len(array))
        changed[at] = row(changed[at])
        return changed

    return change


def _one(changed: Callable[[np.ndarray, Any], Any]) -> Callable[[random.Random, np.ndarray], np.ndarray]:
    def change(chance: random.Random, array: np.ndarray) -> np.ndarray:
        copy = array.copy().reshape(-1)
        at = chance.randrange(copy.size)
        copy[at] = changed(copy, at)
        return copy.reshape(array.shape)

    return change


def _word_in_ply(element: str, value: float) -> Callable[[random.Random, bytes], bytes]:
    """A coordinate of a vertex, or a corner of a face, in the binary ply of `write_mesh`."""

    def change(chance: random.Random, data: bytes) -> bytes:
        head, end, body = data.partition(b"end_header\n")
        if element == "vertex":
            at = 15 * chance.randrange(6) + 4 * chance.randrange(3)
            return head + end + body[:at] + struct.pack("<f", value) + body[at + 4 :]
        texture = 1 + 24 if b"texcoord" in head else 0
        at = 6 * 15 + (13 + texture) * chance.randrange(3) + 1 + 4 * chance.randrange(3)
        return head + end + body[:at] + struct.pack("<i", int(value)) + body[at + 4 :]

    return change


def _in_glb(value: float) -> Callable[[random.Random, bytes], bytes]:
    """A coordinate of the first vertices in a glb."""

    def change(chance: random.Random, data: bytes) -> bytes:
        length = struct.unpack_from("<I", data, 12)[0]
        tree, start = json.loads(data[20 : 20 + length]), 28 + length
        attributes = tree["meshes"][0]["primitives"][0]["attributes"]
        accessor = tree["accessors"][attributes["POSITION"]]
        start += tree["bufferViews"][accessor["bufferView"]].get("byteOffset", 0) + accessor.get("byteOffset", 0)
        at = start + 4 * chance.randrange(18)
        return data[:at] + struct.pack("<f", value) + data[at + 4 :]

    return change


_NAN, _INF = np.nan, np.inf
_TURN = np.diag([1, 1, -1]).astype(np.float32)
_HEM = GARMENT.loops["hem"]


def _of(array: np.ndarray) -> Callable[[random.Random], np.ndarray]:
    return lambda chance: array


RULES = (
    Rule("Numbers are finite", (
        ("mesh.obj", _swapped(rb"(?m)^v (\S+)", b"nan", b"inf", b"1e999", b"1e300")),
        ("mesh.ply", _word_in_ply("vertex", _NAN)),
        ("mesh.ply", _word_in_ply("vertex", _INF)),
        ("text.ply", _swapped(rb"(?m)^1 (0) 0 4", b"nan", b"inf", b"1e999")),
        ("mesh.glb", _in_glb(_NAN)),
        ("mesh.glb", _in_glb(-_INF)),
        ("body.npz", _arrays(joints=_with_entry(BODY.joints, _NAN, _INF))),
        ("body.npz", _arrays(template_vertices=_with_entry(BODY.template.vertices, _NAN, _INF))),
        ("garment.npz", _arrays(embedding_barycentric=_with_entry(np.asarray(GARMENT.embedding_barycentric), _NAN))),
        ("garment.npz", _arrays(body_shape=_with_entry(np.zeros(2, np.float32), _NAN, _INF))),
        ("poses.npz", _arrays(translations=_with_entry(POSES.translations, _NAN, _INF))),
        ("poses.npz", _arrays(shape=_with_entry(POSES.shape, _NAN, _INF))),
        ("linear.safetensors", _tensor("matrix", _one(lambda _, at: _NAN))),
        ("kernel.safetensors", _tensor("frames", _one(lambda _, at: _INF))),
        ("lstm.safetensors", _tensor("coefficient_std", _one(lambda _, at: _NAN))),
        ("poses.safetensors", _tensor("quaternions", _one(lambda _, at: _NAN))),
        ("generator.safetensors", _tensor("reference", _one(lambda _, at: _NAN))),
        ("pca.safetensors", _tensor("mean", _one(lambda _, at: _NAN))),
        ("poses.safetensors", _tensor("linear.poses", _one(lambda _, at: _NAN))),
        ("mesh.off", _swapped(rb"(?m)^(0\.\d+) 0", b"nan", b"inf", b"1e999")),
        ("text.stl", _swapped(rb"vertex (\S+)", b"nan", b"-inf", b"1e999")),
        ("binary.stl", lambda chance, data: data[:96] + struct.pack("<f", _NAN) + data[100:]),
        ("mixamo.bvh", _swapped(rb"(?m)^(\S+) ", b"nan", b"inf", b"1e999")),
        ("biped.bvh", _swapped(rb"OFFSET 0 (0)", b"nan", b"inf", b"1e999")),
        ("parameters.npz", _arrays(body_pose=_with_entry(np.zeros((3, 63)), _NAN, _INF))),
        ("parameters.npz", _arrays(transl=_with_entry(np.zeros((3, 3)), _NAN, _INF))),
        ("cameras.xml", _swapped(rb"<transform>(1) 0", b"nan", b"inf", b"1e999")),
        ("cameras.xml", _swapped(rb"<f>(900)", b"nan", b"inf", b"0", b"-900")),
        ("transforms.json", _json("fl_x", to=lambda chance, _: chance.choice((_NAN, _INF, -1, 0, True, "900")))),
        ("fisheye.json", _json("cameras", 0, "distortion", to=lambda chance, _: [0, 0, 0, _NAN])),
        ("blendshapes.safetensors", _tensor("basis", _one(lambda _, at: _INF))),
        ("registration/vertices.npy", lambda chance, data: data[:-12] + struct.pack("<f", _NAN) + data[-8:]),
    )),
    Rule("Faces join vertices that are there", (
        ("mesh.obj", _swapped(rb"(?m)^f (\d+)", b"7", b"0", b"-99", b"4294967297")),
        ("mesh.ply", _word_in_ply("face", 6)),
        ("mesh.ply", _word_in_ply("face", -1)),
        ("body.npz", _arrays(template_faces=_with_entry(BODY.template.faces, -1, 6, 2**31 - 1))),
        ("garment.npz", _arrays(template_faces=_with_entry(GARMENT.template.faces, -1, 6, 2**31 - 1))),
        ("garment.npz", _arrays(embedding_faces=_with_entry(np.asarray(GARMENT.embedding_faces), -1, -7))),
        ("sequence.npz", _arrays(faces=_with_entry(GARMENT.template.faces, -1, 6))),
        ("blendshapes.safetensors", _tensor("template_faces", _one(lambda _, at: 6))),
        ("two.obj", _swapped(rb"f (1)/1/1", b"5", b"0", b"-99", b"4294967297")),
        ("two.obj", _swapped(rb"f 1/(1)/1", b"5", b"0", b"-99", b"4294967297")),
        ("mesh.off", _swapped(rb"(?m)^3 \d (\d)", b"6", b"-1", b"4294967296", b"1.5")),
        ("scene.bin", lambda chance, data: data[:-4] + struct.pack("<H", 6) + data[-2:]),
    )),
    Rule("Rotations are rotations", (
        ("poses.npz", _arrays(rotations=lambda chance: POSES.rotations * np.float32(chance.choice((0, 1.1, 3, -1))))),
        ("poses.npz", _arrays(rotations=_of(POSES.rotations @ _TURN))),
        ("poses.npz", _arrays(rotations=_with_entry(POSES.rotations, 0.5, 7.0, -3.0))),
        ("motion.npz", _arrays(rotations=_with_entry(POSES.rotations, 0.5, 7.0, -3.0))),
        ("poses.safetensors", _tensor("quaternions", lambda chance, array: 2 * array)),
        ("about_origin.npz", _arrays(poses=lambda chance: np.tile(2.0 * np.eye(3), (3, 24, 1, 1)))),
        ("about_origin.npz", _arrays(poses=lambda chance: np.tile(-np.eye(3), (3, 24, 1, 1)))),
        ("rig.json", _json("cameras", 0, "T_camera_world", 0, to=lambda chance, row: [2, *row[1:]])),
        ("rig.json", _json("cameras", 0, "T_camera_world", 0, to=lambda chance, row: [-1, *row[1:]])),
        ("cameras.xml", _swapped(rb"<transform>(1) 0", b"2", b"-1", b"0")),
        ("transforms.json",
         _json("frames", 0, "transform_matrix", 0, 0, to=lambda chance, _: chance.choice((0, -1, 3)))),
    )),
    Rule("Frames are numbered once each, from 0 up", (
        ("poses.npz", _arrays(frame_ids=_of(np.array([0, 1, 1], np.int32)))),
        ("poses.npz", _arrays(frame_ids=_of(np.array([-1, 1, 2], np.int32)))),
        ("capture.json", _json("frames", to=lambda chance, _: chance.choice(([1, 1], [2, 1], [-1, 2])))),
        ("capture.json", _json("frames", to=lambda chance, _: chance.choice((["1"], [True], [1.5], "12", {"1": 2})))),
    )),
    Rule("Frame rates are from 0.01 to 100000 a second", (
        ("poses.npz", _arrays(fps=lambda chance: np.float64(chance.choice((0, -60, _NAN, _INF, 1e300, 1e-300))))),
        ("amass.npz", _arrays(mocap_framerate=lambda chance: np.float64(chance.choice((0, -60, _NAN, _INF, 1e300))))),
        ("biped.bvh", _swapped(rb"Frame Time: (\S+)", b"0", b"-0.01", b"nan", b"inf", b"1e300")),
        ("parameters.npz", _arrays(fps=lambda chance: np.float64(chance.choice((0, -60, _NAN, _INF, 1e300))))),
        ("motion.bvh", _swapped(rb"Frame Time: (\S+)", b"0", b"-0.01", b"nan", b"inf", b"1e300", b"1e-300")),
        ("capture.json", _json("fps", to=lambda chance, _: chance.choice((0, -60, _NAN, _INF, 1e300, True, "60")))),
        ("blendshapes.safetensors", _note("fps", to=lambda chance, _: chance.choice((0, -60, 1e300, True, "60")))),
        ("linear.safetensors", _note("layout", "fps", to=lambda chance, _: chance.choice((0, -60, 1e300, True, "60")))),
    )),
    Rule("Skin weights are not negative, and those of a vertex sum to 1", (
        ("body.npz", _arrays(skin_weights=lambda chance: BODY.skin_weights * np.float32(chance.choice((0, 0.5, 2))))),
        ("body.npz", _arrays(skin_weights=_with_row(BODY.skin_weights, lambda row: [2, -1, *np.zeros(len(row) - 2)]))),
        ("garment.npz", _arrays(skin_weights=_of(BODY.skin_weights * 3))),
        ("garment.npz",
         _arrays(skin_weights=_with_row(BODY.skin_weights, lambda row: [2, -1, *np.zeros(len(row) - 2)]))),
        ("blendshapes.safetensors", _tensor("skin_weights", lambda chance, array: array / 2)),
    )),
    Rule("A skeleton is a tree with joint 0 as its root, parents first", (
        ("body.npz", _arrays(parents=lambda chance: BODY.parents + chance.choice((1, 2, -1)))),
        ("body.npz", _arrays(parents=_of(np.zeros_like(BODY.parents)))),
        ("body.npz", _arrays(parents=_of(BODY.parents[::-1].copy()))),
    )),
    Rule("A border loop names at least three vertices, once each, along open edges", (
        ("garment.npz", _arrays(loop_hem=_of(np.array([0, 1, 2, 3, 0], np.int32)))),
        ("garment.npz", _arrays(loop_hem=_of(np.array([0, 1, 99], np.int32)))),
        ("garment.npz", _arrays(loop_hem=_of(np.array([0, 1, -1], np.int32)))),
        ("garment.npz", _arrays(loop_hem=_of(np.array([0, 1], np.int32)))),
        ("garment.npz", _arrays(loop_hem=_of(np.array([], np.int32)))),
        ("garment.npz", _arrays(loop_hem=_of(np.array([0, 2, 1, 3], np.int32)))),
        ("garment.npz", _arrays(loop_hem=_of(np.array([0, 5, 2], np.int32)))),
        ("blendshapes.safetensors", _tensor("loop_hem", lambda chance, array: array[[0, 1, 2, 0]])),
    )),
    Rule("Points on a surface lie in their triangle", (
        ("garment.npz", _arrays(embedding_barycentric=_of(np.asarray(GARMENT.embedding_barycentric) * 2))),
        ("garment.npz", _arrays(embedding_barycentric=_with_row(
            np.asarray(GARMENT.embedding_barycentric), lambda _: [5, -2, -2]))),
    )),
    Rule("A name is given once", (
        ("body.npz", _arrays(joint_names=_of(np.array(["root"] * len(BODY.joint_names))))),
        ("poses.npz", _arrays(joint_names=_of(np.array(["root"] * len(BODY.joint_names))))),
        ("scan.npz", _arrays(loop_names=_of(np.array(["hem", "hem"])))),
        ("blendshapes.safetensors", _note("joint_names", to=lambda chance, names: [names[0]] * len(names))),
        ("rig.json", _json("cameras", 1, "name", to=lambda chance, _: "left")),
        ("fisheye.json", _json("cameras", 1, "name", to=lambda chance, _: "left")),
    )),
    Rule("What belongs together fits together", (
        ("body.npz", _arrays(pose_directions=_of(np.zeros((9, 6, 3), np.float32)))),
        ("body.npz", _arrays(joint_directions=_of(np.zeros((3, len(BODY.joints), 3), np.float32)))),
        ("body.npz", _arrays(regions=_of(np.zeros(5, np.uint8)))),
        ("body.npz", _arrays(regions=_of(np.full(6, 9, np.uint8)))),
        ("garment.npz", _arrays(embedding_faces=_of(np.zeros(5, np.int32)))),
        ("garment.npz", _arrays(embedding_faces=lambda chance: None)),
        ("poses.npz", _arrays(translations=_of(POSES.translations[:2]))),
        ("kernel.safetensors", _tensor("middle", lambda chance, array: np.zeros(5, np.float32))),
        ("linear.safetensors", _tensor("coefficient_std", lambda chance, array: np.ones(5, np.float32))),
        ("linear.safetensors", _tensor("control_mean", lambda chance, array: array[:-1])),
        ("blendshapes.safetensors", _tensor("std", lambda chance, array: np.ones(3, np.float32))),
        ("blendshapes.safetensors", _tensor("std", lambda chance, array: -array)),
        ("poses.safetensors", _tensor("largest", lambda chance, array: array[:1])),
        ("poses.safetensors", _tensor("largest", lambda chance, array: -array)),
        ("poses.safetensors", _tensor("linear.largest", lambda chance, array: -array)),
        ("poses.safetensors", _tensor("linear.poses", lambda chance, array: array[:, 0])),
        ("poses.safetensors", _note("length", to=lambda chance, _: chance.choice((-1, True, "2", 1e999)))),
        ("poses.safetensors", _note("validated_deg", to=lambda chance, _: chance.choice((-1, True, "2")))),
        ("poses.safetensors", _note("joints", to=lambda chance, _: chance.choice(([1], [1, 1], [-1, 2])))),
        ("poses.safetensors", _note("controls", to=lambda chance, _: chance.choice((["kernel"], [], ["x"])))),
        ("parameters.npz", _arrays(transl=_of(np.zeros((2, 3))))),
        ("parameters.npz", _arrays(body_pose=_of(np.zeros((3, 62))))),
        ("fisheye.json", _json("cameras", 0, "distortion", to=lambda chance, _: [0.1] * chance.choice((3, 5, 6)))),
    )),
    Rule("JSON says numbers as numbers, finite ones, and a name once", (
        ("rig.json", _json("cameras", 0, "width", to=lambda chance, _: chance.choice((True, "640", 640.5, None)))),
        ("rig.json", _json("cameras", 0, "intrinsics", 0, to=lambda chance, row: [str(row[0]), *row[1:]])),
        ("rig.json", _json("cameras", 0, "intrinsics", 2, to=lambda chance, row: [*row[:2], True])),
        ("rig.json", _json("cameras", 1, "distortion", to=lambda chance, _: [0, 0, 0, 0, chance.choice((_NAN, _INF))])),
        ("rig.json", _swapped(rb'(?s)"height": (480)', b"1e999", b"NaN", b"-Infinity")),
        ("rig.json", _swapped(rb'(?s)("height": 480)', b'"height": 480, "height": 481')),
        ("any.json", _swapped(rb"(2\.5)", b"NaN", b"Infinity", b"1e999")),
        ("any.json", _swapped(rb'(?s)("b":)', b'"a":')),
        ("rows.jsonl", _swapped(rb"(2\.5)", b"NaN", b"-Infinity", b"-1e999")),
        ("capture.json", _swapped(rb'("fps":)', b'"fps": 50, "fps":')),
        ("registration/metrics.jsonl", _swapped(rb'("verdict": "good")', b'"verdict": "bad", "verdict": "good"')),
        ("linear.safetensors", _note("ridge", to=lambda chance, _: chance.choice((True, "0.1")))),
    )),
)  # fmt: skip
