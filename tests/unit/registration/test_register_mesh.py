"""Any template on any scan: units, order, borders, refusals."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from capture4d.errors import InputError
from capture4d.extraction.garment import painted_border
from capture4d.mesh_files.meshes import read_mesh, write_mesh
from capture4d.types import Mesh
from registration.config import SOFT, MeshRegistrationConfig, QualityConfig, Schedule
from registration.register_mesh import guess_units, register_mesh, run

PAINT = (255, 210, 0)


@pytest.fixture
def quick() -> MeshRegistrationConfig:
    """Fewer steps, straight to the way that grows and shrinks: `swell` makes another garment of the template."""
    soft = replace(
        SOFT,
        graph=replace(SOFT.graph, nodes=40),
        coarse=replace(SOFT.coarse, cold=replace(SOFT.coarse.cold, steps=12)),
        dense=replace(SOFT.dense, cold=replace(SOFT.dense.cold, steps=8)),
    )
    return MeshRegistrationConfig(lengths="free", soft=soft)


def swell(points: np.ndarray) -> np.ndarray:
    return points * [1.1, 1.04, 1.0] + np.column_stack([0.02 * np.sin(8 * points[:, 1]), 0 * points[:, :2]])


def scaled(mesh: Mesh, factor: float) -> Mesh:
    return mesh.with_vertices((factor * mesh.vertices).astype(np.float32))


def test_millimetres_and_metres_give_the_same_result(garment, scan_of, quick) -> None:
    template, scan = garment.template, scan_of(swell).mesh
    metres = register_mesh(template, scan, config=quick)
    millimetres = register_mesh(scaled(template, 1000), scaled(scan, 1000), config=quick)
    change = np.linalg.norm(millimetres.vertices / 1000 - metres.vertices, axis=1)
    moved = np.linalg.norm(metres.vertices - template.vertices, axis=1)
    assert change.mean() < 0.01 * moved.mean()
    for key in ("fit_mean_mm", "scan_fit_mean_mm"):
        assert millimetres.quality.numbers[key] == pytest.approx(metres.quality.numbers[key], rel=0.01)


def test_the_template_keeps_its_order_and_faces(garment, scan_of, quick, tmp_path: Path) -> None:
    write_mesh(tmp_path / "template.obj", garment.template)
    write_mesh(tmp_path / "scan.ply", scan_of(swell).mesh)
    run(tmp_path / "template.obj", tmp_path / "scan.ply", tmp_path / "out.ply", quick)
    mesh = read_mesh(tmp_path / "out.ply").mesh
    np.testing.assert_array_equal(mesh.faces, garment.template.faces)
    truth = swell(garment.template.vertices.astype(float))
    assert np.linalg.norm(mesh.vertices - truth, axis=1).mean() < 0.01
    record = json.loads((tmp_path / "out.json").read_text())
    assert record["units"] == "m"
    assert record["cpu_s"] > 0
    assert record["fit_mean_mm"] < 1
    assert record["boundary_mean_mm"] is None


def test_painted_borders_are_measured(garment, scan_of, quick) -> None:
    scan = scan_of(swell).mesh
    colours = np.tile(np.array([[47, 98, 201]], np.uint8), (len(scan.vertices), 1))
    height = np.linspace(0, 1, 80)[:, None] * np.ones(160)
    colours[(height.reshape(-1) < 0.03) | (height.reshape(-1) > 0.97)] = PAINT
    result = register_mesh(
        garment.template,
        scan,
        colours=colours,
        find_border=painted_border,
        config=replace(quick, border_colour="ffd200", units="m"),
    )
    assert result.quality.numbers["boundary_mean_mm"] < 4


def test_paint_may_be_in_a_texture(garment, scan_of, quick, tmp_path: Path) -> None:
    scan = scan_of(swell).mesh
    height = scan.vertices[:, 1] - scan.vertices[:, 1].min()
    v = (height / height.max())[scan.faces]
    picture = np.full((200, 4, 3), (47, 98, 201), np.uint8)
    picture[:6] = picture[-6:] = PAINT
    Image.fromarray(picture).save(tmp_path / "t.png")
    write_mesh(tmp_path / "template.obj", garment.template)
    write_mesh(tmp_path / "scan.obj", Mesh(scan.vertices, scan.faces, np.stack([0 * v + 0.5, v], axis=2)))
    (tmp_path / "scan.mtl").write_text("newmtl a\nmap_Kd t.png\n")
    text = (tmp_path / "scan.obj").read_text()
    (tmp_path / "scan.obj").write_text("mtllib scan.mtl\nusemtl a\n" + text)
    painted = replace(quick, border_colour="ffd200", units="m")
    files = tmp_path / "template.obj", tmp_path / "scan.obj", tmp_path / "out.ply"
    result = run(*files, painted, find_border=painted_border)
    assert result.quality.numbers["boundary_mean_mm"] < 4
    assert result.notes == ()
    # A face of another material, which no file has.
    (tmp_path / "scan.obj").write_text("mtllib scan.mtl\nusemtl a\n" + text + "usemtl b\nf 1/1 2/2 3/3\n")
    noted = run(*files, painted, find_border=painted_border, overwrite=True).notes
    assert noted == (f"{tmp_path / 'scan.obj'}: no material 'b' in scan.mtl",)


def test_cloth_of_the_colour_of_the_paint_has_no_borders_and_says_so(garment, scan_of, quick, tmp_path: Path) -> None:
    scan = scan_of(swell).mesh
    colours = np.tile(np.array([PAINT], np.uint8), (len(scan.vertices), 1))
    painted = replace(quick, border_colour="ffd200", units="m")
    result = register_mesh(garment.template, scan, colours=colours, find_border=painted_border, config=painted)
    bare = register_mesh(garment.template, scan, config=replace(quick, units="m"))
    np.testing.assert_array_equal(result.vertices, bare.vertices)
    assert bare.notes == ()
    (note,) = result.notes
    assert note.startswith("no border is found by its paint #ffd200")
    write_mesh(tmp_path / "template.ply", garment.template)
    write_mesh(tmp_path / "scan.ply", scan, colours=colours)
    files = tmp_path / "template.ply", tmp_path / "scan.ply", tmp_path / "out.ply"
    assert run(*files, painted, find_border=painted_border).notes == (f"{files[1]}: {note}",)


def test_alignment_comes_first_when_asked_for(garment, scan_of, quick) -> None:
    scan = scan_of(swell).mesh
    away = scan.with_vertices((scan.vertices + np.array([2.0, 0, 0])).astype(np.float32))
    with pytest.raises(InputError, match="expected scan vertices within"):
        register_mesh(garment.template, away, config=replace(quick, align="none"))
    for align in ("auto", "rigid"):
        result = register_mesh(garment.template, away, config=replace(quick, align=align))
        assert result.quality.numbers["fit_mean_mm"] < 1


def test_refusals(garment, scan_of, quick) -> None:
    template, scan = garment.template, scan_of(swell).mesh
    painted = replace(quick, border_colour="ffd200")
    with pytest.raises(InputError, match=r"scan: expected a colour per vertex"):
        register_mesh(template, scan, config=painted)
    grey = np.full((len(scan.vertices), 3), 128, np.uint8)
    with pytest.raises(InputError, match=r"border colour #ffd200 not found"):
        register_mesh(template, scan, colours=grey, find_border=painted_border, config=painted)
    with pytest.raises(InputError, match=r"expected the unit of template"):
        register_mesh(template, scaled(scan, 1000), config=quick)
    closed = Mesh(np.eye(4, 3, dtype=np.float32), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32))
    paint = np.tile(np.array([PAINT], np.uint8), (len(scan.vertices), 1))
    with pytest.raises(InputError, match="expected open borders"):
        register_mesh(closed, scan, colours=paint, find_border=painted_border, config=painted)


def test_units_are_guessed_from_size(garment) -> None:
    assert [guess_units(scaled(garment.template, factor)) for factor in (1, 100, 1000)] == ["m", "cm", "mm"]


@pytest.mark.parametrize("metres", [0.9, 1.2, 1.4])
def test_a_shirt_has_its_unit_guessed(garment, metres: float) -> None:
    diagonal = np.linalg.norm(np.ptp(garment.template.vertices, axis=0))
    shirt = scaled(garment.template, metres / diagonal)
    assert [guess_units(scaled(shirt, factor)) for factor in (1, 100, 1000)] == ["m", "cm", "mm"]


def test_reasons_give_the_lengths_of_the_files_world(garment, scan_of, quick) -> None:
    """Limits are made for a shirt; for a thing of half its size they count half, as what they are held against does."""
    strict = replace(quick, registration=replace(quick.registration, quality=QualityConfig(fit_check_mm=1e-6)))
    template, scan = garment.template, scan_of(swell).mesh
    for units, factor in {"m": 1.0, "cm": 100.0, "in": 1 / 0.0254}.items():
        quality = register_mesh(
            scaled(template, factor), scaled(scan, factor), config=replace(strict, units=units)
        ).quality
        (reason,) = [reason for reason in quality.reasons if reason.startswith("fit_mean_mm")]
        value, limit = (float(text) for text in re.findall(r"[\d.e-]+(?= >| mm)", reason))
        assert value == pytest.approx(quality.numbers["fit_mean_mm"], rel=0.06)
        size = np.linalg.norm(np.ptp(template.vertices, axis=0))
        assert limit == pytest.approx(1e-6 * size / 1.2, rel=0.01)


def test_schedules_anneal_geometrically() -> None:
    from registration.register import anneal

    schedule = Schedule(3, (0.1, 0.001))
    assert [anneal(schedule.gate, step, 3) for step in range(3)] == pytest.approx([0.1, 0.01, 0.001])
    assert anneal((0.0, 4.0), 1, 3) == 2.0


def split_at_seams(mesh: Mesh) -> Mesh:
    """As a file has it that keeps texture coordinates per vertex: three charts, no vertex in two of them."""
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    chart = (middle[:, 0] > 0) + 2 * (middle[:, 1] > 0.3)
    keys, corners = np.unique(mesh.faces * 4 + chart[:, None], return_inverse=True)
    return Mesh(mesh.vertices[keys // 4], corners.reshape(-1, 3).astype(np.int32))


@pytest.mark.parametrize("kind", ["ply", "obj", "glb"])
def test_seams_of_a_template_stay_closed_bit_for_bit(kind: str, garment, scan_of, quick, tmp_path: Path) -> None:
    import trimesh

    whole = garment.template
    parts = split_at_seams(whole)
    trimesh.Trimesh(parts.vertices, parts.faces, process=False).export(tmp_path / f"template.{kind}")
    parts = read_mesh(tmp_path / f"template.{kind}").mesh
    write_mesh(tmp_path / "scan.ply", scan_of(swell).mesh)
    result = run(tmp_path / f"template.{kind}", tmp_path / "scan.ply", tmp_path / "out.ply", quick)
    found = read_mesh(tmp_path / "out.ply").mesh
    np.testing.assert_array_equal(found.faces, parts.faces)
    assert len(found.vertices) == len(parts.vertices) > len(whole.vertices)
    for values in (found.vertices, result.start, result.quality.residual_m, result.quality.stretch):
        for place in np.unique(parts.vertices, axis=0)[::5]:
            here = values[(parts.vertices == place).all(axis=1)]
            assert len({value.tobytes() for value in here}) == 1
    unsplit = register_mesh(whole, scan_of(swell).mesh, config=quick)
    assert result.quality.numbers["fit_mean_mm"] == pytest.approx(unsplit.quality.numbers["fit_mean_mm"], rel=0.15)


@pytest.mark.parametrize("kind", ["ply", "obj"])
def test_a_scan_may_be_points_alone(kind: str, garment, scan_of, quick, tmp_path: Path) -> None:
    write_mesh(tmp_path / "template.obj", garment.template)
    scan = scan_of(swell, noise=0.0003).mesh
    write_mesh(tmp_path / "mesh.ply", scan)
    write_mesh(tmp_path / f"cloud.{kind}", Mesh(scan.vertices, scan.faces[:0]))
    truth, off = swell(garment.template.vertices.astype(float)), {}
    for name in ("mesh.ply", f"cloud.{kind}"):
        result = run(tmp_path / "template.obj", tmp_path / name, tmp_path / "out.ply", quick, overwrite=True)
        off[result.estimated] = np.linalg.norm(result.vertices - truth, axis=1).mean()
        told = json.loads((tmp_path / "out.json").read_text())["scan_faces"]
        assert told == ("estimated" if result.estimated else "given")
    assert off[True] < 1.15 * off[False]
    write_mesh(tmp_path / "few.ply", Mesh(scan.vertices[:40], scan.faces[:0]))
    with pytest.raises(InputError, match=r"few\.ply: expected a mesh, or a cloud of at least 100 points"):
        run(tmp_path / "template.obj", tmp_path / "few.ply", tmp_path / "none.ply", quick)
    with pytest.raises(InputError, match=r"cloud\.\w+: empty mesh, found \d+ vertices and no faces"):
        run(tmp_path / f"cloud.{kind}", tmp_path / "mesh.ply", tmp_path / "none.ply", quick)
