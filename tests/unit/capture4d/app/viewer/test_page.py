"""The page as its controls have it, without a browser: what is asked for is what is sent."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture4d import pipeline
from capture4d.app.viewer.page import ViewerPage
from capture4d.app.viewer.presenter import Presenter
from capture4d.app.viewer.scenery import open_server
from capture4d.app.viewer.surfaces import Surface, surface_glb
from capture4d.app.viewer.take import BODY_LAYER, CLOTH_LAYER, PLAIN, SCAN, open_take
from capture4d.errors import InputError
from capture4d.files.optional_packages import VISER, require_package
from tests.moving_garment import write_moving_work
from tests.waiting import until

Open = Callable[..., ViewerPage]


@pytest.fixture
def opened() -> Iterator[Open]:
    """Pages, which are closed at the end."""
    pytest.importorskip("viser", reason="viser is not installed: the page is not looked at")
    closing: list[tuple[ViewerPage, Any]] = []

    def serve(*folders: Path, look_every_s: float = 0.1) -> ViewerPage:
        server = open_server("127.0.0.1", 8410, "test")
        presenter = Presenter([open_take(folder) for folder in folders], 16)
        page = ViewerPage(server, presenter, look_every_s=look_every_s)
        closing.append((page, server))
        assert page.wait_until_shown()
        return page

    yield serve
    for page, server in closing:
        page.close()
        server.stop()


def sent(page: ViewerPage, layer: str, take: int = 0) -> Any:
    return page._handles[take, layer]


def test_the_frame_and_layers_that_are_asked_for(opened: Open, tmp_path: Path):
    write_moving_work(tmp_path / "work", 5, seed=1, first=10, step=2)
    page = opened(tmp_path / "work")
    assert page.frame == 10
    vertices = np.load(tmp_path / "work" / "registration" / "vertices.npy")
    take = open_take(tmp_path / "work")
    page.choose(layers=frozenset({CLOTH_LAYER, BODY_LAYER}), paint=PLAIN)
    for frame_id, row in ((16, 3), (12, 1)):
        page.go_to(frame_id)
        assert page.wait_until_shown()
        shown = take.shown(CLOTH_LAYER, frame_id)
        assert isinstance(shown, Surface)
        np.testing.assert_array_equal(shown.mesh.vertices, vertices[row])
        assert sent(page, CLOTH_LAYER).glb_data == surface_glb(shown)
        assert sent(page, BODY_LAYER).visible
        assert page._slider.value == frame_id
    page.choose(layers=frozenset({CLOTH_LAYER}))
    assert page.wait_until_shown()
    assert not sent(page, BODY_LAYER).visible
    assert sent(page, CLOTH_LAYER).visible
    page.go_to(17)
    assert page.frame in (16, 18), "the nearest that there is"


def test_steps_go_round_and_to_what_is_flagged(opened: Open, tmp_path: Path):
    write_moving_work(tmp_path / "work", 5, seed=1, first=1)
    page = opened(tmp_path / "work")
    seen = []
    for count, among in (
        (1, None),
        (1, None),
        (-1, None),
        (-1, None),
        (-1, None),
        (1, [2, 4]),
        (1, [2, 4]),
        (1, [2, 4]),
    ):
        page.step(count, among)
        seen.append(page.frame)
    assert seen == [2, 3, 2, 1, 5, 2, 4, 2]
    page.step(1, [])
    assert page.frame == 2, "nothing is flagged"


def test_playing_goes_on_by_itself_and_stops(opened: Open, tmp_path: Path):
    write_moving_work(tmp_path / "work", 8, seed=2, fps=20.0)
    page = opened(tmp_path / "work")
    page.play(1.0)
    seen = set()
    assert until(lambda: seen.add(page.frame) or len(seen) > 3)
    page.play(0.0)
    time.sleep(0.2)
    stopped = page.frame
    time.sleep(0.3)
    assert page.frame == stopped


def test_frames_that_are_registered_meanwhile_appear(opened: Open, tube_capture: Path, tmp_path: Path):
    work = tmp_path / "work"
    pipeline.extract(tube_capture, work)
    page = opened(work)
    assert CLOTH_LAYER not in page._boxes
    assert (0, SCAN) in page._handles
    pipeline.register(tube_capture, work)
    assert until(lambda: CLOTH_LAYER in page._boxes and (0, CLOTH_LAYER) in page._handles)
    assert until(lambda: "good" in page._told.content or "check" in page._told.content)
    assert until(lambda: "fit_mean_mm" in page._measure.options)


def test_two_works_side_by_side(opened: Open, tmp_path: Path):
    for name, frames in (("a", 4), ("b", 3)):
        write_moving_work(tmp_path / name, frames, seed=frames)
    page = opened(tmp_path / "a", tmp_path / "b")
    assert sent(page, CLOTH_LAYER, 0).visible
    assert sent(page, CLOTH_LAYER, 1).visible
    apart = np.array(sent(page, CLOTH_LAYER, 1).position) - sent(page, CLOTH_LAYER, 0).position
    assert apart[0] > 0.2
    page.go_to(4)
    assert page.wait_until_shown()
    assert sent(page, CLOTH_LAYER, 0).visible
    assert not sent(page, CLOTH_LAYER, 1).visible, "it has no such frame"


def test_without_viser_it_is_said_what_installs_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'capture4d\[view\]'"):
        require_package(VISER)
