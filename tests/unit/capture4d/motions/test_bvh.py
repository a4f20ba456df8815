"""The text of BVH files: what is one, what is not, and where it stops being one."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.motions.bvh import Bvh, format_bvh, moved_by_root, read_bvh
from capture4d.motions.motion_files import read_motion
from capture4d.types import Body

BVH = """HIERARCHY
ROOT hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  End Site
  {
    OFFSET 0 1 0
  }
}
MOTION
Frames: 1
Frame Time: 0.01
0 0 0 0 0 0
"""


def read(path: Path, text: str | bytes) -> Bvh:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_bvh(path)


@pytest.mark.parametrize(("before", "after", "said"), [
    ("Frames: 1", "Frames: many", "line 12: expected a number of frames, found 'many'"),
    ("Frames: 1", "Frames:", "line 12: expected a number of frames, found ''"),
    ("Frames: 1\n", "", "line 13: expected 'Frames:', found '0 0 0 0 0 0'"),
    ("Frame Time: 0.01\n", "", "line 13: expected 'Frame Time:', found '0 0 0 0 0 0'"),
    ("Time: 0.01", "Time: 0", "line 13: expected a frame time from 1e-05 to 10 seconds, found 0"),
    ("Time: 0.01", "Time: nan", "line 13: expected finite numbers, found nan"),
    ("Time: 0.01", "Time: -0.01", "line 13: expected a frame time from"),
    ("Time: 0.01", "Time: 30", "line 13: expected a frame time from"),
    ("0 0 0 0 0 0\n", "", "expected at least one frame, found none of 1"),
    ("ROOT hips\n{", "{\nROOT hips", "line 2: expected a joint before '{', found none"),
    (BVH[: BVH.index("MOTION")], "HIERARCHY\n", "line 2: expected a joint tree"),
    ("ROOT hips", "ROOT", "line 2: expected the name of a joint, found none"),
    ("Zrotation Xrotation", "Wrotation Xrotation", "line 5: expected channels such as Xposition and"),
    ("CHANNELS 6", "CHANNELS 5", "line 5: expected CHANNELS, their number and as many names"),
    ("CHANNELS 6", "CHANNELS six", "line 5: expected CHANNELS, their number"),
    ("CHANNELS 6", "CHANNELS 999999999999999999", "line 5: expected CHANNELS, their number"),
    ("OFFSET 0 0 0", "OFFSET 0 0", "line 4: expected three numbers as OFFSET, found 2"),
    ("OFFSET 0 0 0", "OFFSET 0 zero 0", "line 4: expected a number, found 'zero'"),
    ("OFFSET 0 0 0", "OFFSET 0 inf 0", "line 4: expected finite numbers, found inf"),
    ("OFFSET 0 0 0", "OFFSET 0 1e999 0", "line 4: expected finite numbers, found 1e999"),
    ("0 0 0 0 0 0", "0 0 0 0 nan 0", "line 14: expected finite numbers, found nan"),
    ("0 0 0 0 0 0", "0 0 0 0 -1.#IND 0", "line 14: expected a number, found '-1.#IND'"),
    ("0 0 0 0 0 0", "0 0 0", "line 14: expected 6 channel values, found 3"),
    ("0 0 0 0 0 0", "0 0 0 0 0 0 0", "line 14: expected 6 channel values, found 7"),
    ("  }\n}\n", "  }\n}\n}\n", "line 11: expected as many '}' as '{', found one more"),
    ("  }\n}\n", "  }\n", "line 10: expected as many '}' as '{', found 1 fewer"),
    ("MOTION", "ROOT other\n{\n}\nMOTION", "line 11: expected one ROOT, found another joint tree"),
    ("  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation\n", "", "expected joints with channels"),
    ("ROOT hips\n{\n", "", "line 2: expected a joint around it, found none"),
    ("MOTION\n", "", "expected a MOTION section, found the end of the file at line 13"),
])  # fmt: skip
def test_what_is_no_bvh_is_named_by_its_line(before: str, after: str, said: str, tmp_path: Path) -> None:
    assert before in BVH
    with pytest.raises(InputError, match=re.escape(said)) as caught:
        read(tmp_path / "clip.bvh", BVH.replace(before, after))
    assert caught.value.where == str(tmp_path / "clip.bvh")


@pytest.mark.parametrize("text", [
    BVH.encode("utf-16"), b"\xef\xbb\xbf" + BVH.encode(), BVH.replace("\n", "\r").encode(),
    BVH.replace("hips", "H\xfcfte").encode("latin1"), BVH.replace("hips", "left hip joint").encode(),
    BVH.replace("  End Site\n  {\n    OFFSET 0 1 0\n  }\n", "").encode(),
    BVH.replace("End Site", "End Site of hips").encode(), BVH.replace("\n", " \n\t").encode(),
    BVH.replace("Zrotation", "Z_rotation").replace("Xposition", "Xtranslation").encode(),
])  # fmt: skip
def test_what_is_one_all_the_same(text: bytes, tmp_path: Path) -> None:
    found = read(tmp_path / "clip.bvh", text)
    assert len(found.joint_names) == 1
    assert len(found.rotations) == 1


@pytest.mark.parametrize(
    "channels",
    ["Zrotation", "Yrotation Xrotation", "Xrotation Yrotation Xrotation", "Xscale Zrotation Yscale",
     "Zrotation Yrotation Xrotation Zrotation"],
)  # fmt: skip
def test_rotations_are_those_of_the_channels_in_their_order(channels: str, tmp_path: Path) -> None:
    words = channels.split()
    values = np.random.default_rng(len(words)).uniform(-170, 170, len(words))
    text = BVH.replace("CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation",
                       f"CHANNELS {len(words)} {channels}")  # fmt: skip
    text = text.replace("0 0 0 0 0 0", " ".join(f"{value}" for value in values))
    expected = np.eye(3)
    for word, value in zip(words, values, strict=True):
        c, s = math.cos(math.radians(value)), math.sin(math.radians(value))
        if word.endswith("rotation"):
            expected = expected @ {"X": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
                                   "Y": np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
                                   "Z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])}[word[0]]  # fmt: skip
    np.testing.assert_allclose(read(tmp_path / "clip.bvh", text).rotations.as_matrix()[0], expected, atol=1e-12)


def test_positions_of_a_part_of_the_axes_leave_the_offset_to_the_others(tmp_path: Path) -> None:
    text = BVH.replace("OFFSET 0 0 0", "OFFSET 1 2 3").replace("6 Xposition Yposition Zposition", "4 Yposition")
    found = read(tmp_path / "clip.bvh", text.replace("0 0 0 0 0 0", "9 0 0 0"))
    np.testing.assert_array_equal(found.translations[0, 0], [1, 9, 3])


def test_what_is_written_is_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    parents = np.array([-1, 0, 1, 1, 0])
    offsets = rng.standard_normal((5, 3))
    offsets[0] = 0
    turns = Rotation.from_rotvec(rng.standard_normal((15, 3)))
    clip = Bvh(Path("x"), tuple("abcde"), parents, offsets, turns, moved_by_root(offsets, rng.random((3, 3))), 0.02)
    found = read(tmp_path / "clip.bvh", format_bvh(clip, np.ones((5, 3))))
    assert found.joint_names == clip.joint_names
    np.testing.assert_allclose(found.rotations.as_matrix(), turns.as_matrix(), atol=1e-7)
    np.testing.assert_allclose(found.translations, clip.translations, atol=1e-6)
    world, local = clip.world_rotations(), turns.as_matrix().reshape(3, 5, 3, 3)
    places = clip.world_places(world)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            np.testing.assert_allclose(world[:, joint], world[:, parent] @ local[:, joint])
            np.testing.assert_allclose(places[:, joint] - places[:, parent], world[:, parent] @ offsets[joint])


# --- hostile ones


def test_deep_wide_and_empty_trees_end_in_one_line(light_body: Body, tmp_path: Path) -> None:
    path = tmp_path / "clip.bvh"
    joint = "{\nOFFSET 0 1 0\nCHANNELS 1 Xrotation\n"
    deep = "ROOT a\n" + joint + ("JOINT b\n" + joint) * 4000 + "}\n" * 4001
    path.write_text(f"HIERARCHY\n{deep}MOTION\nFrames: 1\nFrame Time: 0.1\n" + "0 " * 4001)
    with pytest.raises(InputError, match="found none for left hip"):
        read_motion(path, light_body)
    path.write_text(f"HIERARCHY\n{'ROOT a' + chr(10) + joint + ('JOINT b' + chr(10) + joint) * 5000}")
    with pytest.raises(InputError, match="expected at most 4096 joints, found more"):
        read_bvh(path)
    bare = "ROOT a\n" + joint + "JOINT b\n{\n}\n" * 4000 + "}\n"
    path.write_text(f"HIERARCHY\n{bare}MOTION\nFrames: 1\nFrame Time: 0.1\n" + "0\n" * 20_000)
    with pytest.raises(InputError, match="expected channels for most joints, found 4001 joints, 1 values"):
        read_bvh(path)
    path.write_text("{" * 100_000)
    with pytest.raises(InputError, match="line 1: expected a joint before"):
        read_bvh(path)
    path.write_text(BVH.replace("Frames: 1", "Frames: 999999999999"))
    assert read_bvh(path).notes == ("the file says 999999999999 frames, 1 are there and taken",)


def test_what_a_stranger_calls_a_joint_is_shortened(light_body: Body, tmp_path: Path) -> None:
    path = tmp_path / "clip.bvh"
    path.write_text(BVH.replace("hips", "x" * 100_000))
    with pytest.raises(InputError) as caught:
        read_motion(path, light_body)
    assert len(caught.value.reason) < 1000
