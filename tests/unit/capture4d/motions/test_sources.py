"""Files of a database that asks to be named are known by their names alone."""

from pathlib import Path

import pytest

from capture4d.motions.sources import CMU, acknowledgement


@pytest.mark.parametrize(
    "path", ["cmu_12_01_walk.bvh", "data/CMU/12/12_01.bvh", "AMASS/CMU/01/01_01_poses.npz", "walk-cmu.bvh", "cmu12.bvh"]
)
def test_files_of_the_cmu_database_are_acknowledged_in_its_words(path: str) -> None:
    assert acknowledgement(Path(path)) == CMU
    assert "mocap.cs.cmu.edu" in CMU
    assert "NSF EIA-0196217" in CMU


@pytest.mark.parametrize("path", ["walk.bvh", "acmuse.bvh", "CMU/a/b/c/d/walk.bvh", "cmustang/walk.bvh"])
def test_other_files_are_not(path: str) -> None:
    assert acknowledgement(Path(path)) is None
