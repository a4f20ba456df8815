"""What would stop a run after hours is said before its first frame."""

from __future__ import annotations

import json
import shutil
from collections import namedtuple
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.captures.capture import read_capture
from capture4d.files.atomic import write_json
from capture4d.files.records import load_garment, save_garment
from capture4d.preflight.readiness import pattern_told
from capture4d.types import Mesh
from tests.command_line import fails, run


def described(capture: Path, **entries: object) -> None:
    description = json.loads((capture / "capture.json").read_text())
    write_json(capture / "capture.json", {**description, **entries})


def test_names_of_paints_are_asked_for_at_once(
    tube_capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    work = tmp_path / "work"
    paints = json.loads((tube_capture / "capture.json").read_text())["boundary_colours"]
    first, second = (f"#{value:06x}" for value in (0xFFC400, 0xC81E96))
    described(tube_capture, boundary_colours={"waist": first, "neck": second})
    said = fails(capsys, "run", tube_capture, "--output", work)
    assert "capture.json: boundary_colours: expected paints named as the template's borders (" in said
    assert said.endswith("found waist")
    assert not work.exists()
    for names in ({"border": first}, {"paint_0": first, "paint_1": second}, {"waist": first, "knee": first}, paints):
        described(tube_capture, boundary_colours=names)
        assert "boundary_colours" not in _stopped_by_the_disk(capsys, tube_capture, work)


def _stopped_by_the_disk(capsys: pytest.CaptureFixture[str], capture: Path, work: Path) -> str:
    with pytest.MonkeyPatch.context() as patched:
        Usage = namedtuple("Usage", "total used free")
        patched.setattr(shutil, "disk_usage", lambda _: Usage(1, 1, 0))
        return fails(capsys, "run", capture, "--output", work)


def test_a_full_disk_is_told(tube_capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = _stopped_by_the_disk(capsys, tube_capture, tmp_path / "new" / "work")
    assert f"{tmp_path}" in said.split(": ")[0]
    assert ": expected at least " in said
    assert said.endswith("GB free for 3 frames, found 0 GB")
    assert not (tmp_path / "new").exists()


def test_a_template_without_borders_or_for_another_body(
    tube_capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    template, path = load_garment(tube_capture / "template.npz"), tube_capture / "template.npz"
    command = ("run", tube_capture, "--output", tmp_path / "work")
    save_garment(path, replace(template, loops={}))
    assert "template.npz: expected a template with open borders, as its scans have; found none" in fails(
        capsys, *command
    )
    weights = np.full((len(template.template.vertices), 7), 1 / 7, np.float32)
    save_garment(path, replace(template, skin_weights=weights))
    said = fails(capsys, *command)
    assert "template.npz: expected skin weights for the body's " in said
    assert said.endswith("found 7; it was bound to another body")
    (tmp_path / "work").write_text("a file")
    save_garment(path, template)
    assert "work" in fails(capsys, *command)


def test_other_settings_than_before_are_refused_before_the_first_stage(
    tube_capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    work = tmp_path / "work"
    command = ("run", tube_capture, "--output", work, "--workers", "1")
    described(tube_capture, boundary_colours={"border": "#ffd200"})  # as check --fix writes before there is a template
    assert run(*command, "--registration.graph.nodes", "20") == 0
    assert "template.npz: it has no UVs; the cloth has the lengths of the mesh" in capsys.readouterr().out

    def extract(*_: object, **__: object) -> None:
        raise AssertionError("extracted first")

    monkeypatch.setattr("capture4d.pipeline.extract", extract)
    said = fails(capsys, *command, "--registration.graph.nodes", "30")
    assert "nodes 20 to 30" in said
    assert "with --overwrite the same command makes it anew" in said


def test_where_lengths_come_from_is_said(tube_capture: Path) -> None:
    path = tube_capture / "template.npz"
    template = load_garment(path)
    mesh = _with_uv(template.template)
    for garment, said in (
        (replace(template, template=replace(template.template, uv=None)), "it has no UVs; the cloth has the lengths"),
        (replace(template, pattern_metres=0.0, template=mesh), "said to be no sewing pattern"),
        (
            replace(template, pattern_metres=1.0, template=mesh),
            "a sewing pattern in metres, from",
        ),
        (replace(template, pattern_metres=0.27, template=mesh), "with 0.27 m in a unit, from"),
        (replace(template, pattern_metres=None, template=mesh), "no sewing pattern ("),
    ):
        save_garment(path, garment)
        assert said in pattern_told(read_capture(tube_capture))


def _with_uv(mesh: Mesh) -> Mesh:
    corners = mesh.vertices[mesh.faces]
    return replace(mesh, uv=(corners[..., :2] * (0.5, 1.0) + np.arange(len(corners))[:, None, None]).astype(np.float32))
