"""BVH files as tools write them: one clip of one skeleton, under any names, axes, unit, channels and layout."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

SIDES = (("left", 1.0), ("right", -1.0))


def _tree() -> tuple[list[str], list[int], np.ndarray]:
    """An adult in a T-pose, centimetres: part names, parents, offsets."""
    names, parents, offsets = ["pelvis"], [-1], [(0.0, 0.0, 0.0)]

    def add(name: str, parent: str, *offset: float) -> None:
        parents.append(names.index(parent))
        names.append(name)
        offsets.append(offset)  # type: ignore[arg-type]

    for side, x in SIDES:
        add(f"{side}_hip", "pelvis", 9 * x, -8, 0)
        add(f"{side}_knee", f"{side}_hip", 0, -41, 0)
        add(f"{side}_ankle", f"{side}_knee", 0, -42, 0)
        add(f"{side}_foot", f"{side}_ankle", 0, -6, 13)
    for name, parent, *offset in (("spine1", "pelvis", 0, 10, 0), ("spine2", "spine1", 0, 10, 0),
                                  ("spine3", "spine2", 0, 12, 0), ("neck1", "spine3", 0, 14, 0),
                                  ("neck2", "neck1", 0, 5, 0), ("head", "neck2", 0, 5, 1)):  # fmt: skip
        add(name, parent, *offset)
    for side, x in SIDES:
        add(f"{side}_collar", "spine3", 3 * x, 10, 0)
        add(f"{side}_shoulder", f"{side}_collar", 14 * x, 0, 0)
        add(f"{side}_elbow", f"{side}_shoulder", 28 * x, 0, 0)
        add(f"{side}_wrist", f"{side}_elbow", 25 * x, 0, 0)
    return names, parents, np.array(offsets)


@dataclass(frozen=True, eq=False)
class Source:
    """A clip before it is written."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: np.ndarray
    local: np.ndarray
    """(T, J, 3, 3)."""
    places: np.ndarray
    """(T, 3) of the root."""
    own: dict[str, str] = field(default_factory=dict)

    def world(self) -> tuple[np.ndarray, np.ndarray]:
        """World rotations and places, by plain forward kinematics."""
        rotations, places = self.local.copy(), np.zeros((*self.local.shape[:2], 3))
        places[:, 0] = self.places
        for frame in range(len(rotations)):
            for joint, parent in enumerate(self.parents):
                if parent >= 0:
                    places[frame, joint] = places[frame, parent] + rotations[frame, parent] @ self.offsets[joint]
                    rotations[frame, joint] = rotations[frame, parent] @ self.local[frame, joint]
        return rotations, places

    def called(self, name: Callable[[str], str]) -> Source:
        return replace(self, names=tuple(name(part) for part in self.names))

    def in_axes(self, axes: np.ndarray) -> Source:
        """The same motion in a world of other axes, the rest pose with it: `axes` are where ours lie in the file."""
        return replace(
            self, offsets=self.offsets @ axes.T, places=self.places @ axes.T, local=axes @ self.local @ axes.T
        )

    def with_rest(self, turn: np.ndarray) -> Source:
        """The same motion in the same world, of a skeleton that lies otherwise when nothing is turned."""
        local = turn @ self.local @ turn.T
        local[:, 0] = self.local[:, 0] @ turn.T
        return replace(self, offsets=self.offsets @ turn.T, local=local)

    def scaled(self, factor: float) -> Source:
        return replace(self, offsets=self.offsets * factor, places=self.places * factor)

    def below(self, *roots: str) -> Source:
        """Under roots that do not move."""
        count, eye = len(roots), np.eye(3)
        return replace(
            self,
            names=(*roots, *self.names),
            parents=tuple(range(-1, count)) + tuple(parent + count for parent in self.parents[1:]),
            offsets=np.concatenate([np.zeros((count, 3)), self.offsets]),
            local=np.concatenate([np.tile(eye, (len(self.local), count, 1, 1)), self.local], axis=1),
        )


def walk(frames: int = 6, seed: int = 4) -> Source:
    """Bent limbs and trunk, a heading that drifts, and 1.15 m of travel on the built-in body."""
    names, parents, offsets = _tree()
    rng = np.random.default_rng(seed)
    knots = 0.25 * rng.standard_normal((2, len(names), 3))
    at = np.linspace(0, 1, frames)[:, None, None]
    vectors = (1 - at) * knots[0] + at * knots[1]
    for joint, name in enumerate(names):
        if name.endswith("knee"):
            vectors[:, joint] = np.outer(0.3 + 0.5 * at[:, 0, 0], (1, 0, 0))
        if name.endswith("elbow"):
            vectors[:, joint] = np.outer(0.4 + 0.4 * at[:, 0, 0], (0, -1 if name.startswith("left") else 1, 0))
        if name.endswith("ankle"):
            vectors[:, joint] = 0.1 * knots[0, joint]
    vectors[:, 0] = np.outer(at[:, 0, 0], (0.1, 0.9, 0.0))
    local = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, -1, 3, 3)
    places = np.array([0.0, 91.0, 0.0]) + np.outer(at[:, 0, 0], (100.0, 1.0, 50.0))
    return Source(tuple(names), tuple(parents), offsets, local, places)


