"""Which joint of a skeleton is which part of a person, by the names that animation tools give, and by the joint tree.

Limbs and head are found by name, since nothing else tells left from right. What lies between them is found by the tree:
the pelvis is where the legs meet, the chest where arms and head part, spine and neck are the joints on the way,
however many there are and whatever they are called. Parts are called as SMPL calls its joints.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from capture4d.errors import InputError
from capture4d.files.atomic import read_json
from capture4d.files.reading import shortened
from capture4d.motions.bvh import END_SITE

__all__ = ["NAMINGS", "Anatomy", "bare", "find_anatomy", "named_parts"]

LIMBS = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist")
OPTIONAL = ("foot", "collar")
SIDES = ("left", "right")


@dataclass(frozen=True, slots=True)
class _Scheme:
    """What one family of tools calls the joints of a limb: alternatives, the likelier first, lower case, no side."""

    title: str
    words: tuple[tuple[str, ...], ...]
    """In the order of LIMBS."""


def _scheme(title: str, leg: str, arm: str) -> _Scheme:
    return _Scheme(title, tuple(tuple(part.split("|")) for part in f"{leg} {arm}".split()))


_HUMANIK = _scheme(
    "Mixamo, MotionBuilder, CMU",
    "upleg leg foot toebase|toe|forefoot|toes",
    "shoulder|collar|clavicle arm forearm hand|wrist",
)
_JOINTS = _scheme(
    "SMPL, CMU",
    "hip knee ankle|foot foot|toe|toebase|toes",
    "collar|clavicle|thorax|scapula shoulder elbow wrist|hand",
)
_ROKOKO = _scheme("Rokoko", "thigh shin foot toe|toes|toebase", "shoulder|clavicle arm forearm hand")
_XSENS = _scheme(
    "Xsens", "upperleg lowerleg foot toe|toes|toebase", "shoulder|collar|clavicle upperarm forearm hand|wrist"
)
_UNITY = _scheme(
    "Unity, VRM", "upperleg lowerleg foot toes|toe|toebase", "shoulder|collar|clavicle upperarm lowerarm hand|wrist"
)
_BIPED = _scheme("3ds Max Biped", "thigh calf foot toe0|toe|toebase", "clavicle|shoulder upperarm forearm hand")
_UNREAL = _scheme("Unreal", "thigh calf foot ball|toe", "clavicle|shoulder upperarm lowerarm hand")
_MOTIVE = _scheme("Motive", "thigh shin foot toe", "shoulder|collar uarm|upperarm farm|forearm hand")
_BLENDER = _scheme("Blender Rigify", "thigh shin|calf foot toe|toes", "shoulder|clavicle upperarm forearm hand")
_DAZ = _scheme(
    "Daz, Poser",
    "thigh|thighbend shin foot toe|toes",
    "collar|clavicle shldr|shldrbend|shoulder forearm|forearmbend hand",
)
_BEAT = _scheme("Vicon", "upleg leg foot forefoot|toebase", "shoulder arm arm1 hand")
_ASF = _scheme("CMU's asf", "femur tibia foot toes", "clavicle humerus radius wrist|hand")
_THEIA = _scheme("Theia", "thigh shank foot toes|toe", "clavicle|shoulder uarm larm hand")
_STRETCH = _scheme(
    "Auto-Rig Pro", "thighstretch|thigh legstretch foot toes01", "shoulder armstretch forearmstretch|forearm hand"
)
_MOCOPI = _scheme("mocopi", "upleg lowleg foot toes", "shoulder uparm lowarm hand")
_MAKEHUMAN = _scheme("MakeHuman", "upperleg01 lowerleg01 foot toe11", "clavicle upperarm01 lowerarm01 wrist")

NAMINGS: dict[str, tuple[_Scheme, ...]] = {
    "mixamo": (_HUMANIK,),
    "cmu": (_HUMANIK, _JOINTS, _ASF),
    "lafan": (_HUMANIK,),
    "rokoko": (_ROKOKO, _HUMANIK),
    "xsens": (_XSENS, _HUMANIK, _JOINTS),
    "smpl": (_JOINTS,),
    "biped": (_BIPED,),
    "unreal": (_UNREAL,),
    "unity": (_UNITY,),
    "motive": (_MOTIVE, _HUMANIK),
    "neuron": (_HUMANIK,),
    "blender": (_BLENDER, _STRETCH),
    "daz": (_DAZ,),
    "vicon": (_BEAT, _THEIA, _HUMANIK),
    "mocopi": (_MOCOPI,),
    "makehuman": (_MAKEHUMAN,),
}
"""By the name that an option gives it, which schemes a tool writes; `auto` tries them all."""

_PARTS = {
    "upperleg01": "hip", "lowerleg01": "knee", "clavicle": "collar", "upperarm01": "shoulder", "lowerarm01": "elbow",
    "wrist": "wrist", "root": "pelvis", "spine05": "spine1", "spine03": "spine2", "spine01": "spine3", "neck01": "neck",
    "neck02": "neck2", "head": "head",
}  # fmt: skip
"""What the built-in body calls the parts; `foot` is its ankle."""
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_LABELS = {"jnt", "joint", "bone", "bind", "jt", "bn", "def", "org", "sk", "mixamorig", "bip", "character", "biped"}
"""Words in a name that say nothing of the part."""
_NAME_MOST = 120
"""Letters of a name that are looked at."""
_HEADS = ("head", "skull", "head1", "headc", "headm", "headx", "chead", "mhead")
_TURNING = re.compile(r"twist|roll", re.I)
_SIDE_WORDS = {"left": 0, "l": 0, "lft": 0, "lt": 0, "right": 1, "r": 1, "rgt": 1, "rt": 1}


@dataclass(frozen=True, slots=True)
class Anatomy:
    """Joints by number."""

    limbs: Mapping[str, int]
    """`left_hip`, `right_knee`, ...: all but collars and feet are there."""
    pelvis: int
    spine: tuple[int, ...]
    """From above the pelvis to the chest; nothing where the arms join the pelvis."""
    neck: tuple[int, ...]
    """From above the chest to below the head."""
    head: int
    title: str
    """Whose names they are."""

    @property
    def chest(self) -> int:
        return self.spine[-1] if self.spine else self.pelvis


def bare(name: str) -> str:
    """A joint's name without the namespaces before it: `mixamorig:Hips`, `Armature|Hips`."""
    return re.split(r"[:|]", name)[-1].strip()


