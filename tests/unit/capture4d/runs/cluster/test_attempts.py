"""Frames that end their workers are given up; frames that merely fail are not."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from capture4d.errors import InputError
from capture4d.runs.cluster.attempts import MOST_KILLED, begin_frame, count_attempts, end_frame, end_frames


@pytest.fixture
def counting() -> Iterator[None]:
    count_attempts("a command")
    yield
    end_frames()
    count_attempts(None)


@pytest.mark.usefixtures("counting")
def test_a_frame_from_which_three_have_not_come_back_is_given_up(tmp_path: Path) -> None:
    path = tmp_path / "frames" / "000001.npz"
    for _ in range(MOST_KILLED):
        begin_frame(path)
    with pytest.raises(InputError, match="3 workers of the cluster were ended"):
        begin_frame(path)
    begin_frame(tmp_path / "frames" / "000002.npz")
    count_attempts("another command")
    begin_frame(path)


@pytest.mark.usefixtures("counting")
def test_whoever_comes_back_has_not_been_killed(tmp_path: Path) -> None:
    path = tmp_path / "000001.npz"
    for end in (lambda: end_frame(path), end_frames) * MOST_KILLED:
        begin_frame(path)
        end()
    assert list(tmp_path.iterdir()) == []


def test_here_nothing_is_counted(tmp_path: Path) -> None:
    for _ in range(MOST_KILLED + 1):
        begin_frame(tmp_path / "000001.npz")
    assert list(tmp_path.iterdir()) == []
