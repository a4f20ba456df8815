"""One clip, as many tools write it, moves the body the same way: names, axes, units, channels, layout."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.errors import InputError
from capture4d.motions.anatomy import NAMINGS
from capture4d.motions.bvh import read_bvh
from capture4d.motions.clips import MotionWords, understood
from capture4d.motions.motion_files import read_motion
from capture4d.types import Body
from tests.bvh_files import TOOLS, Layout, Source, letter, names_of, text, walk

BASE = walk()
CMU = BASE.called(TOOLS["cmu"])
TURNS = Rotation.create_group("O").as_matrix().round()
MILLIMETRE = 1e-3


@pytest.fixture
def expected(placed) -> np.ndarray:
    return placed(text(CMU))


def apart(here: np.ndarray, there: np.ndarray) -> float:
    return float(np.linalg.norm(here - there, axis=2).max())


def apart_but_for_heading(here: np.ndarray, there: np.ndarray) -> float:
    """After the turn about Y, and the shift along the floor, that bring one onto the other."""
    flat, onto = (each - each[:, :1].mean(axis=0) * (1, 0, 1) for each in (here, there))
    crossed = np.cross(flat.reshape(-1, 3) * (1, 0, 1), onto.reshape(-1, 3) * (1, 0, 1))[:, 1].sum()
    dotted = (flat * onto)[..., [0, 2]].sum()
    turn = Rotation.from_euler("y", np.arctan2(crossed, dotted)).as_matrix()
    return apart(flat @ turn.T, onto)


def test_the_base_clip_points_its_limbs_where_its_own_kinematics_do(light_body: Body, expected: np.ndarray) -> None:
    _, places = BASE.world()
    at, theirs = light_body.joint_names.index, BASE.names.index
    for side, letter_ in (("left", "L"), ("right", "R")):
        for start, end, ours, our_end in (
            ("hip", "knee", "upperleg01", "lowerleg01"), ("knee", "ankle", "lowerleg01", "foot"),
            ("shoulder", "elbow", "upperarm01", "lowerarm01"), ("elbow", "wrist", "lowerarm01", "wrist"),
        ):  # fmt: skip
            here = expected[:, at(f"{our_end}.{letter_}")] - expected[:, at(f"{ours}.{letter_}")]
            there = places[:, theirs(f"{side}_{end}")] - places[:, theirs(f"{side}_{start}")]
            cosine = (here * there).sum(axis=1) / np.linalg.norm(here, axis=1) / np.linalg.norm(there, axis=1)
            assert np.degrees(np.arccos(cosine.clip(-1, 1))).max() < 0.5
    assert np.linalg.norm(expected[-1, 0] - expected[0, 0]) == pytest.approx(1.152, abs=0.002)


@pytest.mark.parametrize("tool", TOOLS)
def test_names_of(tool: str, placed, expected: np.ndarray) -> None:
    assert apart(placed(text(BASE.called(TOOLS[tool]))), expected) < MILLIMETRE


@pytest.mark.parametrize("turn", range(24))
def test_a_file_with_other_axes(turn: int, placed, expected: np.ndarray) -> None:
    assert apart(placed(text(CMU.in_axes(TURNS[turn]))), expected) < MILLIMETRE


@pytest.mark.parametrize("turn", range(24))
@pytest.mark.filterwarnings("ignore:Gimbal lock")
def test_a_skeleton_that_lies_otherwise_at_rest(turn: int, placed, expected: np.ndarray) -> None:
    """As Blender writes armatures that it has turned: the root stands them up in every frame."""
    assert apart(placed(text(CMU.with_rest(TURNS[turn]))), expected) < MILLIMETRE


@pytest.mark.parametrize("turn", range(24))
@pytest.mark.filterwarnings("ignore:Gimbal lock")
def test_both_keep_all_but_the_heading(turn: int, placed, expected: np.ndarray) -> None:
    for other in (3, 8, 13, 22):
        found = placed(text(CMU.with_rest(TURNS[turn]).in_axes(TURNS[other])))
        assert apart_but_for_heading(found, expected) < MILLIMETRE


@pytest.mark.parametrize("turn", [(0, 20, 0), (0, 45, 0), (90, 30, 0), (35, 50, 70), (0, 170, 10)])
def test_a_skeleton_at_rest_off_all_axes(turn: tuple[float, float, float], placed, expected: np.ndarray) -> None:
    """Which way is up at rest is then known by a fraction of a degree: the head of this one lies a little in front."""
    turned = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    assert apart(placed(text(CMU.with_rest(turned))), expected) < 0.01


@pytest.mark.parametrize("lean", [-12.0, 8.0])
def test_a_trunk_that_leans_at_rest_is_still_upright(lean: float, placed, expected: np.ndarray) -> None:
    """Offsets that lean are how a skeleton is built, and no turn of it."""
    offsets = CMU.offsets.copy()
    spine = [joint for joint, name in enumerate(BASE.names) if name in ("spine1", "spine2", "spine3", "neck1")]
    offsets[spine] = offsets[spine] @ Rotation.from_euler("x", lean, degrees=True).as_matrix().T
    found = placed(text(replace(CMU, offsets=offsets)))
    assert apart(found - found[:, :1], expected - expected[:, :1]) < MILLIMETRE


@pytest.mark.parametrize("words", [{"up": "z"}, {"up": "z", "facing": "-y"}, {"facing": "-y"}])
def test_axes_may_be_said(words: dict[str, Any], placed, expected: np.ndarray) -> None:
    axes = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    assert apart(placed(text(CMU.in_axes(axes)), words=MotionWords(**words)), expected) < MILLIMETRE


def test_what_is_said_goes_before_what_is_found(placed, expected: np.ndarray) -> None:
    lying = placed(text(CMU), words=MotionWords(up="z"))
    quarter = Rotation.from_euler("x", -90, degrees=True).as_matrix()
    turned = expected @ quarter.T
    assert apart(lying - lying[:1, :1], turned - turned[:1, :1]) < MILLIMETRE
    with pytest.raises(InputError, match="--facing: expected an axis across that of --up, found -z and z"):
        MotionWords(up="z", facing="-z")
    with pytest.raises(
        InputError, match=r"clip\.bvh: --facing: expected an axis across the one that is up, Y, found y"
    ):
        placed(text(CMU), words=MotionWords(facing="y"))


@pytest.mark.parametrize(("factor", "unit"), [
    (1.0, "centimetres"), (0.01, "metres"), (10.0, "millimetres"), (1 / 2.54, "inches"), (0.1, "decimetres"),
    (1 / 30.48, "feet"), (0.17, "a unit of its own"),
])  # fmt: skip
def test_any_unit(factor: float, unit: str, placed, expected: np.ndarray) -> None:
    notes: list[str] = []
    assert apart(placed(text(CMU.scaled(factor)), say=notes.append), expected) < MILLIMETRE
    assert unit in notes[0]


@pytest.mark.filterwarnings("ignore:Gimbal lock")
@pytest.mark.parametrize("order", ["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX", "ZXZ", "XYX", "YZY"])
def test_any_order_of_rotations(order: str, placed, expected: np.ndarray) -> None:
    assert apart(placed(text(CMU, Layout(order=order))), expected) < MILLIMETRE


LAYOUTS = {
    "six channels on every joint": Layout(six=True),
    "offsets of zero": Layout(six=True, zero_offsets=True),
    "positions on top of offsets": Layout(six=True, on_top=True),
    "no end sites": Layout(end_sites=False),
    "lower case": Layout(edit=str.lower),
    "upper case": Layout(edit=str.upper),
    "tabs": Layout(edit=lambda said: said.replace(" ", "\t")),
    "indented with tabs": Layout(edit=lambda said: said.replace("\n", "\n\t\t")),
    "carriage returns": Layout(edit=lambda said: said.replace("\n", "\r\n")),
    "a byte order mark": Layout(edit=lambda said: "\ufeff" + said),
    "blank lines": Layout(edit=lambda said: said.replace("\n", "\n\n")),
    "braces beside names": Layout(edit=lambda said: said.replace("\n{", " {")),
    "channels beside offsets": Layout(edit=lambda said: said.replace("\nCHANNELS", " CHANNELS")),
    "Frames without a colon": Layout(frames="Frames {count}"),
    "Frames with spaces": Layout(frames="FRAMES :\t{count}  "),
    "a frame time without spaces": Layout(frame_time="FrameTime:0.0333333"),
    "decimal commas": Layout(edit=lambda said: said.replace(".", ",")),
    "exponents": Layout(frame_time="Frame Time: 3.33333e-02"),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_any_layout(layout: str, placed, expected: np.ndarray) -> None:
    assert apart(placed(text(CMU, LAYOUTS[layout])), expected) < MILLIMETRE


@pytest.mark.parametrize("roots", [("Reference",), ("Armature", "Root"), ("Scene", "Bip01", "COM", "Root")])
@pytest.mark.parametrize("carries", ["hips", "root"])
def test_roots_above_the_hips(roots: tuple[str, ...], carries: str, placed, expected: np.ndarray) -> None:
    moved = len(roots) if carries == "hips" else 0
    assert apart(placed(text(CMU.below(*roots), Layout(moved=moved))), expected) < MILLIMETRE


def test_a_root_that_turns_and_moves_takes_the_body_along(placed, expected: np.ndarray) -> None:
    """Half of the heading and of the travel in a root above the hips."""
    rooted = CMU.below("Reference")
    half = Rotation.from_euler("y", np.linspace(0, 60, len(BASE.local))[:, None], degrees=True).as_matrix()
    local = rooted.local.copy()
    local[:, 0], local[:, 1] = half, np.swapaxes(half, 1, 2) @ rooted.local[:, 1]
    shared = np.einsum("tba,tb->ta", half, BASE.places * (0.4, 1.0, 0.4))
    said = text(replace(rooted, local=local, places=shared), Layout(moved=1)).splitlines()
    start = said.index("Frame Time: 0.0333333") + 1
    for frame, line in enumerate(said[start:]):
        words = line.split()
        words[:3] = [f"{value:.8f}" for value in BASE.places[frame] * (0.6, 0.0, 0.6)]
        said[start + frame] = " ".join(words)
    assert apart(placed("\n".join(said)), expected) < MILLIMETRE


def test_twist_joints_and_fingers_are_passed_over(placed, expected: np.ndarray) -> None:
    """A twist joint between shoulder and elbow, and joints that are called nearly like parts."""
    source = BASE.called(TOOLS["unreal"])
    at = source.names.index("lowerarm_l")
    names = list(source.names)
    names.extend(["hand_l_end", "thigh_twist_01_l", "ik_hand_l", "thumb_01_l"])
    parents = [*source.parents, source.names.index("hand_l"), source.names.index("thigh_l"), 0, at]
    extra = np.random.default_rng(0).standard_normal((4, 3))
    turned = Rotation.random(4 * len(source.local), rng=0).as_matrix().reshape(-1, 4, 3, 3)
    more = replace(
        source, names=tuple(names), parents=tuple(parents), offsets=np.concatenate([source.offsets, extra]),
        local=np.concatenate([source.local, turned], axis=1),
    )  # fmt: skip
    assert apart(placed(text(more)), expected) < MILLIMETRE


def without_ends(source: Source, parts: set[str]) -> tuple[Source, dict[str, np.ndarray]]:
    """A skeleton without its last joints, and where these were from the ones before."""
    dropped = {joint for joint, part in enumerate(BASE.names) if part in parts}
    kept = [joint for joint in range(len(BASE.names)) if joint not in dropped]
    parents = tuple(kept.index(parent) if (parent := source.parents[joint]) >= 0 else -1 for joint in kept)
    ends = {source.names[source.parents[joint]]: source.offsets[joint] for joint in dropped}
    names = tuple(source.names[joint] for joint in kept)
    return replace(source, names=names, parents=parents, offsets=source.offsets[kept],
                   local=source.local[:, kept]), ends  # fmt: skip


@pytest.mark.parametrize("limbs", [{"wrist"}, {"wrist", "foot", "ankle"}])
@pytest.mark.parametrize("tool", ["cmu", "unreal", "daz", "smpl"])
def test_hands_and_feet_that_are_no_joints(tool: str, limbs: set[str], light_body: Body, placed, expected) -> None:
    """Where forearm and shin end in an end site."""
    parts = {f"{side}_{limb}" for side in ("left", "right") for limb in limbs}
    source, ends = without_ends(BASE.called(TOOLS[tool]), parts)
    lines = text(source).splitlines()
    for joint, end in ends.items():
        at = next((n for n, line in enumerate(lines) if line == f"JOINT {joint}"), None)
        if at is not None:
            at = lines.index("OFFSET 0 0.1 0", at)
            lines[at] = "OFFSET " + " ".join(map(str, end))
    found = placed("\n".join(lines))
    kept = [joint for joint, name in enumerate(light_body.joint_names) if not name.startswith(("wrist", "lowerarm02"))]
    assert apart(found[:, kept] - found[:, :1], expected[:, kept] - expected[:, :1]) < MILLIMETRE


# --- what is doubtful, and what cannot be


def test_who_lies_is_left_lying(placed) -> None:
    """All the clip on a floor of which Y is up: the rest pose stands, so the world is not turned."""
    down = Rotation.from_euler("x", -80, degrees=True).as_matrix()
    local = CMU.local.copy()
    local[:, 0] = down
    notes: list[str] = []
    found = placed(text(replace(CMU, local=local, places=CMU.places - (0, 76, 0))), say=notes.append)
    trunk = found[:, 17] - found[:, 0]
    assert np.abs(trunk[:, 1]).max() < 0.5 * np.linalg.norm(trunk, axis=1).min()
    assert "--up says which it is" in notes[-1]


def test_a_handstand_stays_one(light_body: Body, placed) -> None:
    local = CMU.local.copy()
    local[:, 0] = Rotation.from_euler("x", 180, degrees=True).as_matrix()
    found = placed(text(replace(CMU, local=local)))
    at = light_body.joint_names.index
    assert (found[:, at("head"), 1] < found[:, at("foot.L"), 1]).all()


def test_what_the_file_says_wrongly_of_itself_is_told(placed, expected: np.ndarray) -> None:
    for claimed in ("5", "9", "0"):
        notes: list[str] = []
        found = placed(text(CMU, Layout(frames=f"Frames: {claimed}")), say=notes.append)
        assert apart(found, expected) < MILLIMETRE
        assert notes[0] == f"the file says {claimed} frames, 6 are there and taken"


NAMINGS_OF = {"mixamo": "mixamo", "cmu": "cmu, daz", "lafan": "lafan", "rokoko": "rokoko", "smpl": "smpl",
              "biped": "biped", "unreal": "unreal", "xsens": "xsens", "motive": "motive",
              "vicon": "vicon, beat"}  # fmt: skip


@pytest.mark.parametrize("naming", NAMINGS_OF)
def test_a_naming_may_be_said(naming: str, placed, expected: np.ndarray) -> None:
    said = text(BASE.called(TOOLS[NAMINGS_OF[naming]]))
    assert naming in NAMINGS
    assert apart(placed(said, words=MotionWords(names=naming)), expected) < MILLIMETRE


def test_another_naming_than_is_said_is_refused(placed) -> None:
    with pytest.raises(
        InputError, match=r"clip\.bvh: expected joints named as those of Unreal, found none for left hip"
    ):
        placed(text(CMU), words=MotionWords(names="unreal"))


def test_joints_may_be_given(placed, expected: np.ndarray) -> None:
    strange = BASE.called(lambda part: f"q{BASE.names.index(part)}")
    with pytest.raises(InputError, match="--names takes a JSON file"):
        placed(text(strange))
    parts = [part for part in BASE.names if not part.endswith("foot") and part[:5] not in ("spine", "neck1", "neck2")]
    given = {part: f"q{BASE.names.index(part)}" for part in parts}
    assert apart(placed(text(strange), words=MotionWords(given=given)), expected) < MILLIMETRE
    with pytest.raises(InputError, match="expected one joint called 'q99' for head, found none"):
        placed(text(strange), words=MotionWords(given={**given, "head": "q99"}))


def test_a_limb_with_a_strange_joint_in_it_is_not_guessed(placed) -> None:
    strange = CMU.called(lambda name: "Tentacle" if name == "LeftArm" else name)
    with pytest.raises(InputError, match=r"found none for left shoulder \(arm\)"):
        placed(text(strange))


@pytest.mark.parametrize(("change", "said"), [
    (lambda source: replace(source, offsets=0 * source.offsets), "expected hips and head apart at rest"),
    (lambda source: source.called(lambda name: name.replace("Head", "Top").replace("Neck", "Rod")),
     "expected a joint called Head"),
    (lambda source: source.called(lambda name: name.replace("Left", "Right")), "found none for left hip"),
])  # fmt: skip
def test_what_is_no_person_is_one_line(change, said: str, placed) -> None:
    with pytest.raises(InputError, match=said) as caught:
        placed(text(change(CMU)))
    assert str(caught.value.where).endswith("clip.bvh")


def test_an_smpl_body_is_moved_by_any_skeleton(smpl_like: Body, tmp_path: Path) -> None:
    from tests.unit.capture4d.motions.conftest import joints_of

    (tmp_path / "clip.bvh").write_text(text(CMU))
    found = joints_of(smpl_like, read_motion(tmp_path / "clip.bvh", smpl_like))
    _, places = BASE.world()
    at = smpl_like.joint_names.index
    for start, end in (("left_hip", "left_knee"), ("right_elbow", "right_wrist")):
        here = found[:, at(end)] - found[:, at(start)]
        there = places[:, BASE.names.index(end)] - places[:, BASE.names.index(start)]
        cosine = (here * there).sum(axis=1) / np.linalg.norm(here, axis=1) / np.linalg.norm(there, axis=1)
        assert cosine.min() > np.cos(np.radians(0.5))


# --- spines and necks of any number of joints


def with_trunk(spine: int, neck: int) -> Source:
    """One bend of 60 degrees and one turn of 30, shared out evenly over a spine and a neck of so many joints."""
    names, parents, offsets, turns = ["Hips"], [-1], [(0.0, 0.0, 0.0)], [(0.0, 0.0, 0.0)]

    def chain(parent: int, stems: list[str], step: tuple[float, float, float], turn: tuple[float, float, float]) -> int:
        for stem in stems:
            names.append(stem)
            parents.append(parent)
            offsets.append(step)
            turns.append(turn)
            parent = len(names) - 1
        return parent

    bent = np.radians(60) / max(spine, 1)
    chest = chain(0, [f"Vertebra{n}" for n in range(spine)], (0, 45 / max(spine, 1), 0), (bent, 0, 0))
    turned = np.radians(30) / (neck + 1)
    throat = chain(chest, [f"Cervical{n}" for n in range(neck)], (0, 24 / (neck + 1), 0), (0, turned, 0))
    chain(throat, ["Head"], (0, 10, 0), (0, turned, 0))
    for side, x in (("Left", 1), ("Right", -1)):
        last = 0
        for stem, step in (("UpLeg", (9 * x, -8, 0)), ("Leg", (0, -41, 0)), ("Foot", (0, -42, 0))):
            last = chain(last, [side + stem], step, (0, 0, 0))
        last = chest
        for stem, step in (("Shoulder", (3 * x, 10, 0)), ("Arm", (14 * x, 0, 0)), ("ForeArm", (28 * x, 0, 0)),
                           ("Hand", (25 * x, 0, 0))):  # fmt: skip
            last = chain(last, [side + stem], step, (0, 0, 0))
    local = Rotation.from_rotvec(np.array(turns)).as_matrix()
    return Source(tuple(names), tuple(parents), np.array(offsets, float), np.tile(local, (2, 1, 1, 1)),
                  np.tile([0, 91.0, 0], (2, 1)))  # fmt: skip


@pytest.mark.parametrize(("spine", "neck"), [(1, 0), (1, 1), (2, 1), (3, 2), (4, 1), (5, 3), (7, 2)])
def test_a_spine_of_any_number_is_shared_out(spine: int, neck: int, light_body: Body, tmp_path: Path) -> None:
    (tmp_path / "clip.bvh").write_text(text(with_trunk(spine, neck)))
    poses = read_motion(tmp_path / "clip.bvh", light_body)
    world, degrees = poses.rotations[0].astype(float), {}
    for joint, name in enumerate(light_body.joint_names):
        degrees[name] = np.degrees(Rotation.from_matrix(world[joint]).magnitude())
        if (parent := light_body.parents[joint]) >= 0:
            world[joint] = world[parent] @ world[joint]
    chest = world[light_body.joint_names.index("spine01")]
    head = chest.T @ world[light_body.joint_names.index("head")]
    np.testing.assert_allclose(chest, Rotation.from_euler("x", 60, degrees=True).as_matrix(), atol=1e-4)
    np.testing.assert_allclose(head, Rotation.from_euler("y", 30, degrees=True).as_matrix(), atol=1e-4)
    assert max(degrees[f"spine0{n}"] for n in range(1, 6)) < 20.1
    assert max(degrees["neck01"], degrees["neck02"], degrees["head"]) < 15.1


# --- bones that all lie along one axis when nothing is turned


def along_one_axis(source: Source, roll: dict[str, float]) -> Source:
    """The same motion, of a skeleton whose limbs point up at rest, each rolled about itself: as LAFAN1 has them."""
    count = len(source.names)
    rest = np.tile(np.eye(3), (count, 1, 1))  # the joint's frame in the one it had
    for joint, part in enumerate(BASE.names):
        limb = part.partition("_")[2]
        if limb not in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist", "collar"):
            continue
        ends = [child for child, parent in enumerate(source.parents) if parent == joint]
        bone = source.offsets[ends[0]] if ends else source.offsets[joint]
        across = np.array([1.0, 0, 0]) if limb in ("hip", "knee", "ankle") else np.array([0.0, 0, 1.0])
        first = bone / np.linalg.norm(bone)
        frame = np.stack([np.cross(first, across), first, across], axis=1)
        rest[joint] = frame @ Rotation.from_euler("y", roll.get(limb, 0.0), degrees=True).as_matrix()
    return with_axes(source, rest)


@pytest.mark.parametrize("roll", [{}, {"hip": 90.0, "knee": 90.0}, {"hip": 180.0, "knee": 180.0, "elbow": 40.0},
                                  {"shoulder": -90.0, "elbow": -90.0, "ankle": 20.0}])  # fmt: skip
def test_limbs_that_point_up_at_rest(roll: dict[str, float], light_body: Body, placed, tmp_path: Path) -> None:
    turned = along_one_axis(CMU, roll)
    _, places = turned.world()
    np.testing.assert_allclose(places, CMU.world()[1], atol=1e-9)
    found = placed(text(turned))
    moved = read_motion(tmp_path / "clip.bvh", light_body)
    (tmp_path / "plain.bvh").write_text(text(CMU))
    plain = read_motion(tmp_path / "plain.bvh", light_body)
    expected = placed(text(CMU))
    kept = [joint for joint, name in enumerate(light_body.joint_names)
            if name.startswith(("root", "spine", "upper", "lower", "neck", "head"))]  # fmt: skip
    assert apart(found[:, kept] - found[:, :1], expected[:, kept] - expected[:, :1]) < 0.002
    # Bones point the same way whatever their roll; that thighs and arms are not twisted shows in their own turns.
    for name in ("upperleg01.L", "upperleg01.R", "upperarm01.L", "lowerarm01.R"):
        joint = light_body.joint_names.index(name)
        turn = np.swapaxes(world_of(light_body, moved)[:, joint], 1, 2) @ world_of(light_body, plain)[:, joint]
        assert np.degrees(Rotation.from_matrix(turn).magnitude()).max() < 5, name


RIGHT = Rotation.from_euler("z", 90, degrees=True).as_matrix()
TWIST = Rotation.from_euler("y", 90, degrees=True).as_matrix()
TRUNK = ("spine1", "spine2", "spine3", "neck1", "neck2", "head")


@pytest.mark.parametrize(
    "rest",
    [
        dict.fromkeys(TRUNK, RIGHT),  # along X from the spine up, under a pelvis of the world's axes
        dict.fromkeys(TRUNK[:3], RIGHT),
        dict.fromkeys(TRUNK[1:], RIGHT @ TWIST),
        {"spine3": TWIST},
        {"head": RIGHT},
        {"head": TWIST @ RIGHT},
    ],
)
def test_joints_of_the_trunk_with_axes_of_their_own(rest: dict[str, np.ndarray], light_body: Body, tmp_path) -> None:
    turned = with_axes(CMU, np.stack([rest.get(part, np.eye(3)) for part in BASE.names]))
    np.testing.assert_allclose(turned.world()[1], CMU.world()[1], atol=1e-9)
    worlds = []
    for name, source in (("turned", turned), ("plain", CMU)):
        (tmp_path / f"{name}.bvh").write_text(text(source))
        worlds.append(world_of(light_body, read_motion(tmp_path / f"{name}.bvh", light_body)))
    for joint, name in enumerate(light_body.joint_names):
        if name.startswith(("root", "spine", "upper", "lower", "neck", "head")):
            turn = np.swapaxes(worlds[0][:, joint], 1, 2) @ worlds[1][:, joint]
            limit = 5 if name.startswith(("upper", "lower")) else 0.1  # legs that point aside at rest: by their knees
            assert np.degrees(Rotation.from_matrix(turn).magnitude()).max() < limit, name


def test_a_head_of_any_axes_looks_where_the_neck_does(light_body: Body, tmp_path: Path) -> None:
    """On average, when nothing else tells."""
    rest = np.tile(np.eye(3), (len(BASE.names), 1, 1))
    rest[BASE.names.index("head")] = Rotation.from_rotvec([1.0, -1.2, 0.7]).as_matrix()
    (tmp_path / "clip.bvh").write_text(text(with_axes(CMU, rest)))
    world = world_of(light_body, read_motion(tmp_path / "clip.bvh", light_body))
    neck, head = (light_body.joint_names.index(name) for name in ("neck02", "head"))
    local = np.swapaxes(world[:, neck], 1, 2) @ world[:, head]
    assert np.degrees(Rotation.from_matrix(local).mean().magnitude()) < 1


def with_axes(source: Source, rest: np.ndarray) -> Source:
    """The same motion, of a skeleton whose joints have the axes `rest` (J, 3, 3) in those that they had."""
    world = source.world()[0] @ rest
    local, offsets = world.copy(), source.offsets.copy()
    for joint, parent in enumerate(source.parents):
        if parent >= 0:
            local[:, joint] = np.swapaxes(world[:, parent], 1, 2) @ world[:, joint]
            offsets[joint] = rest[parent].T @ source.offsets[joint]
    return replace(source, local=local, offsets=offsets)


def test_y_up_of_a_skeleton_that_stands_otherwise_is_told(placed) -> None:
    """Who lies along Y on a floor of which Z is up looks the same, so it is said which was taken."""
    down = Rotation.from_euler("x", -90, degrees=True).as_matrix()
    local = CMU.local.copy()
    local[:, 0] = down
    notes: list[str] = []
    lying = replace(CMU, local=local, places=np.tile((0.0, 13.0, 0.0), (len(local), 1)))
    placed(text(lying.in_axes(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))), say=notes.append)
    assert "Y up, as heads stand, though at rest they stand along Z; --up says which it is" in notes


def world_of(body: Body, poses) -> np.ndarray:
    world = poses.rotations.astype(float)
    for joint, parent in enumerate(body.parents):
        if parent >= 0:
            world[:, joint] = world[:, parent] @ world[:, joint]
    return world


def test_sides_by_one_letter_in_front(tmp_path: Path) -> None:
    """`lUpArm` and `rUpArm`, of which no table knows: taken together from what several tools say."""
    mixed = BASE.called(names_of("Root Low Mid High Nape Nape2 Head", "Thigh Knee Foot Ball",
                                 "Clavicle UpperArm Elbow Hand", letter("{s}{word}")))  # fmt: skip
    (tmp_path / "clip.bvh").write_text(text(mixed))
    clip, notes = understood(read_bvh(tmp_path / "clip.bvh"))
    assert clip.anatomy.limbs["right_elbow"] == mixed.names.index("rElbow")
    assert "several tools" in notes[0]
