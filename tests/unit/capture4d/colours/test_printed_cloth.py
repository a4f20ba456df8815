"""A printed tube between two bands of paint, on a body that wears some of the print's colours."""

import numpy as np
import pytest

from capture4d.colours.labels import FIRST_PAINT, GARMENT, OTHER
from capture4d.colours.learning import learn_colours
from capture4d.colours.printed_cloth import between_paint, island_share, label_print, without_specks
from capture4d.extraction.garment import extract_garment
from capture4d.types import Mesh, Scan
from tests.shapes import tube_faces

CLOTH, PAINT, SUIT, SKIN = (47, 98, 201), (255, 196, 0), (150, 152, 156), (214, 168, 140)
AROUND, ALONG, BAND, LOW, HIGH = 160, 140, 0.012, 0.08, 0.32
"""A column of body from 0 to 0.4 m, garment from LOW to HIGH with paint at both ends."""


def printed_column(ink: str, *, seed: int = 0) -> tuple[Scan, np.ndarray, np.ndarray]:
    """A scan; which of its vertices are garment, paint included; and which are paint."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    heights = np.linspace(0, 0.4, ALONG)
    vertices = np.concatenate(
        [np.column_stack([0.1 * np.sin(angle), np.full(AROUND, y), 0.1 * np.cos(angle)]) for y in heights]
    )
    turn, y = np.tile(angle, ALONG), vertices[:, 1]
    colours = np.full((len(vertices), 3), CLOTH, float)
    if ink == "blobs":
        cells = (np.floor(turn / (2 * np.pi) * 40).astype(int), np.floor(y / 0.016).astype(int))
        colours = np.array([CLOTH, SUIT, SKIN, (40, 160, 60), (30, 30, 30)])[rng.integers(0, 5, (41, 40))[cells]]
    elif ink == "stripes":
        colours[np.floor(turn / (2 * np.pi) * 40).astype(int) % 2 == 0] = SUIT
    elif ink == "logo":
        colours[np.hypot(0.1 * (turn - np.pi), y - 0.2) < 0.04] = SKIN
    garment = (y >= LOW) & (y <= HIGH)
    painted = garment & ((y < LOW + BAND) | (y > HIGH - BAND))
    colours = np.where(garment[:, None], colours, np.where((y > HIGH)[:, None], SKIN, SUIT))
    colours = np.where(painted[:, None], PAINT, colours) + 4 * rng.standard_normal(colours.shape)
    mesh = Mesh(vertices.astype(np.float32), tube_faces(AROUND, ALONG))
    return Scan(mesh, np.clip(colours, 0, 255).astype(np.uint8), 1, 0.0), garment, painted


def around_the_front(scan: Scan) -> np.ndarray:
    """Distances of the vertices from the middle of the front, along the column, metres."""
    x, y, z = scan.mesh.vertices.T
    return np.hypot(0.1 * np.arctan2(x, z), y - 0.2)


@pytest.mark.parametrize("ink", ["blobs", "stripes", "logo"])
def test_everything_between_the_paint_is_the_garment_whatever_its_colour(ink: str) -> None:
    scan, garment, _ = printed_column(ink)
    found = learn_colours([scan], paints=[PAINT])
    assert found.printed
    flat = Scan(scan.mesh, found.light.removed(scan.mesh, scan.colours), 1, 0.0)
    cut = extract_garment(
        flat, found.garment, {"top": found.paints[0], "bottom": found.paints[0]}, other_colours=found.others,
        printed=found.printed, as_scanned=scan.colours,
    )  # fmt: skip
    row = [("", np.float32)] * 3
    inside = np.isin(scan.mesh.vertices.view(row).ravel(), cut.mesh.vertices.view(row).ravel())
    assert (inside & garment).sum() / garment.sum() > 0.98
    assert (inside & garment).sum() / inside.sum() > 0.98
    assert cut.colours is not None
    np.testing.assert_array_equal(cut.colours, scan.colours[inside])


def test_cloth_of_one_colour_is_not_taken_for_printed() -> None:
    scan, _, _ = printed_column("plain")
    found = learn_colours([scan], paints=[PAINT])
    assert not found.printed


def test_labels_keep_the_paint_and_drop_the_body() -> None:
    scan, garment, painted = printed_column("blobs")
    taken_for = np.where(painted, FIRST_PAINT, OTHER).astype(np.uint8)
    labels = label_print(scan.mesh.faces, taken_for)
    np.testing.assert_array_equal(labels == FIRST_PAINT, painted)
    np.testing.assert_array_equal(labels == GARMENT, garment & ~painted)


def test_specks_of_the_paints_colour_are_no_paint() -> None:
    scan, _, painted = printed_column("plain")
    specks = painted.copy()
    specks[np.argmin(np.abs(scan.mesh.vertices[:, 1] - 0.2)) + np.arange(2)] = True
    np.testing.assert_array_equal(without_specks(scan.mesh.faces, specks), painted)


def test_without_paint_nothing_is_told() -> None:
    scan, _, painted = printed_column("plain")
    assert not between_paint(scan.mesh.faces, np.zeros_like(painted)).any()


def test_islands_are_what_touches_the_cloth_alone() -> None:
    scan, garment, painted = printed_column("plain")
    cloth = garment & ~painted
    assert island_share(scan.mesh.faces, cloth, painted) == 0
    y = scan.mesh.vertices[:, 1]
    logo = cloth & (np.abs(y - 0.2) < 0.02) & (scan.mesh.vertices[:, 2] > 0.05)
    share = island_share(scan.mesh.faces, cloth & ~logo, painted)
    assert share == pytest.approx(logo.sum() / (cloth & ~logo).sum())


def test_a_piece_of_the_body_that_touches_the_cloth_beside_its_border_is_no_island() -> None:
    """As an arm whose hand lies on the cloth, with the band of its cuff."""
    scan, garment, painted = printed_column("plain")
    cloth, turn = garment & ~painted, np.arctan2(*scan.mesh.vertices[:, [0, 2]].T)
    arm = cloth & (np.abs(turn) < 0.8) & (scan.mesh.vertices[:, 1] < 0.2)
    assert island_share(scan.mesh.faces, cloth & ~arm, painted) == 0


def test_a_logo_with_a_blob_of_the_paints_colour_is_a_print() -> None:
    """The blob has as many vertices as a torn piece of a band."""
    scan, _, painted = printed_column("plain")
    colours, away = scan.colours.copy(), around_the_front(scan)
    assert (away < 0.013).sum() > 0.02 * painted.sum()
    colours[away < 0.04] = SKIN
    colours[away < 0.013] = PAINT
    assert learn_colours([Scan(scan.mesh, colours, 1, 0.0)], paints=[PAINT]).printed
