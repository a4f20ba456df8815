"""Whatever was done to a file of any kind: its value, or one line that names it; no warning, and little memory.

The kinds, and what is done to them, are those of `python -m benchmarks readers`, which does it by the thousand in a
process that may die of it, `--endless` until it is interrupted.
"""

import dataclasses
import io
import json
import random
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.reader_damage import ARRAY_CHANGES, JSON_VALUES, NUMBERS, WORDS, damaged, mutant, with_arrays
from benchmarks.reader_judge import nonsense_in
from benchmarks.reader_kinds import BY_NAME, KINDS, Kind, fault_of, laid_out, whole
from benchmarks.reader_rules import RULES
from benchmarks.reader_values import GARMENT, POSES
from benchmarks.reader_worker import LONGEST, MEMORY


def value_or_one_line(kind: Kind, files: dict[str, bytes]) -> str:
    """Read a file; what is said of it, nothing if it has a value that makes sense."""
    with laid_out(files, kind.name) as path:
        tracemalloc.start()
        try:
            value, fault = fault_of(kind, path)
        finally:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        assert peak < MEMORY
        if fault is None:
            assert nonsense_in(value) == ""
            return ""
        assert fault.where is not None, fault
        assert Path(fault.where).is_relative_to(path.parents[kind.name.count("/")])
    assert "\n" not in str(fault)
    assert len(fault.reason) < LONGEST
    return str(fault)


@pytest.mark.parametrize("name", BY_NAME)
def test_a_whole_file_has_a_value(name: str) -> None:
    assert (value_or_one_line(BY_NAME[name], whole(name)) == "") != BY_NAME[name].refused


@pytest.mark.parametrize("name", BY_NAME)
def test_a_missing_file_is_named(name: str) -> None:
    files = {file: data for file, data in whole(name).items() if file != name}
    said = value_or_one_line(BY_NAME[name], files)
    if BY_NAME[name].optional:
        assert said == ""
    else:
        assert any(
            words in said for words in ("no such", "found nothing", "found none", "expected vertices of 1 frames")
        )


PLACE = st.floats(0, 1, exclude_max=True)
DAMAGE = st.one_of(
    st.tuples(st.just("flip"), PLACE, st.integers(0, 7)),
    st.tuples(st.just("cut"), PLACE, st.integers(1, 40)),
    st.tuples(st.just("end"), PLACE, st.none()),
    st.tuples(st.just("insert"), PLACE, st.binary(min_size=1, max_size=6)),
    st.tuples(st.just("number"), PLACE, st.sampled_from(NUMBERS)),
    st.tuples(st.just("word"), PLACE, st.sampled_from(WORDS)),
    st.tuples(st.just("line"), PLACE, st.sampled_from(["twice", "gone"])),
)


@pytest.mark.parametrize("name", BY_NAME)
@given(damages=st.lists(DAMAGE, min_size=1, max_size=3))
@settings(max_examples=40, deadline=None)
def test_a_damaged_file_has_a_value_or_is_named(name: str, damages: list[tuple[str, float, Any]]) -> None:
    data = whole(name)[name]
    for damage in damages:
        data = damaged(data, *damage)
    value_or_one_line(BY_NAME[name], whole(name) | {name: data})


@pytest.mark.parametrize("name", BY_NAME)
@given(seed=st.integers(0, 2**32))
@settings(max_examples=25, deadline=None)
def test_a_file_that_lies_has_a_value_or_is_named(name: str, seed: int) -> None:
    _, files = mutant(random.Random(seed), name, whole(name))
    value_or_one_line(BY_NAME[name], files)


@pytest.mark.parametrize("rule", [pytest.param(rule, id=rule.name) for rule in RULES])
def test_what_breaks_a_rule_is_refused(rule: Any) -> None:
    for number, name in enumerate(rule.kinds):
        files = rule.broken(random.Random(number), number)
        assert value_or_one_line(BY_NAME[name], files) != "", f"{rule.name}: mutant {number}, {name}"


def test_the_judge_knows_nonsense() -> None:
    """One that finds nothing would let everything pass."""

    def bent(value: Any, **changes: Any) -> Any:
        """A value that its own checks would refuse."""
        made = object.__new__(type(value))
        for field in dataclasses.fields(value):
            object.__setattr__(made, field.name, changes.get(field.name, getattr(value, field.name)))
        return made

    assert nonsense_in([POSES, GARMENT]) == ""
    for value in (
        bent(POSES, rotations=POSES.rotations * 2),
        bent(POSES, frame_ids=np.array([0, 1, 1], np.int32)),
        bent(POSES, fps=0.0),
        bent(GARMENT, loops={"hem": np.array([0, 2, 1], np.int32)}),
        bent(GARMENT, skin_weights=GARMENT.skin_weights * 2),
        {"metric": [1.0, float("nan")]},
    ):
        assert nonsense_in([value]) != ""


ARCHIVES = [kind.name for kind in KINDS if kind.name.endswith(".npz")]


@pytest.mark.parametrize("name", ARCHIVES)
def test_arrays_of_another_kind_have_a_value_or_are_named(name: str) -> None:
    with np.load(io.BytesIO(whole(name)[name]), allow_pickle=False) as archive:
        arrays = dict(archive)
    changes = list(ARRAY_CHANGES.values())
    for row, changed in enumerate(arrays):
        for change in (*changes[row % 4 :: 4], None):
            value = None if change is None else change(arrays[changed])
            value_or_one_line(BY_NAME[name], whole(name) | {name: with_arrays(whole(name)[name], {changed: value})})


KEYS = ["cameras", "name", "intrinsics", "distortion", "T_camera_world", "width", "height", "format", "fps", "frames",
        "units", "garment_colour", "boundary_colours", "stage", "schema", "digest", "x"]  # fmt: skip
JSON = [kind.name for kind in KINDS if kind.name.endswith((".json", ".jsonl"))]


@pytest.mark.parametrize("name", JSON)
@given(
    value=st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.sampled_from(JSON_VALUES),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(KEYS), inner, max_size=6),
        max_leaves=20,
    )
)
@settings(max_examples=80, deadline=None)
def test_json_of_any_shape_has_a_value_or_is_named(name: str, value: Any) -> None:
    value_or_one_line(BY_NAME[name], whole(name) | {name: json.dumps(value).encode()})


@pytest.mark.parametrize("name", JSON)
def test_json_of_any_depth_is_named(name: str) -> None:
    for text in (b"[" * 100_000, b'{"a":' * 100_000 + b"1" + b"}" * 100_000):
        assert "not valid JSON" in value_or_one_line(BY_NAME[name], whole(name) | {name: text})
