import numpy as np
import pytest

from capture4d.app.drawing.render import BEYOND, Drawn, View, frame_view, heat_colours, render
from capture4d.types import Mesh

RED, GREEN, BLUE = (220, 30, 30), (30, 200, 30), (30, 30, 220)
WHITE = (255, 255, 255)


def box(centre, size=0.1):
    """A closed cube, outward normals."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32) * size / 2
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return Mesh((corners + np.array(centre)).astype(np.float32), np.array(faces, np.int32))


def place_of(picture, colour):
    """Mean (row, column) of the pixels whose strongest channel is the colour's, as shares of the picture."""
    channel = int(np.argmax(colour))
    others = [other for other in range(3) if other != channel]
    mask = picture[..., channel].astype(int) > picture[..., others].max(axis=2).astype(int) + 40
    rows, columns = np.nonzero(mask)
    return rows.mean() / picture.shape[0], columns.mean() / picture.shape[1]


@pytest.mark.parametrize("perspective", [True, False])
def test_up_is_up_and_the_subjects_left_is_right_in_the_front_view(perspective):
    """The trap: open3d's own pinhole rays with up = +Y give a picture that is turned by 180 degrees."""
    scene = [
        Drawn(box((0.0, 1.8, 0.0)), RED),  # head
        Drawn(box((0.4, 1.0, 0.0)), GREEN),  # left hand: +X
        Drawn(box((0.0, 0.2, 0.3)), BLUE),  # toes: +Z
    ]
    lower, upper = np.array([-0.5, 0.0, -0.5]), np.array([0.5, 2.0, 0.5])

    def looked(direction):
        view = frame_view(lower, upper, direction, elevation_deg=0.0, perspective=perspective)
        return render(scene, view, width=90, height=120)

    front = looked("front")
    assert place_of(front, RED)[0] < 0.2
    assert place_of(front, BLUE)[0] > 0.8
    assert place_of(front, GREEN)[1] > 0.6
    assert place_of(looked("back"), GREEN)[1] < 0.4
    assert place_of(looked("left"), BLUE)[1] < 0.45  # seen from the subject's left, it faces left
    assert place_of(looked("right"), BLUE)[1] > 0.55
    assert place_of(looked("left"), RED)[0] < 0.2


def test_seen_from_above_what_is_nearer_the_viewer_is_lower():
    scene = [Drawn(box((0.0, 1.0, 0.4)), RED), Drawn(box((0.0, 1.0, -0.4)), BLUE)]
    view = frame_view(np.array([-0.5, 0.5, -0.5]), np.array([0.5, 1.5, 0.5]), "front", elevation_deg=60.0)
    picture = render(scene, view, width=100, height=100)
    assert place_of(picture, RED)[0] > place_of(picture, BLUE)[0]


def test_sizes_are_true_in_an_orthographic_view():
    view = View((0.0, 0.0, 0.0), 0.0, 0.0, height_m=1.0)
    picture = render([Drawn(box((0.0, 0.0, 0.0), size=0.5), RED)], view, width=80, height=80)
    covered = (picture != 255).any(axis=2)
    assert covered.mean() == pytest.approx(0.25, abs=0.02)
    rows, columns = np.nonzero(covered)
    assert abs(rows.mean() - 39.5) < 0.6
    assert abs(columns.mean() - 39.5) < 0.6


@pytest.mark.parametrize("direction", ["front", "three_quarter", "left", "back"])
def test_the_whole_box_is_in_the_picture(direction):
    lower, upper = np.array([-0.6, 0.0, -0.2]), np.array([0.6, 1.7, 0.2])
    corners = [Drawn(box((x, y, z), 0.01), RED) for x in (-0.6, 0.6) for y in (0, 1.7) for z in (-0.2, 0.2)]
    picture = render(corners, frame_view(lower, upper, direction), width=150, height=200)
    for edge in (picture[:2], picture[-2:], picture[:, :2], picture[:, -2:]):
        assert (edge == 255).all()
    assert ((picture != 255).any(axis=2)).sum() > 8


def test_the_nearer_mesh_hides_the_other_and_sheets_show_both_sides():
    view = View((0.0, 0.0, 0.0), 0.0, 0.0, height_m=0.2, distance_m=1.0)
    near, far = Drawn(box((0.0, 0.0, 0.3), 0.5), RED), Drawn(box((0.0, 0.0, -0.3), 0.5), BLUE)
    for order in ([near, far], [far, near]):
        assert (render(order, view, width=8, height=8)[..., 0] > 100).all()
    sheet = Mesh(np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32), np.array([[0, 1, 2]], np.int32))
    turned = Mesh(sheet.vertices, sheet.faces[:, ::-1].copy())
    front, back = (render([Drawn(mesh, GREEN)], view, width=8, height=8)[4, 4, 1] for mesh in (sheet, turned))
    assert front > back > 60


def test_vertex_colours_are_interpolated():
    sheet = Mesh(np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32), np.array([[0, 1, 2]], np.int32))
    colours = np.array([RED, BLUE, RED], np.uint8)
    view = View((0.0, -0.6, 0.0), 0.0, 0.0, height_m=1.0)
    picture = render([Drawn(sheet, colours)], view, width=20, height=20)
    row = picture[10].astype(int)
    assert row[3, 0] > row[3, 2]
    assert row[16, 0] < row[16, 2]


def test_nothing_to_draw_is_background():
    empty = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    view = View((0.0, 0.0, 0.0), 0.0, 0.0, height_m=1.0)
    assert (render([Drawn(empty)], view, width=4, height=4, background=(10, 20, 30)) == (10, 20, 30)).all()


def test_heat_colours_darken_with_the_value_and_mark_what_is_beyond_and_what_is_missing():
    colours = heat_colours(np.array([0.0, 0.5, 1.0, 2.0, np.nan]), high=1.0).astype(int)
    luminance = colours @ [0.299, 0.587, 0.114]
    assert luminance[0] > luminance[1] > luminance[2]
    np.testing.assert_array_equal(colours[3], BEYOND)
    scale = heat_colours(np.linspace(0, 1, 256), high=1.0).astype(int)
    assert np.abs(scale - BEYOND).sum(axis=1).min() > 150, "a clipped value is not taken for one on the scale"
    assert np.ptp(colours[4]) < 15
    steps = np.diff(heat_colours(np.linspace(0, 1, 256), high=1.0) @ [0.299, 0.587, 0.114])
    assert (steps <= 1).all()
