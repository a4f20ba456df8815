"""Which limbs of a body nobody scanned, in words: their pose is no measurement but follows the prior.

A part of a limb counts as scanned if it was seen itself, or if a part farther out was: an upper arm under a sleeve is
known by its forearm. Joints are found by name, anny's or SMPL's.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

__all__ = ["guessed_limbs", "unseen_limbs"]

LIMBS: tuple[tuple[tuple[str, str], ...], ...] = (
    (("head", r"^head"),),
    (
        ("upper arm", r"upperarm|shoulder$"),
        ("forearm", r"lowerarm|elbow"),
        ("hand", r"wrist|hand"),
    ),
    (
        ("thigh", r"upperleg|hip$"),
        ("lower leg", r"lowerleg|knee"),
        ("foot", r"foot|ankle"),
    ),
)
"""The parts of each limb from the trunk outwards, and what their joints are called, in lower case."""
LEG = tuple(part for part, _ in LIMBS[2])
OUT_OF_VIEW = 0.8
"""Legs that so many frames lack are outside of what the rig looks at."""


def unseen_limbs(joint_names: Sequence[str], seen: Bool[np.ndarray, " joints"]) -> tuple[str, ...]:
    """Parts of limbs that were not scanned, such as `left forearm`.

    Args:
        seen: joints whose own part of the body was scanned.
    """
    unseen = []
    for limb in LIMBS:
        for side in ("",) if limb[0][0] == "head" else ("left", "right"):
            known = False
            guessed: list[str] = []
            for part, pattern in reversed(limb):
                joints = [
                    joint
                    for joint, name in enumerate(joint_names)
                    if re.search(pattern, name.lower()) and _side(name) == side
                ]
                known = known or any(seen[joint] for joint in joints)
                if joints and not known:
                    guessed.append(f"{side} {part}".strip())
            unseen += reversed(guessed)
    return tuple(unseen)


def _side(name: str) -> str:
    """left, right, or neither."""
    found = re.search(r"^(left|right)_|\.([lr])$", name.lower())
    return {"l": "left", "r": "right"}[(found[1] or found[2])[0]] if found else ""


def guessed_limbs(unseen: Sequence[Sequence[str]]) -> list[tuple[str, ...]]:
    """Of every frame, the unseen limbs that are a fault of the frame: not legs that hardly any frame of the take shows.

    A rig for shirts sees no feet, which says nothing about a frame; arms and heads belong in every scan.
    """
    counts: dict[str, int] = {}
    for frame in unseen:
        for limb in frame:
            counts[limb] = counts.get(limb, 0) + 1
    outside = {limb for limb, count in counts.items() if limb.endswith(LEG) and count >= OUT_OF_VIEW * len(unseen)}
    return [tuple(limb for limb in frame if limb not in outside) for frame in unseen]
