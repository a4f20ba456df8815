"""The page of the try-on, without a browser: what its sliders say is what is worn."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture4d.app.tryon.config import TryOnConfig
from capture4d.app.tryon.garments import TriedGarment
from capture4d.app.tryon.page import TryOnPage
from capture4d.app.tryon.session import Session
from capture4d.app.viewer.scenery import open_server
from capture4d.files.records import save_poses
from tests.unit.retarget.conftest import some_motion
from tests.waiting import until

Open = Callable[..., TryOnPage]


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[Open]:
    """Pages, which are closed at the end."""
    pytest.importorskip("viser", reason="viser is not installed: the page is not looked at")
    closing: list[tuple[TryOnPage, Any]] = []

    def serve(tried: TriedGarment, *clips: Path) -> TryOnPage:
        server = open_server("127.0.0.1", 8430, "test")
        page = TryOnPage(server, Session(tried), clips, tmp_path / "exports", TryOnConfig(rest_after_s=0.1))
        closing.append((page, server))
        return page

    yield serve
    for page, server in closing:
        page.close()
        server.stop()


def test_sliders_pose_and_shape_and_style(opened: Open, styled: TriedGarment):
    page = opened(styled)
    assert until(lambda: page.is_resting)
    session = Session(styled)
    np.testing.assert_allclose(page._cloth.vertices, session.resting().vertices, atol=1e-5)
    page._turns["knee z"].value = 400.0  # as if it had been typed
    page._styles["length"].value = 0.7
    assert until(lambda: page.is_resting and page._session.style == {"length": 0.7})
    limit = next(each.high for each in session.sliders.sliders if each.name == "knee z")
    session.dress(session.beta, {"length": page._styles["length"].value})
    session.pose({"knee z": limit})
    assert until(lambda: page.is_resting and np.allclose(page._cloth.vertices, session.resting().vertices, atol=1e-5))
    assert "0.00 % inside" in page._said.content


def test_a_clip_is_played_and_written(opened: Open, tried: TriedGarment, tmp_path: Path):
    save_poses(tmp_path / "dance.npz", some_motion(10, 3))
    page = opened(tried, tmp_path / "dance.npz")
    page._motion.value = "dance.npz"
    assert until(lambda: not page._play.disabled)
    page._play.value = True
    seen = set()
    assert until(lambda: seen.add(page._row) or len(seen) > 4)
    page._play.value = False
    assert until(lambda: page.is_resting)
    page._wanted("_export")
    assert until(lambda: "10 frames" in page._written.content)
    assert (tmp_path / "exports" / "001" / "registration" / "vertices.npy").is_file()


def test_a_clip_that_cannot_be_read_is_said(opened: Open, tried: TriedGarment, tmp_path: Path):
    (tmp_path / "broken.npz").write_bytes(b"no")
    page = opened(tried, tmp_path / "broken.npz")
    page._motion.value = "broken.npz"
    assert until(lambda: "broken.npz" in page._said.content)
    page._motion.value = "sliders"
    assert until(lambda: "at rest" in page._said.content)
