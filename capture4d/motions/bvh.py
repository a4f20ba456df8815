"""BVH motion files, in and out: a joint tree with offsets, then a line of channel values a frame.

Angles are in degrees and in the order of each joint's channels; positions have no unit (write: centimetres). The format
has no standard, so what exporters differ in is taken as each means it: letter case, blank lines, a name of several
words, channels of any number and order, translations of any joint, a number of frames that is not true.
"""

from __future__ import annotations

import codecs
import contextlib
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.files.reading import reading, shortened

__all__ = ["END_SITE", "Bvh", "format_bvh", "moved_by_root", "read_bvh"]

_CHANNEL = re.compile(r"([xyz])[_ ]?(position|translation|pos|rotation|rot|scale|scaling)")
_KINDS = {"position": "p", "translation": "p", "pos": "p", "rotation": "r", "rot": "r", "scale": "s", "scaling": "s"}
_COUNT, _TIME = re.compile(r"frames?\s*[:=\s]\s*(.*)", re.I), re.compile(r"frame\s*time\s*[:=\s]\s*(.*)", re.I)
_JOINTS_MOST = 4096
"""A hand has 20 and a face 60; nobody has thousands."""
_TIME_RANGE_S = (1e-5, 10.0)


END_SITE = "End Site"
"""What an end site is called where it is taken as a joint."""


@dataclass(frozen=True, slots=True, eq=False)
class Bvh:
    """One clip as its file has it."""

    path: Path
    joint_names: tuple[str, ...]
    parents: np.ndarray
    """(J,) int, -1 for the root; parents come before their children."""
    offsets: np.ndarray
    """(J, 3) from the parent at rest, in the file's unit."""
    rotations: Rotation
    """(T * J) local rotations, frame by frame."""
    translations: np.ndarray
    """(T, J, 3) from the parent in each frame, in the file's unit; the root's is its position."""
    frame_time_s: float
    notes: tuple[str, ...] = ()
    """What in the file was not as it says of itself."""
    ends: tuple[tuple[int, tuple[float, ...]], ...] = ()
    """Where bones without a joint at their end end: joint, offset from it."""

    def with_ends(self) -> Bvh:
        """The same clip with a joint at each of these ends."""
        if not self.ends:
            return self
        owners, offsets = [joint for joint, _ in self.ends], np.array([offset for _, offset in self.ends])
        count, frames = len(owners), len(self.translations)
        local = self.rotations.as_quat().reshape(frames, -1, 4)
        still = np.tile([0.0, 0.0, 0.0, 1.0], (frames, count, 1))
        return replace(
            self,
            joint_names=(*self.joint_names, *[END_SITE] * count),
            parents=np.concatenate([self.parents, owners]),
            offsets=np.concatenate([self.offsets, offsets]),
            rotations=Rotation.from_quat(np.concatenate([local, still], axis=1).reshape(-1, 4)),
            translations=np.concatenate([self.translations, np.tile(offsets, (frames, 1, 1))], axis=1),
            ends=(),
        )

    def world_rotations(self) -> np.ndarray:
        """(T, J, 3, 3) down the joint tree."""
        world = self.rotations.as_matrix().reshape(-1, len(self.joint_names), 3, 3)
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                world[:, joint] = world[:, parent] @ world[:, joint]
        return world

    def world_places(self, world_rotations: np.ndarray) -> np.ndarray:
        """(T, J, 3): where the joints are."""
        places = np.array(self.translations, np.float64)
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                turned = np.einsum("tab,tb->ta", world_rotations[:, parent], self.translations[:, joint])
                places[:, joint] = places[:, parent] + turned
        return places

    def rest_places(self) -> np.ndarray:
        """(J, 3): where the joints are when nothing is turned, the root at the origin."""
        places = np.zeros_like(self.offsets)
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                places[joint] = places[parent] + self.offsets[joint]
        return places


def moved_by_root(offsets: Float[np.ndarray, "joints 3"], places: Float[np.ndarray, "frames 3"]) -> np.ndarray:
    """Translations of a clip in which the root alone is moved, (T, J, 3)."""
    translations = np.tile(offsets, (len(places), 1, 1)).astype(np.float64)
    translations[:, 0] = places
    return translations


def read_bvh(path: Path) -> Bvh:
    """Read a BVH file.

    Raises:
        InputError: missing file, or a line that does not fit the format; names file and line.
    """
    with reading(path, "BVH file", absent="no such BVH file"):
        return _parsed(path, _text(path.read_bytes()).splitlines())


def _text(data: bytes) -> str:
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace")
    return data.decode("utf-8-sig", errors="replace")