def find_anatomy(
    names: Sequence[str], parents: np.ndarray, *, naming: str = "auto", given: Mapping[str, str] | None = None
) -> Anatomy:
    """Tell the parts of a skeleton.

    Args:
        parents: of each joint, -1 for the root.
        naming: one of NAMINGS, or `auto`.
        given: part -> the joint's name, which goes before what is found.
    Raises:
        InputError: a part is not there; names it, and what it would be called.
    """
    tree = _Tree(names, [int(parent) for parent in parents])
    fixed = {} if given is None else {part: tree.joint_called(name, part) for part, name in given.items()}
    schemes = _ALL if naming == "auto" else NAMINGS[naming]
    best = min((_Trial(each, tree, fixed) for each in schemes), key=lambda trial: trial.rank)
    if best.lacking and naming == "auto" and not (mixed := _Trial(_MIXED, tree, fixed, close=True)).lacking:
        best = mixed
    if best.lacking:
        raise InputError(_said_of(best, naming, names))
    limbs = best.limbs
    head = fixed.get("head", tree.head(limbs))
    if head is None:
        raise InputError(f"expected a joint called Head, found {_some(names)}; a file for --names may give it")
    pelvis = fixed.get("pelvis", tree.meeting(limbs["left_hip"], limbs["right_hip"]))
    if pelvis is None or tree.meeting(pelvis, limbs["left_shoulder"], limbs["right_shoulder"], head) is None:
        raise InputError("expected legs, arms and head in one joint tree, found them in several")
    spine, neck = _trunk(tree, fixed, limbs, pelvis, head)
    return Anatomy(limbs, pelvis, spine, neck, head, best.scheme.title)


