"""Where takes are cut."""

import numpy as np
import pytest

from capture4d.captures.segments import cut


@pytest.mark.parametrize("frames", [1, 7, 59, 60, 179, 180, 181, 1000, 10_800])
@pytest.mark.parametrize(("length", "overlap"), [(1, 0), (40, 24), (120, 24), (240, 300)])
def test_every_frame_is_in_one_segment_of_about_the_length(frames: int, length: int, overlap: int) -> None:
    segments = cut(frames, length, overlap)
    assert [at for each in segments for at in range(each.start, each.stop)] == list(range(frames))
    assert [each.index for each in segments] == list(range(len(segments)))
    assert segments[0].lead == 0
    for each in segments[1:]:
        assert each.start - each.lead == min(overlap, length // 2)
        assert each.lead >= segments[each.index - 1].start, "no frame is in more than two"
    if len(segments) > 1:
        assert all(length / 2 <= each.stop - each.start <= 1.5 * length for each in segments)


def test_frames_added_behind_leave_earlier_cuts_where_they_are() -> None:
    before, after = cut(1000, 120, 24), cut(1500, 120, 24)
    assert after[: len(before) - 1] == before[:-1]


@pytest.mark.parametrize("overlap", [0, 24, 300])
def test_segments_are_followed_from_the_easiest_frame_around(overlap: int) -> None:
    unease = np.random.default_rng(0).random(1500)
    plain, moved = cut(1500, 240, overlap), cut(1500, 240, overlap, unease=unease)
    assert moved[0].lead == 0
    for at, each in zip(plain[1:], moved[1:], strict=True):
        around = np.arange(at.lead - 60, at.lead + 61)
        assert each.lead == around[np.argmin(unease[around])]
        assert each.start - each.lead == at.start - at.lead
        assert each.lead >= moved[each.index - 1].start, "no frame is in more than two"
    assert [at for each in moved for at in range(each.start, each.stop)] == list(range(1500))


def test_where_all_frames_are_alike_cuts_stay() -> None:
    assert cut(1500, 240, 24, unease=np.ones(1500)) == cut(1500, 240, 24)


def test_frames_added_behind_leave_easy_cuts_where_they_are() -> None:
    unease = np.random.default_rng(1).random(1500)
    before, after = cut(1000, 240, 24, unease=unease[:1000]), cut(1500, 240, 24, unease=unease)
    assert after[: len(before) - 1] == before[:-1]


def test_a_short_take_is_whole() -> None:
    assert len(cut(179, 120, 24)) == 1
    assert len(cut(180, 120, 24)) == 2
