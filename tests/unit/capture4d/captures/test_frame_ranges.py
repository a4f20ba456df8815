"""Frames as ranges: the words, and that nothing is lost in them."""

from random import Random

from hypothesis import given
from hypothesis import strategies as st

from capture4d.captures.frame_ranges import frame_ranges


def frames_of(text: str, among: list[int] | None = None) -> list[int]:
    """A slow reading of what `frame_ranges` writes."""
    frames = []
    for part in text.split(", ") if text else []:
        first, _, last = part.partition("-")
        frames += [each for each in among or range(100) if int(first) <= each <= int(last or first)]
    return frames


def test_neighbours_are_a_range():
    assert frame_ranges([61, 12, 13, 14, 60, 44, 13]) == "12-14, 44, 60-61"
    assert frame_ranges([]) == ""
    assert frame_ranges([7]) == "7"


def test_neighbours_in_the_take_are_a_range_too():
    assert frame_ranges([10, 14, 16, 18], among=range(10, 30, 2)) == "10, 14-18"


def test_a_long_list_names_its_longest_ranges_in_order():
    assert frame_ranges([1, 3, 4, 8, 10, 11, 12], most=2) == "3-4, 10-12 and 2 more"
    assert frame_ranges([1, 3], most=2) == "1, 3"


@given(st.sets(st.integers(0, 99)))
def test_no_frame_is_lost_and_ranges_are_as_long_as_they_can_be(ids: set[int]):
    said = frame_ranges(ids)
    assert frames_of(said) == sorted(ids)
    begun = [each for each in ids if each - 1 not in ids]
    assert len([part for part in said.split(", ") if part]) == len(begun)


@given(st.sets(st.integers(0, 99), min_size=1), st.randoms(use_true_random=False))
def test_no_frame_of_a_take_with_gaps_is_lost(take: set[int], random: Random):
    ids = random.sample(sorted(take), random.randint(0, len(take)))
    assert frames_of(frame_ranges(ids, among=take), sorted(take)) == sorted(ids)
