"""`view` and `tryon` in a real browser: the picture follows the controls. Pictures stay in pytest's folder, to be seen.

Needs viser, playwright and a Chromium (CHROMIUM=/usr/bin/chromium); without a graphics card it draws in software.
"""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from capture4d import pipeline
from tests.moving_garment import write_moving_work

CHROMIUM = os.environ.get("CHROMIUM", "/usr/bin/chromium")
PATIENCE_MS = 180_000
ROOT = Path(__file__).parents[2]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not all(map(importlib.util.find_spec, ("viser", "playwright"))) or not Path(CHROMIUM).is_file(),
        reason="viser, playwright or Chromium is absent: the pages are not looked at",
    ),
]

Look = Callable[[str], np.ndarray]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    options = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=CHROMIUM, args=options)
        yield found
        found.close()


@pytest.fixture
def served() -> Iterator[Callable[..., str]]:
    """Commands that serve a page, by their arguments; ended afterwards."""
    running: list[subprocess.Popen[str]] = []

    def serve(*arguments: str) -> str:
        command = [sys.executable, "-m", "capture4d", *arguments]
        running.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT))
        assert running[-1].stdout is not None
        for line in running[-1].stdout:
            found = re.search(r"page: (http://\S+)", line)
            if found:
                return found[1]
        raise AssertionError("no page was served")

    yield serve
    for each in running:
        each.kill()
        each.communicate()


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[Callable[[str], tuple[Any, Look]]]:
    """A page, and what takes a picture of it."""
    pages = []

    def open_page(address: str) -> tuple[Any, Look]:
        page = browser.new_page(viewport={"width": 900, "height": 600})
        page.set_default_timeout(PATIENCE_MS)
        page.goto(address)
        page.get_by_text("frame", exact=True).first.wait_for()
        pages.append(page)

        def look(name: str) -> np.ndarray:
            page.screenshot(path=tmp_path / f"{name}.png", timeout=PATIENCE_MS)
            picture = cv2.imread(str(tmp_path / f"{name}.png"))
            assert picture is not None
            return picture[160:, :500].astype(int)  # beside the controls, below what the browser warns of

        return page, look

    yield open_page
    for page in pages:
        page.close()


def until_changed(page: Any, look: Look, name: str, before: np.ndarray, least: float = 0.003) -> np.ndarray:
    """A picture in which a share of the pixels is another than before."""
    for _ in range(40):
        now = look(name)
        if (np.abs(now - before).max(axis=2) > 20).mean() > least:
            return now
        page.wait_for_timeout(1500)
    raise AssertionError(f"{name}: nothing has changed in the picture")


def settled(page: Any, look: Look, name: str) -> np.ndarray:
    """A picture that no longer changes, with something in it."""
    before = look(name)
    for _ in range(40):
        page.wait_for_timeout(2000)
        now = look(name)
        if np.array_equal(now, before) and now.std() > 5:
            return now
        before = now
    raise AssertionError(f"{name}: the picture does not come to rest, or is empty")


def type_frame(page: Any, frame: int) -> None:
    box = page.locator("input:visible").first
    box.fill(str(frame))
    box.press("Enter")


def test_an_animation_is_looked_through(served: Any, opened: Any, tmp_path: Path):
    write_moving_work(tmp_path / "work", 6, seed=4, first=10, maps=8)
    page, look = opened(served("view", str(tmp_path / "work"), "--port", "8451"))
    first = settled(page, look, "first frame")
    type_frame(page, 14)
    moved = until_changed(page, look, "moved", first)
    page.get_by_label("body", exact=True).first.click()
    until_changed(page, look, "with body", moved)
    page.get_by_text("curves", exact=True).first.click()
    assert page.locator("canvas").count() >= 2, "the scene, and the curves"
    look("curves")


def test_a_take_appears_while_it_is_registered(served: Any, opened: Any, tube_capture: Path, tmp_path: Path):
    pipeline.extract(tube_capture, tmp_path / "work")
    page, look = opened(served("view", str(tmp_path / "work"), "--port", "8455"))
    before = settled(page, look, "scan alone")
    pipeline.register(tube_capture, tmp_path / "work")
    page.get_by_label("registration", exact=True).first.wait_for()
    until_changed(page, look, "registered", before)


def test_two_works_stand_side_by_side(served: Any, opened: Any, tmp_path: Path):
    for name, seed in (("one", 1), ("other", 2)):
        write_moving_work(tmp_path / name, 4, seed=seed)
    arguments = ("view", str(tmp_path / "one"), "--beside", str(tmp_path / "other"), "--port", "8459")
    page, look = opened(served(*arguments))
    settled(page, look, "two works")
    assert page.get_by_text("one beside other").count() == 1
