"""Files of landmarks: two ways to write a pair, and what is wrong with one is told by its line."""

from pathlib import Path

import numpy as np
import pytest

from capture4d.errors import InputError
from registration.landmarks import read_landmarks


def test_vertex_numbers_and_coordinates_are_read(garment, scan_of, tmp_path: Path) -> None:
    template, scan = garment.template, scan_of(lambda points: points + 1.0).mesh
    x, y, z = template.vertices[7]
    (tmp_path / "marks.csv").write_text(f"# ours, theirs\n3, 40\n\n{x} {y} {z} 1 2 3  # by hand\n")
    found = read_landmarks(tmp_path / "marks.csv", template, scan)
    np.testing.assert_allclose(found.on_template, template.vertices[[3, 7]], rtol=1e-6)
    np.testing.assert_allclose(found.on_scan, [scan.vertices[40], [1, 2, 3]], rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1 2\n3 4 5\n", "line 2: expected two vertex numbers or six coordinates, found '3 4 5'"),
        ("1 two\n", "line 1: expected two vertex numbers"),
        ("1 2.5\n", "line 1: expected two vertex numbers"),
        ("-1 2\n", "line 1: expected a vertex of the template, 0 to 647, found -1"),
        ("1 99999\n", "line 1: expected a vertex of the scan"),
        ("9 9 9 0 0 0\n", "line 1: expected a point on the template, found one that is"),
        ("# nothing\n", "expected pairs of landmarks, found none"),
    ],
)
def test_what_is_wrong_is_told_by_line(text: str, said: str, garment, scan_of, tmp_path: Path) -> None:
    (tmp_path / "marks.txt").write_text(text)
    with pytest.raises(InputError, match=r"marks\.txt") as caught:
        read_landmarks(tmp_path / "marks.txt", garment.template, scan_of(lambda points: points).mesh)
    assert said in str(caught.value)
