"""The page of a check: every finding with its frames as ranges, escaped, and what was measured."""

from pathlib import Path

import pytest

from capture4d.app.report.check import LEARNED, status, write_page
from capture4d.preflight.check import Checked
from capture4d.preflight.findings import Finding, Verdict
from capture4d.preflight.take_folder import Claims, open_take


def checked(folder: Path, verdict: Verdict, **claims: str) -> Checked:
    """A take of 20 scans, of which 12 were looked at."""
    take = folder / "<take>"
    take.mkdir()
    for frame_id in range(20):
        (take / f"{frame_id:03d}.ply").touch()
    return Checked(open_take(take, Claims(**claims)), None, verdict, 12, rig_moves=False, rate=None)


@pytest.fixture
def finding() -> Finding:
    return Finding("frame-empty", "no <faces>", 3.0, (3, 4, 5, 9))


def test_findings_are_shown_with_their_frames(tmp_path: Path, finding: Finding) -> None:
    verdict = Verdict((finding,), {"units": 0.2, "frame-empty": 3.0})
    page = write_page(tmp_path / "check.html", checked(tmp_path, verdict, garment_colour="#2f62c9")).read_text()
    assert "3-5, 9" in page
    assert "no &lt;faces&gt;" in page
    assert "&lt;take&gt;" in page
    assert '<span class="badge failed">errors</span> 12 of 20 frames looked at' in page
    assert page.index('<td>frame-empty</td><td class="number">3.00</td>') < page.index("<td>units</td>")
    assert LEARNED not in page


def test_a_clean_take_says_so(tmp_path: Path) -> None:
    verdict = Verdict((), {"units": 0.2})
    page = write_page(tmp_path / "check.html", checked(tmp_path, verdict)).read_text()
    assert status(verdict) == "clean"
    assert '<span class="badge good">clean</span>' in page
    assert "Nothing was found." in page
    assert LEARNED[:40] in page