def _parsed(path: Path, lines: list[str]) -> Bvh:
    tree, motion_at = _joint_tree(lines)
    values, frame_time, notes = _motion(lines, motion_at, sum(len(each) for each in tree.channels))
    if len(values) * len(tree.names) > 4 * values.size + 1_000_000:
        raise InputError(f"expected channels for most joints, found {len(tree.names)} joints, {values.shape[1]} values")
    count, columns = len(values), iter(values.T)
    local, translations = [], np.tile(np.array(tree.offsets), (count, 1, 1))
    moved: list[int] = []
    for joint, channels in enumerate(tree.channels):
        rotation = Rotation.identity(count)
        for (axis, kind), column in zip(channels, columns, strict=False):
            if kind == "r":
                rotation = rotation * Rotation.from_euler(axis, column[:, None], degrees=True)
            elif kind == "p":
                translations[:, joint, "xyz".index(axis)] = column
        if any(kind == "p" for _, kind in channels):
            moved.append(joint)
        local.append(rotation.as_quat())
    offsets = np.array(tree.offsets)
    _settle(moved, offsets, translations)
    return Bvh(
        path,
        tuple(tree.names),
        np.array(tree.parents),
        offsets,
        Rotation.from_quat(np.stack(local, axis=1).reshape(-1, 4)),
        translations,
        frame_time,
        tuple(notes),
        tuple(tree.ends.items()),
    )


def _settle(moved: Sequence[int], offsets: np.ndarray, translations: np.ndarray) -> None:
    """Take translations of joints below the root as their exporter means them: instead of the offset, or on top of it.

    A joint that is on its way moves away from both, so all of them decide together. Where they stand instead of it,
    the joint's rest offset is where it mostly is: exporters that write them tend to leave the offset at zero.
    """
    below = [joint for joint in moved if joint > 0]
    if not below:
        return
    usual = np.median(translations[:, below], axis=0)
    on_top = np.linalg.norm(usual, axis=1).sum() < np.linalg.norm(usual - offsets[below], axis=1).sum()
    if on_top:
        translations[:, below] += offsets[below]
    offsets[below] = np.median(translations[:, below], axis=0)


# --- the joint tree ----------------------------------------------------------------------------------------------


@dataclass(slots=True, eq=False)
class _Tree:
    """The joints as they are met, each after its parent."""

    names: list[str]
    parents: list[int]
    offsets: list[tuple[float, ...]]
    channels: list[list[tuple[str, str]]]
    """Axis and kind (position, rotation, scale) of each."""
    ends: dict[int, tuple[float, ...]] = field(default_factory=dict)
    """Joint -> where its end site is from it."""

    def add(self, name: str, parent: int) -> int:
        if not name:
            raise InputError("expected the name of a joint, found none")
        if len(self.names) == _JOINTS_MOST:
            raise InputError(f"expected at most {_JOINTS_MOST} joints, found more")
        self.names.append(name)
        self.parents.append(parent)
        self.offsets.append((0.0, 0.0, 0.0))
        self.channels.append([])
        return len(self.names) - 1


_END = -2
"""In place of a joint's number: an end site."""


def _joint_tree(lines: list[str]) -> tuple[_Tree, int]:
    """The joints, and the number of the line that ends them."""
    tree, stack, pending = _Tree([], [], [], []), [], None
    number = 0
    for number, line in enumerate(lines, start=1):
        try:
            for words in _statements(line):
                match words[0].lower():
                    case "motion":
                        _require_whole(tree, stack)
                        return tree, number
                    case "root" | "joint":
                        if not stack and tree.names:
                            raise InputError("expected one ROOT, found another joint tree")
                        pending = tree.add(" ".join(words[1:]), stack[-1] if stack else -1)
                    case "end":
                        pending = _END
                    case "{":
                        if pending is None:
                            raise InputError("expected a joint before '{', found none")
                        stack.append(pending)
                        pending = None
                    case "}":
                        if not stack:
                            raise InputError("expected as many '}' as '{', found one more")
                        stack.pop()
                    case "offset":
                        if _inside(stack) != _END:
                            tree.offsets[stack[-1]] = _offset(words)
                        elif len(stack) > 1:
                            with contextlib.suppress(InputError):  # few files need it
                                tree.ends[stack[-2]] = _offset(words)
                    case "channels" if _inside(stack) != _END:
                        tree.channels[stack[-1]] = _channels(words)
        except InputError as error:
            raise _at_line(number, error.reason) from None
    raise InputError(f"expected a MOTION section, found the end of the file at line {number}")


