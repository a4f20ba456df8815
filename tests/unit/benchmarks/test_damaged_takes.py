"""Damage does what its name says, to what it names, and leaves the take it was given alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import damaged_takes as damage
from benchmarks.plain_takes import PlainTake
from capture4d.errors import EmptyMeshError, InputError, NotFiniteError
from capture4d.mesh_files.meshes import read_mesh
from capture4d.types import Mesh, Scan


@pytest.fixture
def take() -> PlainTake:
    rng = np.random.default_rng(3)
    mesh = Mesh(rng.random((40, 3), np.float32), rng.integers(0, 40, (60, 3), np.int32))
    colours = rng.integers(0, 255, (40, 3)).astype(np.uint8)
    scans = {number: Scan(mesh.with_vertices(mesh.vertices + number), colours, number, 0.0) for number in (4, 5, 6)}
    return PlainTake("noise", 30.0, (1, 2, 3), {}, scans, None, None, None)


def read(take: PlainTake, folder: Path, number: int) -> Mesh:
    return read_mesh(damage.write_take(take, folder) / "scans" / f"{number:06d}.ply").mesh


def test_a_written_take_is_read_back(take: PlainTake, tmp_path: Path):
    np.testing.assert_array_equal(read(take, tmp_path / "take", 5).vertices, take.scans[5].mesh.vertices)


@pytest.mark.parametrize(
    ("harm", "error", "said"),
    [
        (damage.empty_frame, EmptyMeshError, "empty mesh"),
        (damage.truncated_frame, InputError, "cut off"),
        (damage.nan_frame, NotFiniteError, "20 of 40 rows"),
    ],
)
def test_a_broken_file_is_told_as_what_it_is(take: PlainTake, tmp_path: Path, harm, error, said: str):
    broken = harm(take, 5)
    with pytest.raises(error, match=said):
        read(broken, tmp_path / "broken", 5)
    np.testing.assert_array_equal(read(broken, tmp_path / "broken", 4).vertices, take.scans[4].mesh.vertices)
    assert not take.files


def test_turning_and_turning_back_is_nothing(take: PlainTake):
    there = damage.move_scans(take, damage.Y_TO_Z)
    back = damage.move_scans(there, damage.Y_TO_Z.T)
    np.testing.assert_allclose(back.scans[6].mesh.vertices, take.scans[6].mesh.vertices, atol=1e-6)
    assert not np.allclose(there.scans[6].mesh.vertices, take.scans[6].mesh.vertices)


def test_faces_turned_over_twice_are_as_before(take: PlainTake):
    once = damage.flip_faces(take)
    np.testing.assert_array_equal(once.scans[4].mesh.faces[:, 0], take.scans[4].mesh.faces[:, 2])
    np.testing.assert_array_equal(damage.flip_faces(once).scans[4].mesh.faces, take.scans[4].mesh.faces)


def test_a_repeated_frame_is_the_one_before_under_its_own_number(take: PlainTake):
    repeated = damage.repeat_frame(take, 6).scans[6]
    assert repeated.frame_id == 6
    np.testing.assert_array_equal(repeated.mesh.vertices, take.scans[5].mesh.vertices)


def test_recolouring_changes_one_colour_and_keeps_its_shade(take: PlainTake):
    scan = take.scans[4]
    colours = np.zeros((40, 3), np.uint8)
    colours[:20], colours[20:30], colours[30:] = (100, 100, 100), (50, 50, 50), (200, 20, 20)
    grey = replace(take, scans={4: replace(scan, colours=colours)})
    painted = damage.recoloured(grey, (100, 100, 100), (60, 120, 60)).scans[4].colours
    np.testing.assert_array_equal(painted[0], (60, 120, 60))
    np.testing.assert_array_equal(painted[25], (30, 60, 30))
    np.testing.assert_array_equal(painted[35], (200, 20, 20))
