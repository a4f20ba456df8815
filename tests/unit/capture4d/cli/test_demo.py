"""The end of the demo, on a small garment: maps, colours, a file for Blender and a page that the report shows."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from capture4d.app.export import stage
from capture4d.app.report.moving import exported_page, shows_it
from capture4d.cli.commands.synthesis import hand_on
from capture4d.files.atomic import read_json, write_bytes
from tests.moving_garment import write_moving_work
from tests.moving_wrinkles import write_wrinkle_model


@pytest.mark.parametrize("with_usd", [True, False])
def test_the_garment_goes_out_with_maps_colours_and_a_page(
    with_usd: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    if with_usd and stage.default_format() != "usd":
        pytest.skip("usd-core is not installed")
    if not with_usd:
        monkeypatch.setattr(stage, "is_installed", lambda package: False)
    work = tmp_path / "other"
    write_moving_work(work, 3)
    write_wrinkle_model(tmp_path / "model")
    pixels = np.full((32, 32, 3), (30, 90, 160), np.uint8)
    write_bytes(tmp_path / "albedo.png", cv2.imencode(".png", pixels)[1].tobytes())
    assert exported_page(work) is None
    exports = hand_on(work, tmp_path / "model", tmp_path / "albedo.png", workers=1)
    names = {path.name for path in exports.iterdir()}
    assert {"garment.html", "open_in_blender.py", "albedo.png", "normals"} <= names
    assert ("garment.usdc" if with_usd else "garment.glb") in names
    told = read_json(exports / "export.json")
    assert told["frames"] == [1, 2, 3]
    page = exported_page(work)
    assert page is not None
    assert (work / "report" / page).resolve() == (exports / "garment.html").resolve()
    (work / "report").mkdir()
    for shown, html in ((False, "<p>stills</p>"), (True, f'<iframe src="{page}"></iframe>')):
        (work / "report" / "index.html").write_text(html)
        assert shows_it(work / "report", page) is shown
        assert shows_it(work / "report", None) is not shown
