"""Joints of a skeleton as parts of a person: what a name says, and what the tree does."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from capture4d.motions.anatomy import NAMINGS, bare, find_anatomy
from tests.bvh_files import TOOLS, walk

BASE = walk(2)


def without(names: tuple[str, ...], dropped: set[str]) -> tuple[list[str], np.ndarray]:
    """A skeleton without some joints, whose children hang on what these hung on."""
    kept = [joint for joint, name in enumerate(BASE.names) if name not in dropped]

    def parent(joint: int) -> int:
        above = BASE.parents[joint]
        return parent(above) if above >= 0 and above not in kept else above

    parents = [parent(joint) for joint in kept]
    return [names[joint] for joint in kept], np.array([kept.index(p) if p >= 0 else -1 for p in parents])


NECKLESS = {"spine1", "spine2", "neck1", "neck2"}
DROPPED = (set(), {"left_foot", "right_foot"}, {"left_collar", "right_collar"}, NECKLESS)
CASES = [
    (tool, dropped)
    for tool in TOOLS
    for dropped in DROPPED
    # a rig that counts its spine on calls no joint the head: without a neck there is nothing to find it by
    if dropped is not NECKLESS or not TOOLS[tool]("head").endswith(".006")
]


@pytest.mark.parametrize(("tool", "dropped"), CASES)
def test_every_part_is_found_where_it_is(tool: str, dropped: set[str]) -> None:
    """Without toes, without collars, with one spine joint and no neck: the other parts stay what they are."""
    names, parents = without(tuple(map(TOOLS[tool], BASE.names)), dropped)
    kept = [part for part in BASE.names if part not in dropped]
    found = find_anatomy(names, parents)
    here = {part: kept.index(part) for part in kept}
    assert {part: joint for part, joint in found.limbs.items() if not part.endswith(("foot", "collar"))} == {
        part: joint
        for part, joint in here.items()
        if part.endswith(("hip", "knee", "ankle", "shoulder", "elbow", "wrist"))
    }
    for part in ("left_collar", "right_collar", "left_foot", "right_foot"):
        assert found.limbs.get(part) in (here.get(part), None)
    assert (found.pelvis, found.head) == (here["pelvis"], here["head"])
    assert found.spine == tuple(here[part] for part in ("spine1", "spine2", "spine3") if part in here)
    assert found.neck == tuple(here[part] for part in ("neck1", "neck2") if part in here)


def test_joints_may_stand_in_any_order_that_keeps_parents_first() -> None:
    names = list(map(TOOLS["cmu"], BASE.names))
    expected = find_anatomy(names, np.array(BASE.parents))
    rng = np.random.default_rng(0)
    for _ in range(20):
        order = [0]
        while len(order) < len(names):
            ready = [joint for joint in range(len(names)) if joint not in order and BASE.parents[joint] in order]
            order.append(int(rng.choice(ready)))
        parents = np.array([order.index(BASE.parents[joint]) if joint else -1 for joint in order])
        found = find_anatomy([names[joint] for joint in order], parents)
        assert {part: order[joint] for part, joint in found.limbs.items()} == expected.limbs
        assert tuple(order[joint] for joint in found.spine) == expected.spine


def test_two_of_a_kind_are_told_apart_by_the_tree() -> None:
    """A left hand that is a prop, under the root; and two skeletons in one tree, of which the first is taken."""
    names = [*map(TOOLS["cmu"], BASE.names), "LeftHand", "LeftLeg"]
    found = find_anatomy(names, np.array([*BASE.parents, 0, len(BASE.names)]))
    assert found.limbs["left_wrist"] == BASE.names.index("left_wrist")
    count = len(BASE.names)
    both = ["World", *(f"{who}:{name}" for who, name in itertools.product("AB", names[:count]))]
    parents = [-1, *(p + 1 for p in BASE.parents), *(p + 1 + count if p >= 0 else 0 for p in BASE.parents)]
    parents[1] = 0
    found = find_anatomy(both, np.array(parents))
    assert max(found.limbs.values()) <= count


def test_a_name_without_its_namespaces() -> None:
    assert [bare(name) for name in ("mixamorig:Hips", "a:b:Hips", "Armature|Hips", "Hips")] == ["Hips"] * 4


def test_the_page_lists_every_naming() -> None:
    page = (Path(__file__).parents[4] / "docs" / "how-to" / "bring-motion.md").read_text()
    assert [naming for naming in NAMINGS if f"`{naming}`" not in page] == []
