"""Colours learned from a painted tube on a suit, in lights that would fool a fixed colour."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture4d.captures.capture import read_capture, read_scan, scan_path
from capture4d.captures.garment_scans import load_garment_scan
from capture4d.captures.points.sampling import SamplingConfig
from capture4d.captures.points.scan_points import ScanPoints, label_scan, scan_points
from capture4d.captures.take_colours import take_colours
from capture4d.colours.learning import ColoursNotSeparableError, fit_light, learn_colours
from capture4d.colours.spaces import encode_colours, linear_colours
from capture4d.extraction.garment import extract_garment
from capture4d.extraction.stage import ExtractionSettings, run
from capture4d.geometry.mesh import vertex_normals
from capture4d.mesh_files.meshes import read_coloured_mesh
from capture4d.types import Mesh, Scan
from tests.shapes import tube_faces

AROUND, ALONG = 140, 160
PALETTES = {  # cloth, paint, suit, skin
    "blue": ((47, 98, 201), (255, 196, 0), (150, 152, 156), (214, 168, 140)),
    "red": ((186, 52, 58), (52, 178, 96), (92, 92, 100), (150, 105, 80)),
    "olive": ((118, 128, 58), (232, 72, 160), (214, 212, 206), (190, 130, 100)),
}
BAND = 0.018


def dressed_tube(
    palette: str, seed: int, *, light: str = "even", painted: bool = True, bare: bool = True, noise: float = 3.0
) -> Scan:
    """A wobbly tube: suit, cloth between two bands of paint, suit, and skin on top."""
    rng = np.random.default_rng(seed)
    cloth, paint, suit, skin = PALETTES[palette]
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    height = np.linspace(-0.25, 0.65, ALONG)[:, None]
    radius = 0.14 + 0.012 * np.sin(5 * angle + rng.uniform(0, 6)) * np.cos(9 * height) + 0.03 * height
    vertices = np.stack(
        [radius * np.sin(angle), np.broadcast_to(height, radius.shape), radius * np.cos(angle)], axis=-1
    ).reshape(-1, 3)
    mesh = Mesh(vertices.astype(np.float32), tube_faces(AROUND, ALONG))
    y = vertices[:, 1]
    colours = np.full((len(y), 3), suit, float)
    colours[(y > 0) & (y < 0.4)] = cloth
    if painted:
        colours[((y > 0) & (y < BAND)) | ((y > 0.4 - BAND) & (y < 0.4))] = paint
    if bare:
        colours[y > 0.55] = skin
    seen = linear_colours(colours) * light_on(mesh, light)
    noisy = encode_colours(seen).astype(float) + noise * rng.standard_normal(seen.shape)
    return Scan(mesh, np.clip(noisy, 0, 255).astype(np.uint8), seed, 0.0)


def light_on(mesh: Mesh, kind: str) -> np.ndarray:
    """Linear light per vertex and channel."""
    normals = vertex_normals(mesh.vertices, mesh.faces)
    side = normals[:, :1] * 0.5 + 0.5
    if kind == "side":
        return 0.15 + 0.8 * side**2 * np.ones(3)
    if kind == "two-temperature":
        return 0.2 + 0.7 * (side * np.array([1.0, 0.85, 0.64]) + (1 - side) * np.array([0.66, 0.8, 1.0]))
    return 0.9 * np.ones((len(normals), 3))


def angle_to(colour: tuple[int, int, int], other: tuple[int, int, int]) -> float:
    one, two = linear_colours(np.array([colour, other], float))
    return float(np.arccos(np.clip(one @ two / np.linalg.norm(one) / np.linalg.norm(two), -1, 1)))


@pytest.mark.parametrize("light", ["side", "two-temperature"])
@pytest.mark.parametrize("seed", [0, 1])
def test_light_is_divided_out_up_to_one_factor(light: str, seed: int) -> None:
    scan = dressed_tube("blue", seed, light=light, noise=0.3)
    found = fit_light([scan])
    flat = linear_colours(found.removed(scan.mesh, scan.colours))
    y = scan.mesh.vertices[:, 1]
    for part in ((y < -0.02), (y > 0.05) & (y < 0.35)):
        before = np.log(linear_colours(scan.colours)[part] + 0.004).std(axis=0)
        after = np.log(flat[part] + 0.004).std(axis=0)
        assert after.max() < 0.5 * before.max()
    assert (
        abs(np.log((flat[y < -0.02]).mean(axis=1)).mean() - np.log(flat[(y > 0.42) & (y < 0.54)].mean(axis=1)).mean())
        < 0.1
    )


@pytest.mark.parametrize("light", ["even", "side", "two-temperature"])
@pytest.mark.parametrize("palette", list(PALETTES))
def test_roles_are_found_without_labels(palette: str, light: str) -> None:
    scans = [dressed_tube(palette, seed, light=light) for seed in (3, 4)]
    found = learn_colours(scans)
    cloth, paint, suit, skin = PALETTES[palette]
    assert angle_to(found.garment, cloth) < 0.12
    assert len(found.paints) == 1
    assert angle_to(found.paints[0], paint) < 0.15
    for colour in (suit, skin):
        assert min(angle_to(other, colour) for other in found.others) < 0.12


@pytest.mark.parametrize("light", ["side", "two-temperature"])
@pytest.mark.parametrize("palette", list(PALETTES))
def test_learned_colours_cut_the_garment_out(palette: str, light: str) -> None:
    scan = dressed_tube(palette, 5, light=light)
    found = learn_colours([scan])
    flat = replace(scan, colours=found.light.removed(scan.mesh, scan.colours))
    garment = extract_garment(flat, found.garment, {"border": found.paints[0]}, other_colours=found.others)
    y = scan.mesh.vertices[:, 1]
    truth = (y > 0) & (y < 0.4)
    assert len(garment.mesh.vertices) == pytest.approx(truth.sum(), rel=0.02)
    error = np.minimum(np.abs(garment.boundary_points[:, 1]), np.abs(garment.boundary_points[:, 1] - 0.4))
    assert np.percentile(error, 95) < 0.006  # the samples are 5.7 mm apart


def test_a_given_colour_says_which_is_the_garment() -> None:
    scan = dressed_tube("blue", 6)
    cloth, paint, suit, _ = PALETTES["blue"]
    assert angle_to(learn_colours([scan], garment=suit, paints=()).garment, suit) < 0.1
    found = learn_colours([scan], paints=(paint,))
    assert angle_to(found.garment, cloth) < 0.1
    assert angle_to(found.paints[0], paint) < 0.15


def test_a_given_paint_may_be_rarer_than_any_colour() -> None:
    """Two in a thousand vertices wear it, in one patch; prints have so many colours that no more are left of it."""
    scan = dressed_tube("blue", 6)
    cloth, paint, _, _ = PALETTES["blue"]
    worn = np.array([angle_to(tuple(colour), paint) < 0.1 for colour in scan.colours.tolist()])
    places = scan.mesh.vertices[worn]
    far = np.linalg.norm(places - places[0], axis=1).argsort()[round(0.002 * len(worn)) :]
    colours = scan.colours.copy()
    colours[np.flatnonzero(worn)[far]] = cloth
    found = learn_colours([replace(scan, colours=colours)], garment=cloth, paints=(paint,))
    assert angle_to(found.paints[0], paint) < 0.15
    assert angle_to(found.garment, cloth) < 0.1


def test_without_paint_the_garment_has_the_most_neighbours() -> None:
    found = learn_colours([dressed_tube("red", 7, painted=False, bare=False)])
    assert found.paints == ()
    assert angle_to(found.garment, PALETTES["red"][0]) < 0.1


def test_what_cannot_be_told_apart_is_said_in_one_line() -> None:
    scan = dressed_tube("blue", 8)
    plain = replace(scan, colours=np.full_like(scan.colours, 120))
    with pytest.raises(
        ColoursNotSeparableError, match=r"take: the colours of garment and suit are not separable: found 1"
    ):
        learn_colours([plain], source="take")
    with pytest.raises(ColoursNotSeparableError, match=r"garment colour #ff00ff not found: .* found #"):
        learn_colours([scan], garment=(255, 0, 255))
    with pytest.raises(ColoursNotSeparableError, match="two of them are #"):
        learn_colours([scan], garment=(47, 98, 201), paints=((50, 100, 190),))
    halves = replace(
        scan, colours=np.where(scan.mesh.vertices[:, 1:2] < 0.2, (200, 40, 40), (40, 40, 200)).astype(np.uint8)
    )
    with pytest.raises(ColoursNotSeparableError, match=r"nothing tells the garment from the rest.*give garment_colour"):
        learn_colours([halves])


def without_colours(capture: Path) -> None:
    description = json.loads((capture / "capture.json").read_text())
    del description["garment_colour"], description["boundary_colours"]
    (capture / "capture.json").write_text(json.dumps(description))


def extract(capture: Path, output: Path, *, learn_colours: bool = False) -> None:
    run(read_capture(capture), output, ExtractionSettings(learn_colours=learn_colours))


def test_a_capture_without_colours_is_extracted_all_the_same(tube_capture: Path, tmp_path: Path) -> None:
    extract(tube_capture, tmp_path / "given")
    extract(tube_capture, tmp_path / "learned", learn_colours=True)
    without_colours(tube_capture)
    extract(tube_capture, tmp_path / "blind")
    for frame_id in read_capture(tube_capture).frame_ids:
        given, *others = (
            load_garment_scan(tmp_path / name / "frames" / f"{frame_id:06d}.npz", frame_id)
            for name in ("given", "learned", "blind")
        )
        for other in others:
            np.testing.assert_array_equal(other.mesh.vertices, given.mesh.vertices)
            np.testing.assert_array_equal(other.boundary_points, given.boundary_points)
            assert set(other.loop_names) == {"hem", "neck"}
    described = json.loads((tmp_path / "blind" / "colours.json").read_text())
    assert described["learned"]
    assert set(described["boundary_colours"]) == {"hem", "neck"}


@pytest.mark.parametrize("blind", [False, True])
def test_textured_scans_are_extracted_as_coloured_ones_are(tube_capture: Path, tmp_path: Path, blind: bool) -> None:
    """The same tubes with a picture of their paint, 64 by 512 pixels, instead of colours at the vertices."""
    extract(tube_capture, tmp_path / "coloured")
    capture = read_capture(tube_capture)
    for frame_id in capture.frame_ids:
        path = scan_path(capture, frame_id)
        write_textured(path, read_coloured_mesh(path).mesh)
        path.unlink()
    if blind:
        without_colours(tube_capture)
    extract(tube_capture, tmp_path / "textured")
    for frame_id in capture.frame_ids:
        coloured, textured = (
            load_garment_scan(tmp_path / name / "frames" / f"{frame_id:06d}.npz", frame_id)
            for name in ("coloured", "textured")
        )
        assert len(textured.mesh.vertices) == len(coloured.mesh.vertices)
        assert len(textured.boundary_points) == len(coloured.boundary_points) > 100
        height = textured.boundary_points[:, 1]
        assert np.minimum(np.abs(height), np.abs(height - 0.6)).max() < 0.009


def write_textured(path: Path, mesh: Mesh) -> None:
    """The mesh as obj with a texture: paint on the lowest and highest 12 of 600 mm."""
    rows = (np.arange(512) + 0.5) / 512 * 0.6
    picture = np.where(((rows < 0.012) | (rows > 0.588))[:, None], (255, 210, 0), (47, 98, 201)).astype(np.uint8)
    picture = np.repeat(picture[::-1, None], 64, axis=1)
    cv2.imwrite(str(path.with_suffix(".png")), picture[..., ::-1])
    path.with_suffix(".mtl").write_text(f"newmtl paint\nmap_Kd {path.stem}.png\n")
    lines = [f"mtllib {path.stem}.mtl", "usemtl paint"]
    lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"vt 0.5 {y / 0.6:.6f}" for y in mesh.vertices[:, 1].tolist()]
    lines += [f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in (mesh.faces + 1).tolist()]
    path.with_suffix(".obj").write_text("\n".join(lines) + "\n")


def test_tracking_sees_the_same_cloth_without_colours(tube_capture: Path) -> None:
    def points() -> ScanPoints:
        capture = read_capture(tube_capture)
        colours = take_colours(capture)
        flat = colours.flat(read_scan(capture, 6))
        return scan_points(flat, label_scan(flat, colours), SamplingConfig(), source="6")

    given = points()
    without_colours(tube_capture)
    blind = points()
    np.testing.assert_array_equal(blind.points, given.points)
    np.testing.assert_array_equal(blind.cloth, given.cloth)
