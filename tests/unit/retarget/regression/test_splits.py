"""Takes are given a role whole, and the only one is cut."""

import pytest

from capture4d.errors import InputError
from retarget.config import SplitConfig
from retarget.regression.splits import split_takes


def test_takes_are_given_whole_and_all_of_them() -> None:
    names, lengths = [f"t{i}" for i in range(10)], [100] * 10
    pieces = split_takes(names, lengths, 60.0, SplitConfig(held_out=("t3",), validation_share=0.2))
    assert sorted(piece.take for piece in pieces) == list(range(10))
    assert all(piece.frames == range(100) for piece in pieces)
    roles = [piece.role for piece in sorted(pieces, key=lambda piece: piece.take)]
    assert roles[3] == "held out"
    assert roles.count("validation") == 2
    assert pieces == split_takes(names, lengths, 60.0, SplitConfig(held_out=("t3",), validation_share=0.2))


def test_a_single_take_is_cut_with_a_gap() -> None:
    training, validation = split_takes(["only"], [600], 60.0, SplitConfig(gap_s=0.5, validation_share=0.1))
    assert training.frames == range(510)
    assert validation.frames == range(540, 600)
    (whole,) = split_takes(["only"], [3], 60.0, SplitConfig())
    assert whole.role == "training"
    with pytest.raises(InputError, match="all set aside"):
        split_takes(["only"], [30], 60.0, SplitConfig(held_out=("only",)))
