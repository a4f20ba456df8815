"""What a folder has to show: of an animation, of a capture alone, of a run that is going on."""

from pathlib import Path

import numpy as np
import pytest

from capture4d import pipeline
from capture4d.app.viewer.figures import FIGURES, FIT, INSIDE, MOTION, STRETCH, StretchOf, figure_colours
from capture4d.app.viewer.presenter import Choice, Presenter
from capture4d.app.viewer.surfaces import Dots, Surface
from capture4d.app.viewer.take import BODY_LAYER, BORDER, CLOTH_LAYER, CUT, MAPS, PLAIN, SCAN, open_take
from capture4d.app.viewer.timeline import OPEN
from capture4d.errors import InputError
from capture4d.files.atomic import write_npz
from capture4d.types import Garment
from tests.moving_garment import cloth, write_moving_work


@pytest.fixture(scope="module")
def animation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    work = tmp_path_factory.mktemp("animation") / "work"
    write_moving_work(work, 6, seed=3, first=4, maps=8)
    return work


def test_an_animation_shows_cloth_with_maps_and_body(animation: Path):
    take = open_take(animation)
    assert take.timeline.frame_ids == (4, 5, 6, 7, 8, 9)
    assert take.layers == (CLOTH_LAYER, BODY_LAYER)
    assert {*take.paints} == {PLAIN, MAPS, STRETCH, MOTION, INSIDE}
    assert take.fps == 25
    vertices = np.load(animation / "registration" / "vertices.npy")
    shown = take.shown(CLOTH_LAYER, 6, paint=MAPS)
    assert isinstance(shown, Surface)
    np.testing.assert_array_equal(shown.mesh.vertices, vertices[2])
    assert shown.normal_map == (animation / "wrinkles" / "generated" / "frames" / "000006.png").read_bytes()
    plain = take.shown(CLOTH_LAYER, 6)
    assert isinstance(plain, Surface)
    assert plain.normal_map is None


def test_motion_is_the_way_since_the_frame_before(animation: Path):
    take = open_take(animation)
    vertices = np.load(animation / "registration" / "vertices.npy")
    found = take.figure(MOTION, 6, vertices[2])
    np.testing.assert_allclose(found, np.linalg.norm(vertices[2] - vertices[1], axis=1) * 25, rtol=1e-5)
    assert np.isnan(take.figure(MOTION, 4, vertices[0])).all(), "the first has none before it"


def test_stretch_is_the_most_of_the_edges_around():
    mesh = cloth()
    stretched = mesh.vertices.astype(np.float64)
    stretched[30] *= 1.5
    found = StretchOf(Garment(mesh))(stretched)
    rows, columns = np.array([(a, b) for f in mesh.faces for a, b in zip(f, np.roll(f, 1), strict=True)]).T
    before = np.linalg.norm(mesh.vertices[rows].astype(float) - mesh.vertices[columns], axis=1)
    ratio = np.linalg.norm(stretched[rows] - stretched[columns], axis=1) / before
    slow = [ratio[(rows == vertex) | (columns == vertex)].max() for vertex in range(len(stretched))]
    np.testing.assert_allclose(found, slow)
    assert found.max() > 1.2


def test_cloth_in_the_body_is_told(animation: Path):
    take = open_take(animation)
    vertices = np.load(animation / "registration" / "vertices.npy")[0]
    assert take.figure(INSIDE, 4, vertices).max() < 20
    centre = vertices.mean(axis=0)
    squeezed = (centre + 0.6 * (vertices - centre)).astype(np.float32)
    assert take.figure(INSIDE, 4, squeezed).max() > 20


def test_colours_tell_low_high_beyond_and_unknown():
    colours = figure_colours(FIT, np.array([0.0, 2.0, 5.0, np.nan]), FIGURES[FIT].high)
    assert len({*map(tuple, colours.tolist())}) == 4