def _trunk(
    tree: _Tree, fixed: Mapping[str, int], limbs: Mapping[str, int], pelvis: int, head: int
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    arms = [limbs.get(f"{side}_collar", limbs[f"{side}_shoulder"]) for side in SIDES]
    chest = tree.meeting(*arms, head)
    assert chest is not None
    # A head below an arm, or the like, is no trunk: arms that hang on the neck leave it out of the spine.
    below = {*tree.way_up(pelvis)}
    spine = [joint for joint in tree.way_up(chest) if joint not in below][::-1]
    neck = [joint for joint in tree.way_up(head)[1:] if joint not in below.union(spine)][::-1]
    given = [fixed[part] for part in ("spine1", "spine2", "spine3") if part in fixed]
    given_neck = [fixed[part] for part in ("neck", "neck2") if part in fixed]
    return tuple(given or spine), tuple(given_neck or neck)


class _Tree:
    """Joint names with their sides, and who hangs on whom."""

    def __init__(self, names: Sequence[str], parents: list[int]) -> None:
        self.names, self.parents = names, parents
        self._ways: dict[int, list[int]] = {}
        self._ends = [joint for joint, name in enumerate(names) if name == END_SITE]
        words = _without_common_prefix([_without_labels(_WORD.findall(bare(name)[:_NAME_MOST])) for name in names])
        self.sided: dict[tuple[int, str], list[int]] = {}
        """(side, what is left of the name) -> joints."""
        self.unsided: dict[str, list[int]] = {}
        for joint, each in enumerate(words):
            for reading in _readings(each):
                self.sided.setdefault(reading, []).append(joint)
            self.unsided.setdefault("".join(each).lower(), []).append(joint)

    def way_up(self, joint: int) -> list[int]:
        """The joint, its parent, and so on up to the root."""
        if joint not in self._ways:
            way = [joint]
            while (parent := self.parents[way[-1]]) >= 0:
                way.append(parent)
            self._ways[joint] = way
        return self._ways[joint]

    def meeting(self, *joints: int) -> int | None:
        """The lowest joint that all of them hang on, or are."""
        shared = set.intersection(*({*self.way_up(joint)} for joint in joints))
        return next((joint for joint in self.way_up(joints[0]) if joint in shared), None)

    def head(self, limbs: Mapping[str, int]) -> int | None:
        """By its name; of rigs that count on (spine.004, spine.005), the last of the neck."""
        for word in _HEADS:
            if word in self.unsided:
                return self.unsided[word][0]
        chest = self.meeting(limbs["left_shoulder"], limbs["right_shoulder"])
        counted = [j for word, js in self.unsided.items() if re.match("neck|spine", word) for j in js]
        above = [joint for joint in counted if chest in self.way_up(joint)[1:]]
        return max(above, key=lambda joint: len(self.way_up(joint)), default=None)

    def ends_of(self, joint: int) -> list[int]:
        """End sites that are taken as joints."""
        return [end for end in self._ends if self.parents[end] == joint]

    def joint_called(self, name: str, part: str) -> int:
        exact = [joint for joint, each in enumerate(self.names) if each == name]
        loose = [joint for joint, each in enumerate(self.names) if bare(each).lower() == bare(name).lower()]
        found = exact or loose
        if len(found) != 1:
            many = "none" if not found else f"{len(found)}"
            raise InputError(f"expected one joint called '{shortened(name, 80)}' for {part}, found {many}")
        return found[0]


def _without_labels(words: list[str]) -> list[str]:
    while len(words) > 1 and words[0].lower() in _LABELS:
        words = words[1:]
        while len(words) > 1 and words[0].isdecimal():
            words = words[1:]
    while len(words) > 1 and words[-1].lower() in _LABELS:
        words = words[:-1]
    return words


def _without_common_prefix(names: list[list[str]]) -> list[list[str]]:
    """Leave out the first word while most joints begin with it: Bip01, CC_Base, mixamorig, DEF."""
    while True:
        firsts = Counter(words[0].lower() for words in names if len(words) > 1)
        most = max(((count, word) for word, count in firsts.items() if word not in _SIDE_WORDS), default=(0, ""))
        if most[0] * 3 < 2 * len(names) or len(names) < 4:
            return names
        names = [words[1:] if len(words) > 1 and words[0].lower() == most[1] else words for words in names]


def _readings(words: list[str]) -> list[tuple[int, str]]:
    """Side and the rest, in all the ways that a name can be read."""
    lower = [word.lower() for word in words]
    sides = [at for at, word in enumerate(lower) if word in _SIDE_WORDS]
    if sides:
        at = sides[0]
        return [(_SIDE_WORDS[lower[at]], "".join(lower[:at] + lower[at + 1 :]))]
    together = "".join(lower)
    for side, word in enumerate(SIDES):
        if word in together:
            return [(side, together.replace(word, "", 1))]
    found = []
    for side, letter in enumerate("lr"):
        if together.startswith(letter):
            found.append((side, together[1:]))
        if together.endswith(letter):
            found.append((side, together[:-1]))
    return found


class _Trial:
    """The limbs that a skeleton has under one scheme."""

    def __init__(self, scheme: _Scheme, tree: _Tree, fixed: Mapping[str, int], *, close: bool = False) -> None:
        """`close`: nothing but twist joints may lie between two joints of a limb."""
        self.scheme, self._close = scheme, close
        self.limbs: dict[str, int] = {}
        self.lacking: list[str] = []
        for number, side in enumerate(SIDES):
            for slots in (range(4), range(4, 8)):
                self._limb(tree, fixed, number, side, [*slots])

    @property
    def rank(self) -> tuple[int, int]:
        return len(self.lacking), -len(self.limbs)

    def _limb(self, tree: _Tree, fixed: Mapping[str, int], number: int, side: str, slots: list[int]) -> None:
        choices: list[list[int | None]] = []
        for slot in slots:
            part = f"{side}_{LIMBS[slot]}"
            found = [joint for word in self.scheme.words[slot] for joint in tree.sided.get((number, word), [])]
            if LIMBS[slot] == "hip":  # some have a joint on the way to it, the hip joint
                found.sort(key=lambda joint: -len(tree.way_up(joint)))
            joints = [fixed[part]] if part in fixed else [*dict.fromkeys(found)][:6]
            if not joints and LIMBS[slot] in ("ankle", "wrist"):  # bones whose end is no joint
                joints = [end for above in choices[-1] if above is not None for end in tree.ends_of(above)]
            if not joints and LIMBS[slot] not in OPTIONAL:
                self.lacking.append(part)
            may_lack = part not in fixed and (LIMBS[slot] in OPTIONAL or not joints)
            choices.append([*joints, *[None] * may_lack])
        for chain in itertools.product(*choices):
            if self._hangs_together(tree, [joint for joint in chain if joint is not None]):
                self.limbs |= {
                    f"{side}_{LIMBS[slot]}": j for slot, j in zip(slots, chain, strict=True) if j is not None
                }
                return
        self.lacking.extend(f"{side}_{LIMBS[slot]}" for slot in slots if LIMBS[slot] not in OPTIONAL)

    def _hangs_together(self, tree: _Tree, chain: list[int]) -> bool:
        for above, below in itertools.pairwise(chain):
            way = tree.way_up(below)[1:]
            if above not in way:
                return False
            if self._close and not all(_TURNING.search(tree.names[joint]) for joint in way[: way.index(above)]):
                return False
        return True


_ALL = tuple(dict.fromkeys(scheme for schemes in NAMINGS.values() for scheme in schemes))
_MIXED = _Scheme("several tools", tuple(tuple(dict.fromkeys(itertools.chain.from_iterable(each)))
                                        for each in zip(*(scheme.words for scheme in _ALL), strict=True)))  # fmt: skip


def _said_of(trial: _Trial, naming: str, names: Sequence[str]) -> str:
    parts: dict[str, tuple[str, ...]] = dict(zip(LIMBS, trial.scheme.words, strict=True))
    wanted = [f"{part} ({parts[part.split('_')[1]][0]})".replace("_", " ") for part in dict.fromkeys(trial.lacking)]
    whose = trial.scheme.title if naming != "auto" else f"{trial.scheme.title}, which are nearest"
    return (f"expected joints named as those of {whose}, found none for {', '.join(wanted[:4])} "
            f"among {_some(names)}; --names takes a JSON file that tells them")  # fmt: skip


def _some(names: Iterable[str]) -> str:
    listed = [shortened(name, 40) for name in names]
    return ", ".join(listed[:6]) + (f" and {len(listed) - 6} others" if len(listed) > 6 else "")


def named_parts(path: Path) -> dict[str, str]:
    """Part -> joint of the file, from a JSON file that maps joints of SMPL or of the built-in body.

    Raises:
        InputError: no such file, no JSON object of names, or a joint that no body here has.
    """
    found = read_json(path, expected="a JSON object, our joint: their joint")
    parts = {}
    for ours, theirs in found.items():
        if not isinstance(theirs, str):
            raise InputError(f"expected the name of a joint for '{shortened(ours, 80)}'", where=path)
        parts[_part(ours, path)] = theirs
    return parts


def _part(ours: str, path: Path) -> str:
    lower = ours.strip().lower()
    trunk = ("pelvis", "spine1", "spine2", "spine3", "neck", "neck2", "head")
    if lower in (*trunk, *(f"{side}_{limb}" for side in SIDES for limb in LIMBS)):
        return lower
    stem, _, side = lower.partition(".")
    if stem == "foot" and side in ("l", "r"):
        return f"{SIDES['lr'.index(side)]}_ankle"
    part = _PARTS.get(stem)
    if part in (*trunk,) and not side:
        return str(part)
    if part is not None and side in ("l", "r"):
        return f"{SIDES['lr'.index(side)]}_{part}"
    raise InputError(f"expected joints of SMPL or of the built-in body, found '{shortened(ours, 80)}'", where=path)