@dataclass(frozen=True)
class Layout:
    """How the text of a file is laid out."""

    order: str = "ZYX"
    six: bool = False
    """Positions on every joint."""
    on_top: bool = False
    """Those are added to the offsets, not instead of them."""
    zero_offsets: bool = False
    moved: int = 0
    """Which joint carries the travel: the first is 0."""
    end_sites: bool = True
    frame_time: str = "Frame Time: 0.0333333"
    frames: str = "Frames: {count}"
    edit: Callable[[str], str] = str


def text(source: Source, layout: Layout = Layout()) -> str:
    children: list[list[int]] = [[] for _ in source.names]
    for joint, parent in enumerate(source.parents):
        if parent >= 0:
            children[parent].append(joint)
    lines, order, six = ["HIERARCHY"], [], set()

    def describe(joint: int) -> None:
        order.append(joint)
        lines.extend([f"{'JOINT' if joint else 'ROOT'} {source.names[joint]}", "{"])
        offset = np.zeros(3) if layout.zero_offsets else source.offsets[joint]
        lines.append("OFFSET " + " ".join(f"{value:.7f}" for value in offset))
        names = [f"{axis}rotation" for axis in layout.order]
        if layout.six or joint in (0, layout.moved):
            six.add(joint)
            names = ["Xposition", "Yposition", "Zposition", *names]
        lines.append(f"CHANNELS {len(names)} " + " ".join(names))
        for child in children[joint]:
            describe(child)
        if not children[joint] and layout.end_sites:
            lines.extend(["End Site", "{", "OFFSET 0 0.1 0", "}"])
        lines.append("}")

    describe(0)
    count = len(source.local)
    lines.extend(["MOTION", layout.frames.format(count=count), layout.frame_time])
    angles = Rotation.from_matrix(source.local.reshape(-1, 3, 3)).as_euler(layout.order, degrees=True)
    angles = angles.reshape(count, -1, 3)
    for frame in range(count):
        row: list[float] = []
        for joint in order:
            if joint in six:
                there = np.zeros(3) if layout.on_top and joint != layout.moved else source.offsets[joint]
                row.extend(source.places[frame] if joint == layout.moved else there)
            row.extend(angles[frame, joint])
        lines.append(" ".join(f"{value:.8f}" for value in row))
    return layout.edit("\n".join(lines) + "\n")


def names_of(
    trunk: str, leg: str, arm: str, sided: Callable[[str, str], str] = lambda side, word: side.capitalize() + word
) -> Callable[[str], str]:
    """Part -> a tool's name.

    Args:
        trunk: pelvis, three of the spine, two of the neck, head.
        leg: hip, knee, ankle, toes.
        arm: collar, shoulder, elbow, wrist.
    """
    parts: Sequence[str] = ("pelvis", "spine1", "spine2", "spine3", "neck1", "neck2", "head")
    known = dict(zip(parts, trunk.split(), strict=True))
    limbs = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist")
    words = dict(zip(limbs, f"{leg} {arm}".split(), strict=True))

    def name(part: str) -> str:
        if part in known:
            return known[part].replace("~", " ")
        side, _, limb = part.partition("_")
        return sided(side, words[limb]).replace("~", " ")

    return name


def letter(form: str) -> Callable[[str, str], str]:
    """Names with one letter for the side: `{s}_{word}` in lower case, `{S}` in capitals."""
    return lambda side, word: form.format(s=side[0], S=side[0].upper(), word=word)