def _statements(line: str) -> Iterator[list[str]]:
    """What stands in a line: words, with each brace by itself, and CHANNELS apart from an OFFSET before it."""
    # A joint may be called anything, so a keyword inside a line counts only where no name can stand.
    for part in re.split(r"([{}])", line):
        words = part.split()
        if words and words[0].lower() == "offset" and "channels" in (lower := [word.lower() for word in words]):
            at = lower.index("channels")
            yield words[:at]
            words = words[at:]
        if words:
            yield words


def _inside(stack: list[int]) -> int:
    if not stack:
        raise InputError("expected a joint around it, found none")
    return stack[-1]


def _require_whole(tree: _Tree, stack: list[int]) -> None:
    if not tree.names:
        raise InputError("expected a joint tree, found a MOTION section without one")
    if stack:
        raise InputError(f"expected as many '}}' as '{{', found {len(stack)} fewer")
    if not any(tree.channels):
        raise InputError("expected joints with channels, found none")


def _offset(words: list[str]) -> tuple[float, ...]:
    if len(words) != 4:
        raise InputError(f"expected three numbers as OFFSET, found {len(words) - 1}")
    x, y, z = (_number(word) for word in words[1:])
    return x, y, z


def _channels(words: list[str]) -> list[tuple[str, str]]:
    count = int(words[1]) if len(words) > 1 and words[1].isdecimal() and len(words[1]) < 4 else -1
    if len(words) - 2 != count:
        raise InputError("expected CHANNELS, their number and as many names, "
                         f"found '{shortened(' '.join(words), 80)}'")  # fmt: skip
    found = []
    for word in words[2:]:
        parts = _CHANNEL.fullmatch(word.lower())
        if parts is None:
            raise InputError(f"expected channels such as Xposition and Zrotation, found '{shortened(word, 80)}'")
        found.append((parts[1], _KINDS[parts[2]]))
    return found


def _number(word: str) -> float:
    """A number that is one; with a decimal comma too, as some systems write."""
    try:
        value = float(word.replace(",", ".") if word.count(",") == 1 else word)
    except ValueError:
        raise InputError(f"expected a number, found '{shortened(word, 80)}'") from None
    if not math.isfinite(value):
        raise InputError(f"expected finite numbers, found {shortened(word, 80)}")
    return value


def _at_line(number: int, reason: str) -> InputError:
    return InputError(f"line {number}: {reason}")


# --- the motion --------------------------------------------------------------------------------------------------


def _motion(lines: list[str], motion_at: int, width: int) -> tuple[np.ndarray, float, list[str]]:
    """The channel values, (T, C); seconds from one frame to the next; what is not as the file says."""
    following = ((number, line.strip()) for number, line in enumerate(lines[motion_at:], motion_at + 1) if line.strip())
    claimed, frame_time = None, None
    rows: list[list[float]] = []
    number = motion_at
    for number, line in following:
        try:
            if claimed is None or frame_time is None:
                if (said := _TIME.fullmatch(line)) is not None:
                    frame_time = _frame_time(said[1])
                elif (said := _COUNT.fullmatch(line)) is not None:
                    claimed = _claimed(said[1])
                else:
                    lacking = "Frames:" if claimed is None else "Frame Time:"
                    raise InputError(f"expected '{lacking}', found '{shortened(line, 80)}'")
                continue
            words = line.split()
            if len(words) != width:
                raise InputError(f"expected {width} channel values, found {len(words)}")
            rows.append(_row(words))
        except InputError as error:
            raise _at_line(number, error.reason) from None
    if claimed is None or frame_time is None:
        raise InputError(f"expected the number of frames and their time, found the end of the file at line {number}")
    if not rows:
        raise InputError(f"expected at least one frame, found none of {claimed}")
    notes = [] if claimed == len(rows) else [f"the file says {claimed} frames, {len(rows)} are there and taken"]
    return np.array(rows), frame_time, notes


def _row(words: list[str]) -> list[float]:
    try:
        row = [float(word) for word in words]
    except ValueError:
        return [_number(word) for word in words]
    return row if math.isfinite(sum(row)) else [_number(word) for word in words]


def _claimed(text: str) -> int:
    if not re.fullmatch(r"[-+]?\d{1,12}(\.0*)?", text):
        raise InputError(f"expected a number of frames, found '{shortened(text, 80)}'")
    return int(float(text))


def _frame_time(text: str) -> float:
    value = _number(text)
    least, most = _TIME_RANGE_S
    if not least <= value <= most:
        raise InputError(f"expected a frame time from {least:g} to {most:g} seconds, found {value:g}")
    return value


# --- out ---------------------------------------------------------------------------------------------------------


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
    for position, frame in zip(motion.translations[:, 0], angles, strict=True):
        lines.append(_numbers(np.concatenate([position, frame[order].ravel()])))
    return "\n".join(lines) + "\n"


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in values)
