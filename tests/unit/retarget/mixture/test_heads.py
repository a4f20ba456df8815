"""What networks are told of a pose."""

import numpy as np
import pytest

from retarget.mixture.heads import Head, PoseNumbers


@pytest.mark.parametrize(("kind", "each"), [("axis-angle", 3), ("matrices", 9)])
def test_no_poses_have_no_rows(kind: str, each: int) -> None:
    """A prototype whose drapes were all pruned on one side of the split still joins the others."""
    numbers = PoseNumbers((1, 2), kind, np.zeros(2 * each), np.ones(2 * each))  # pyright: ignore[reportArgumentType]
    assert numbers.of(np.zeros((0, 4, 3, 3))).shape == (0, 2 * each)


def test_no_displacements_have_no_rows() -> None:
    for head in (Head.of_vertices(5), Head(np.zeros(15), np.eye(15)[:2], 1.0)):
        assert head.encoded(np.zeros((0, 5, 3))).shape == (0, head.outputs)