def test_a_capture_alone_shows_its_scans(tube_capture: Path):
    take = open_take(tube_capture)
    assert take.is_capture
    assert take.layers == (SCAN,)
    assert take.paints == ()
    shown = take.shown(SCAN, 6)
    assert isinstance(shown, Surface)
    assert 100 < len(shown.mesh.vertices) < 7200
    full = take.shown(SCAN, 6, full=True)
    assert isinstance(full, Surface)
    assert len(full.mesh.vertices) == 7200
    assert take.timeline.verdict(6) == OPEN


def test_a_run_that_is_going_on(tube_capture: Path, tmp_path: Path):
    work = tmp_path / "work"
    pipeline.extract(tube_capture, work)
    take = open_take(work)
    assert take.layers == (SCAN, CUT, BORDER)
    assert not take.look()
    border = take.shown(BORDER, 6)
    assert isinstance(border, Dots)
    assert len(border.points) > 20
    pipeline.register(tube_capture, work)
    assert take.look()
    assert take.layers == (SCAN, CUT, BORDER, CLOTH_LAYER)
    assert take.paints[0] == FIT
    assert take.timeline.verdict(6) in ("good", "check")
    shown = take.shown(CLOTH_LAYER, 6, paint=FIT, high=2.0)
    assert isinstance(shown, Surface)
    assert not isinstance(shown.colours, tuple)


def test_a_frame_is_made_once_and_again_when_it_changes(tube_capture: Path, tmp_path: Path, monkeypatch):
    work = tmp_path / "work"
    pipeline.extract(tube_capture, work)
    pipeline.register(tube_capture, work)
    take = open_take(work)
    presenter, asked = Presenter([take], memory_mb=8), []
    real = type(take).shown
    monkeypatch.setattr(type(take), "shown", lambda self, *a, **k: asked.append(a) or real(self, *a, **k))
    choice = Choice(frozenset({CLOTH_LAYER}), FIT, 2.0)
    first = presenter.picture(6, choice)
    assert presenter.picture(6, choice).payloads == first.payloads
    assert len(asked) == 1
    path = work / "registration" / "frames" / "000006.npz"
    with np.load(path) as arrays:
        moved = {**arrays, "vertices": arrays["vertices"] + np.float32(0.1)}
    write_npz(path, **moved)
    assert presenter.look()
    assert presenter.picture(6, choice).payloads != first.payloads


def test_side_by_side_they_do_not_touch(animation: Path, tube_capture: Path):
    presenter = Presenter([open_take(animation), open_take(tube_capture)], memory_mb=8)
    boxes = [presenter.box(number) for number in range(2)]
    first, second = (box[:, 0] + offset for box, offset in zip(boxes, presenter.offsets_m(), strict=True))
    assert first[1] < second[0]
    assert presenter.frame_ids == (4, 5, 6, 7, 8, 9)
    shown = presenter.picture(5, Choice(frozenset({SCAN, CLOTH_LAYER}), PLAIN, 1.0)).payloads
    assert {key for key, payload in shown.items() if payload} == {(0, CLOTH_LAYER), (1, SCAN)}
    late = presenter.picture(9, Choice(frozenset({SCAN, CLOTH_LAYER}), PLAIN, 1.0)).payloads
    assert late[1, SCAN] is None


def test_a_damaged_scan_is_said_and_the_rest_is_shown(tube_capture: Path):
    (tube_capture / "scans" / "000006.ply").write_bytes(b"ply\n")
    presenter = Presenter([open_take(tube_capture)], memory_mb=8)
    picture = presenter.picture(6, Choice(frozenset({SCAN}), "", 1.0))
    assert picture.payloads == {(0, SCAN): None}
    assert len(picture.faults) == 1
    assert "000006.ply" in picture.faults[0]


@pytest.mark.parametrize("name", ["nothing", "file"])
def test_what_is_no_folder_is_one_line(tmp_path: Path, name: str):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="expected a work folder or a capture, found"):
        open_take(tmp_path / name)


def test_an_empty_folder_is_one_line(tmp_path: Path):
    with pytest.raises(InputError, match="expected frames to show, found none; run: capture4d run"):
        open_take(tmp_path)
