"""Learned colours are kept while nothing but scans comes and goes, said, renewed when asked for, and taken over."""

import json
import shutil
from pathlib import Path

import pytest

from capture4d import pipeline
from capture4d.captures.capture import read_capture
from capture4d.captures.take_colours import described_colours, kept_colours, read_colours, take_colours
from capture4d.errors import InputError
from capture4d.files.atomic import read_json, write_json
from tests.command_line import fails, run


@pytest.fixture
def unknown(tube_capture: Path) -> Path:
    """The tube, its colours and its frames not told; frame 7 comes later."""
    said = json.loads((tube_capture / "capture.json").read_text())
    write_json(tube_capture / "capture.json", {"format": 1, "fps": said["fps"]})
    (tube_capture / "scans" / "000007.ply").rename(tube_capture / "later.ply")
    return tube_capture


def grown(capture: Path) -> Path:
    shutil.copy(capture / "later.ply", capture / "scans" / "000007.ply")
    return capture


def frames(work: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in (work / "garment" / "frames").iterdir()}


def test_colours_are_written_down_exactly(unknown: Path, tmp_path: Path):
    colours = take_colours(read_capture(unknown))
    write_json(tmp_path / "colours.json", described_colours(colours))
    again = read_colours(tmp_path / "colours.json")
    assert (again.garment, again.boundary, again.others) == (colours.garment, colours.boundary, colours.others)
    assert again.light is not None
    assert colours.light is not None
    assert again.light.coefficients.tolist() == colours.light.coefficients.tolist()
    assert (again.light.centre.tolist(), again.light.size_m) == (colours.light.centre.tolist(), colours.light.size_m)


def test_colours_are_kept_when_frames_come_and_renewed_when_asked_for(
    unknown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    work = tmp_path / "work"
    command = ("extract", unknown, "--output", work, "--workers", "1")
    assert run(*command) == 0
    learned, before = read_json(work / "garment" / "colours.json"), frames(work)
    assert learned["frames"] == "5-6"
    capsys.readouterr()
    grown(unknown)
    assert run(*command) == 0
    said = capsys.readouterr().err
    assert "garment: frame 7 added" in said
    assert "garment: the colours are kept as frames 5-6 gave them; --renew colours learns them anew" in said
    assert read_json(work / "garment" / "colours.json") == learned
    assert {name: frames(work)[name] for name in before} == before

    scratch = tmp_path / "scratch"
    pipeline.take_over(scratch, work)
    assert pipeline.extract(unknown, scratch).digest == read_json(work / "garment" / "stage.json")["digest"]
    assert kept_colours(read_capture(unknown), scratch / "garment") is not None

    assert run(*command, "--renew", "colours") == 0
    anew = read_json(work / "garment" / "colours.json")
    assert anew["frames"] == "5-7"
    assert pipeline.extract(unknown, tmp_path / "fresh").digest == read_json(work / "garment" / "stage.json")["digest"]
    assert "--renew: expected shape or colours, found 'hue'" in fails(capsys, *command, "--renew", "hue")


def test_what_is_said_of_colours_decides_whether_they_are_kept(unknown: Path, tmp_path: Path):
    pipeline.extract(unknown, tmp_path)
    garment = tmp_path / "garment"
    assert kept_colours(read_capture(unknown), garment) is not None
    said = read_json(unknown / "capture.json")
    write_json(unknown / "capture.json", {**said, "boundary_colours": {"hem": "#ffd200", "neck": "#ffd200"}})
    assert kept_colours(read_capture(unknown), garment) is None


def test_there_is_nothing_to_take_over_from_an_empty_folder(tmp_path: Path):
    with pytest.raises(InputError, match="expected a work folder with a shape or colours, found none"):
        pipeline.take_over(tmp_path / "work", tmp_path)
