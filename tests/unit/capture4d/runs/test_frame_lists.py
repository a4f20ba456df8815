"""Frames as text: what is written is read, and what is no frame of the take is said."""

from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture4d.errors import InputError
from capture4d.runs.frame_lists import chosen_frames, counted, expanded, frame_ranges, listed


@given(st.sets(st.integers(0, 400), min_size=1))
def test_a_list_is_read_as_it_was_written(frames: set[int]):
    text = listed(frames, most=0)
    assert expanded(text) == tuple(sorted(frames))
    assert chosen_frames(text, tuple(range(401))) == tuple(sorted(frames))


@given(st.integers(0, 50), st.integers(0, 50), st.integers(1, 9))
def test_a_range_with_a_step_counts_from_its_first_number(first: int, length: int, step: int):
    text = f"{first}-{first + length}:{step}"
    assert chosen_frames(text, range(200)) == tuple(range(first, first + length + 1, step))


def test_lists_are_short():
    assert listed([]) == ""
    assert listed([1, 2, 3, 5, 10, 20, 30, 31]) == "1-3,5,10-30:10,31"
    assert listed([4, 5]) == "4-5"
    assert listed(range(0, 100, 7), most=3) == "0-98:7"
    assert listed([1, 3, 4, 8, 9, 15, 16, 40], most=3) == "1,3-4,..."
    assert counted([12], "added") == "frame 12 added"
    assert counted([21, 22, 23], "gone") == "3 frames gone (21-23)"


def test_numbers_of_a_range_that_the_take_lacks_are_passed_over():
    assert chosen_frames(" 1 , 3-9", (1, 2, 4, 6, 11)) == (1, 4, 6)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "expected frames such as 1,5,10-20 or 1-200:5, found ''"),
        ("1,,2", "expected frames such as"),
        ("a", "expected frames such as 1,5,10-20 or 1-200:5, found 'a'"),
        ("5-", "expected frames such as"),
        ("-5", "expected frames such as"),
        ("5:2", "expected frames such as"),
        ("9-3", "expected a range upwards, its step at least 1, found '9-3'"),
        ("3-9:0", "expected a range upwards, its step at least 1, found '3-9:0'"),
        ("7", "expected frames that the take has (1-5), found '7'"),
        ("1,7-9", "expected frames that the take has (1-5), found '7-9'"),
        ("²", "expected frames such as"),
    ],
)
def test_what_is_no_list_of_frames_is_one_line(text: str, said: str):
    with pytest.raises(InputError) as caught:
        chosen_frames(text, (1, 2, 3, 4, 5))
    assert str(caught.value).startswith(f"--frames: {said}")


def test_large_numbers_cost_nothing():
    assert chosen_frames("0-2147483647", (5, 2**31 - 1)) == (5, 2**31 - 1)


# --- as people read them ---------------------------------------------------------------------------------------------


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