_HUMANIK = ("UpLeg Leg Foot ToeBase", "Shoulder Arm ForeArm Hand")
TOOLS: dict[str, Callable[[str], str]] = {
    "motionbuilder": names_of("Hips Spine Spine1 Spine2 Neck Neck1 Head", *_HUMANIK),
    "cmu": names_of("Hips LowerBack Spine Spine1 Neck Neck1 Head", *_HUMANIK),
    "cmu, daz": names_of("hip lowerback Chest Chest2 lowerneck Neck Head", "Hip Knee Ankle Toe",
                         "Collar Shoulder Elbow Wrist"),
    "cmu, asf": names_of("root lowerback upperback thorax lowerneck upperneck head", "femur tibia foot toes",
                         "clavicle humerus radius wrist", letter("{s}{word}")),
    "mixamo": names_of("mixamorig:Hips mixamorig:Spine mixamorig:Spine1 mixamorig:Spine2 mixamorig:Neck "
                       "mixamorig:Neck1 mixamorig:Head", *_HUMANIK,
                       lambda side, word: f"mixamorig:{side.capitalize()}{word}"),
    "mixamo 1": names_of("mixamorig1:Hips mixamorig1:Spine mixamorig1:Spine1 mixamorig1:Spine2 mixamorig1:Neck "
                         "mixamorig1:Neck1 mixamorig1:Head", *_HUMANIK,
                         lambda side, word: f"mixamorig1:{side.capitalize()}{word}"),
    "mixamo without colons": names_of("mixamorigHips mixamorigSpine mixamorigSpine1 mixamorigSpine2 mixamorigNeck "
                                      "mixamorigNeck1 mixamorigHead", *_HUMANIK,
                                      lambda side, word: f"mixamorig{side.capitalize()}{word}"),
    "humanik": names_of("Character1_Hips Character1_Spine Character1_Spine1 Character1_Spine2 Character1_Neck "
                        "Character1_Neck1 Character1_Head", *_HUMANIK,
                        lambda side, word: f"Character1_{side.capitalize()}{word}"),
    "motive": names_of("Skeleton_000:Hip Skeleton_000:Ab Skeleton_000:Spine2 Skeleton_000:Chest Skeleton_000:Neck "
                       "Skeleton_000:Neck2 Skeleton_000:Head", "Thigh Shin Foot Toe", "Shoulder UArm FArm Hand",
                       letter("Skeleton_000:{S}{word}")),
    "lafan": names_of("Hips Spine Spine1 Spine2 Neck Neck1 Head", "UpLeg Leg Foot Toe", "Shoulder Arm ForeArm Hand"),
    "rokoko": names_of("Hips Spine1 Spine2 Spine3 Neck Neck2 Head", "Thigh Shin Foot Toe",
                       "Shoulder Arm ForeArm Hand"),
    "xsens": names_of("Pelvis L5 L3 T8 Neck Neck2 Head", "UpperLeg LowerLeg Foot Toe",
                      "Shoulder UpperArm ForeArm Hand"),
    "100style": names_of("Hips Chest Chest2 Chest4 Neck Neck2 Head", "Hip Knee Ankle Toe",
                         "Collar Shoulder Elbow Wrist"),
    "biped": names_of("Bip01~Pelvis Bip01~Spine Bip01~Spine1 Bip01~Spine2 Bip01~Neck Bip01~Neck1 Bip01~Head",
                      "Thigh Calf Foot Toe0", "Clavicle UpperArm Forearm Hand", letter("Bip01~{S}~{word}")),
    "biped 001": names_of("Bip001_Pelvis Bip001_Spine Bip001_Spine1 Bip001_Spine2 Bip001_Neck Bip001_Neck1 "
                          "Bip001_Head", "Thigh Calf Foot Toe0", "Clavicle UpperArm Forearm Hand",
                          letter("Bip001_{S}_{word}")),
    "neuron": names_of("Hips Spine Spine1 Spine3 Neck Neck1 Head", "UpLeg Leg Foot ToeBase",
                       "Shoulder Arm ForeArm Hand"),
    "rigify": names_of("spine spine.001 spine.002 spine.003 spine.004 spine.005 spine.006", "thigh shin foot toe",
                       "shoulder upper_arm forearm hand", letter("{word}.{S}")),
    "rigify, deform": names_of("DEF-spine DEF-spine.001 DEF-spine.002 DEF-spine.003 DEF-spine.004 DEF-spine.005 "
                               "DEF-spine.006", "thigh shin foot toe", "shoulder upper_arm forearm hand",
                               letter("DEF-{word}.{S}")),
    "blender": names_of("Armature|Hips Armature|Spine Armature|Spine1 Armature|Chest Armature|Neck Armature|Neck1 "
                        "Armature|Head", *_HUMANIK, lambda side, word: f"Armature|{side.capitalize()}{word}"),
    "smpl": names_of("pelvis spine1 spine2 spine3 neck neck2 head", "hip knee ankle foot",
                     "collar shoulder elbow wrist", lambda side, word: f"{side}_{word}"),
    "smpl, letters": names_of("Pelvis Spine1 Spine2 Spine3 Neck Neck2 Head", "Hip Knee Ankle Foot",
                              "Collar Shoulder Elbow Wrist", letter("{S}_{word}")),
    "smpl, mujoco": names_of("Pelvis Torso Spine Chest Neck Neck2 Head", "Hip Knee Ankle Toe",
                             "Thorax Shoulder Elbow Hand", letter("{S}_{word}")),
    "unreal": names_of("pelvis spine_01 spine_02 spine_03 neck_01 neck_02 head", "thigh calf foot ball",
                       "clavicle upperarm lowerarm hand", letter("{word}_{s}")),
    "unity": names_of("Hips Spine Chest UpperChest Neck Neck2 Head", "UpperLeg LowerLeg Foot Toes",
                      "Shoulder UpperArm LowerArm Hand"),
    "vrm": names_of("J_Bip_C_Hips J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_UpperChest J_Bip_C_Neck J_Bip_C_Neck2 "
                    "J_Bip_C_Head", "UpperLeg LowerLeg Foot ToeBase", "Shoulder UpperArm LowerArm Hand",
                    letter("J_Bip_{S}_{word}")),
    "bandai": names_of("Hips Spine Spine1 Chest Neck Neck1 Head", "UpperLeg LowerLeg Foot Toes",
                       "Shoulder UpperArm LowerArm Hand", letter("{word}_{S}")),
    "daz": names_of("hip abdomen abdomen2 chest neck neck2 head", "Thigh Shin Foot Toe", "Collar Shldr ForeArm Hand",
                    letter("{s}{word}")),
    "genesis": names_of("hip abdomenLower abdomenUpper chestLower neckLower neckUpper head",
                        "ThighBend Shin Foot Toe", "Collar ShldrBend ForearmBend Hand", letter("{s}{word}")),
    "character creator": names_of("CC_Base_Hip CC_Base_Waist CC_Base_Spine01 CC_Base_Spine02 CC_Base_NeckTwist01 "
                                  "CC_Base_NeckTwist02 CC_Base_Head", "Thigh Calf Foot ToeBase",
                                  "Clavicle Upperarm Forearm Hand", letter("CC_Base_{S}_{word}")),
    "vicon, beat": names_of("Hips Spine Spine1 Spine3 Neck Neck1 Head", "UpLeg Leg Foot ForeFoot",
                            "Shoulder Arm Arm1 Hand", letter("{S}{word}")),
    "theia": names_of("pelvis abdomen abdomen2 torso neck neck2 head", "thigh shank foot toes",
                      "clavicle uarm larm hand", letter("{s}_{word}")),
    "ipi": names_of("Hip LowerSpine MiddleSpine Chest Neck Neck2 Head", "Thigh Shin Foot Toe",
                    "Clavicle Shoulder Forearm Hand", letter("{S}{word}")),
    "advanced skeleton": names_of("Root_M Spine1_M Spine2_M Chest_M Neck_M Neck2_M Head_M", "Hip Knee Ankle Toes",
                                  "Scapula Shoulder Elbow Wrist", letter("{word}_{S}")),
    "kinect": names_of("HipCenter SpineBase SpineMid SpineShoulder Neck Neck2 Head", "Hip Knee Ankle Foot",
                       "Collar Shoulder Elbow Wrist", lambda side, word: word + side.capitalize()),
    "auto-rig": names_of("root.x spine_01.x spine_02.x spine_03.x neck.x neck2.x head.x",
                         "thigh_stretch leg_stretch foot toes_01", "shoulder arm_stretch forearm_stretch hand",
                         letter("{word}.{s}")),
    "valve": names_of("ValveBiped.Bip01_Pelvis ValveBiped.Bip01_Spine ValveBiped.Bip01_Spine1 "
                      "ValveBiped.Bip01_Spine2 ValveBiped.Bip01_Neck1 ValveBiped.Bip01_Neck2 ValveBiped.Bip01_Head1",
                      "Thigh Calf Foot Toe0", "Clavicle UpperArm Forearm Hand",
                      letter("ValveBiped.Bip01_{S}_{word}")),
    "upper case": names_of("HIPS SPINE SPINE1 SPINE2 NECK NECK1 HEAD", "UPLEG LEG FOOT TOEBASE",
                           "SHOULDER ARM FOREARM HAND", lambda side, word: side.upper() + word),
    "snake case": names_of("hips spine spine1 spine2 neck neck1 head", "up_leg leg foot toe_base",
                           "shoulder arm fore_arm hand", lambda side, word: f"{side}_{word}"),
    "mocopi": names_of("root torso_2 torso_4 torso_7 neck_1 neck_2 head", "up_leg low_leg foot toes",
                       "shoulder up_arm low_arm hand", letter("{s}_{word}")),
    "makehuman": names_of("root spine05 spine03 spine01 neck01 neck02 head", "upperleg01 lowerleg01 foot toe1-1",
                          "clavicle upperarm01 lowerarm01 wrist", letter("{word}.{S}")),
    "maya": names_of("hips_jnt spine_01_jnt spine_02_jnt spine_03_jnt neck_01_jnt neck_02_jnt head_jnt",
                     "thigh shin foot toe", "clavicle upperarm forearm hand", letter("{s}_{word}_jnt")),
}  # fmt: skip
