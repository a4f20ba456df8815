"""BVH motion files, in and out: a joint tree with offsets, then a line of channel values a frame.

Angles are in degrees and in the order of each joint's channels; positions have no unit (write: centimetres).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.files.reading import one_line, reading

__all__ = ["Bvh", "format_bvh", "read_bvh"]

CHANNELS = {f"{axis}{kind}" for axis in "XYZ" for kind in ("position", "rotation")}


@dataclass(frozen=True, slots=True, eq=False)
class Bvh:
    """One clip as its file has it."""

    path: Path
    joint_names: tuple[str, ...]
    parents: np.ndarray
    """(J,) int, -1 for the root."""
    offsets: np.ndarray
    """(J, 3) from the parent, in the file's unit."""
    rotations: Rotation
    """(T * J) local rotations, frame by frame."""
    root_positions: np.ndarray
    """(T, 3) in the file's unit."""
    frame_time_s: float

    def world_rotations(self) -> np.ndarray:
        """(T, J, 3, 3) down the joint tree."""
        local = self.rotations.as_matrix().reshape(-1, len(self.joint_names), 3, 3)
        world = local.copy()
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                world[:, joint] = world[:, parent] @ local[:, joint]
        return world


def read_bvh(path: Path) -> Bvh:
    """Read a BVH file.

    Raises:
        InputError: missing file, or a line that does not fit the format; names file and line.
    """
    with reading(path, "BVH file", absent="no such BVH file"):
        return _parsed(path, path.read_text(encoding="utf-8", errors="replace").splitlines())


def _parsed(path: Path, lines: list[str]) -> Bvh:
    tree, motion_at = _joint_tree(lines)
    width = sum(len(each) for each in tree.channels)
    number = motion_at + 1
    rows = []
    try:
        count = int(lines[motion_at].split(":")[1])
        if count < 1:
            raise InputError(f"expected at least one frame, found {count}")
        number = motion_at + 2
        frame_time = float(lines[motion_at + 1].split(":")[1])
        if not 0 < frame_time < np.inf:
            raise InputError(f"expected a positive frame time, found {frame_time:g}")
        for number in range(motion_at + 3, motion_at + 3 + count):
            row = [float(word) for word in lines[number - 1].split()]
            if len(row) != width:
                raise InputError(f"expected {width} channel values, found {len(row)}")
            rows.append(row)
    except (ValueError, IndexError) as error:
        raise _at_line(number, error) from None
    values = np.array(rows)
    if not np.isfinite(values).all() or not np.isfinite(tree.offsets).all():
        raise InputError("expected finite channel values and offsets, found NaN or infinity")
    local, column, positions = [], 0, np.zeros((count, 3))
    for joint, each in enumerate(tree.channels):
        block = dict(zip(each, values[:, column : column + len(each)].T, strict=True))
        column += len(each)
        order = "".join(name[0] for name in each if name.endswith("rotation"))
        angles = np.stack([block[f"{axis}rotation"] for axis in order], axis=1) if order else np.zeros((count, 3))
        local.append(Rotation.from_euler(order or "XYZ", angles, degrees=True).as_quat())
        if joint == 0 and all(f"{axis}position" in block for axis in "XYZ"):
            positions = np.stack([block[f"{axis}position"] for axis in "XYZ"], axis=1)
    rotations = Rotation.from_quat(np.stack(local, axis=1).reshape(-1, 4))
    return Bvh(
        path, tuple(tree.names), np.array(tree.parents), np.array(tree.offsets), rotations, positions, frame_time
    )


@dataclass(slots=True, eq=False)
class _Tree:
    """The joints as they are met, each after its parent."""

    names: list[str]
    parents: list[int]
    offsets: list[tuple[float, ...]]
    channels: list[list[str]]


def _joint_tree(lines: list[str]) -> tuple[_Tree, int]:
    """The joints, and the number of the line that ends them."""
    tree, stack = _Tree([], [], [], []), []
    number, in_end_site, pending = 0, False, None
    try:
        for number, line in enumerate(lines, start=1):
            words = line.split()
            match words[0] if words else "":
                case "ROOT" | "JOINT":
                    tree.names.append(words[1])
                    tree.parents.append(stack[-1] if stack else -1)
                    tree.offsets.append((0.0, 0.0, 0.0))
                    tree.channels.append([])
                    pending = len(tree.names) - 1
                case "End":
                    in_end_site, pending = True, -1
                case "{":
                    if pending is None:
                        raise ValueError("a brace before the first joint")
                    stack.append(pending)
                case "}":
                    in_end_site = False
                    stack.pop()
                case "OFFSET" if not in_end_site:
                    x, y, z = (float(word) for word in words[1:4])
                    tree.offsets[stack[-1]] = (x, y, z)
                case "CHANNELS":
                    tree.channels[stack[-1]] = words[2 : 2 + int(words[1])]
                    if not set(tree.channels[stack[-1]]) <= CHANNELS:
                        raise ValueError(f"expected channels {', '.join(sorted(CHANNELS))}")
                case "MOTION":
                    if not tree.names:
                        raise InputError("expected a joint tree, found a MOTION section without one")
                    return tree, number
    except (ValueError, IndexError) as error:
        raise _at_line(number, error) from None
    raise InputError(f"expected a MOTION section, found the end of the file at line {number}")


def _at_line(number: int, error: Exception) -> InputError:
    said = error.reason if isinstance(error, InputError) else f"not a BVH file, or cut short ({one_line(error)})"
    return InputError(f"line {number}: {said}")


def format_bvh(motion: Bvh, end_offsets: Float[np.ndarray, "joints 3"]) -> str:
    """A clip as the text of a file: root with six channels, other joints with three, all Z Y X.

    Args:
        end_offsets: where the end site of a joint without children lies, in the file's unit; others are not read.
    """
    children: list[list[int]] = [[] for _ in motion.joint_names]
    for joint, parent in enumerate(motion.parents):
        if parent >= 0:
            children[parent].append(joint)
    lines, order = ["HIERARCHY"], []

    def describe(joint: int, depth: int) -> None:
        indent, inner = "\t" * depth, "\t" * (depth + 1)
        order.append(joint)
        positions = "6 Xposition Yposition Zposition" if depth == 0 else "3"
        lines.append(f"{indent}{'JOINT' if depth else 'ROOT'} {motion.joint_names[joint]}")
        lines.append(f"{indent}{{")
        lines.append(f"{inner}OFFSET {_numbers(motion.offsets[joint])}")
        lines.append(f"{inner}CHANNELS {positions} Zrotation Yrotation Xrotation")
        for child in children[joint]:
            describe(child, depth + 1)
        if not children[joint]:
            lines.extend(
                [f"{inner}End Site", f"{inner}{{", f"{inner}\tOFFSET {_numbers(end_offsets[joint])}", f"{inner}}}"]
            )
        lines.append(f"{indent}}}")

    describe(0, 0)
    angles = motion.rotations.as_euler("ZYX", degrees=True).reshape(-1, len(motion.joint_names), 3)
    lines.extend(["MOTION", f"Frames: {len(angles)}", f"Frame Time: {motion.frame_time_s:.9f}"])
    for position, frame in zip(motion.root_positions, angles, strict=True):
        lines.append(_numbers(np.concatenate([position, frame[order].ravel()])))
    return "\n".join(lines) + "\n"


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in values)
