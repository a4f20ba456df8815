"""Metashape's XML, against Metashape's own formulas written out."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture4d.cameras.exchange import convert_rig
from capture4d.cameras.metashape import read_metashape
from capture4d.cameras.projection import project_world
from capture4d.errors import InputError
from capture4d.files.records import load_rig

LENS = {"f": 900.0, "cx": 12.5, "cy": -7.25, "b1": 1.5, "k1": -0.08, "k2": 0.03, "k3": -0.01, "p1": 6e-4, "p2": -9e-4}
WIDTH, HEIGHT = 1280, 960


def numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.17g}" for value in np.ravel(values))


def calibration(lens: dict[str, float], kind: str = "frame", form: str = "adjusted") -> str:
    entries = "".join(f"<{name}>{value!r}</{name}>" for name, value in lens.items())
    resolution = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    return f'<calibration type="{kind}" class="{form}">{resolution}{entries}</calibration>'


def sensor(number: int, *calibrations: str, kind: str = "frame") -> str:
    head = f'<sensor id="{number}" label="lens {number}" type="{kind}"><resolution width="{WIDTH}" height="{HEIGHT}"/>'
    return head + "".join(calibrations) + "</sensor>"


def camera(number: int, place: np.ndarray | None, more: str = 'sensor_id="0" enabled="true"', label: str = "") -> str:
    inside = "" if place is None else f"<transform>{numbers(place)}</transform>"
    return f'<camera id="{number}" label="{label or f"cam {number}"}" {more}>{inside}</camera>'


def similarity(rotation: np.ndarray, translation: np.ndarray, scale: float) -> str:
    parts = (("rotation", rotation), ("translation", translation), ("scale", scale))
    return f"<transform>{''.join(f'<{name}>{numbers(np.array(part))}</{name}>' for name, part in parts)}</transform>"


def chunk(sensors: str, cameras: str, more: str = "", label: str = "Chunk 1") -> str:
    return f'<chunk label="{label}"><sensors>{sensors}</sensors>{more}<cameras>{cameras}</cameras></chunk>'


def document(path: Path, *chunks: str) -> Path:
    path.write_text(f'<?xml version="1.0" encoding="UTF-8"?>\n<document version="1.5.0">{"".join(chunks)}</document>')
    return path


def places(count: int) -> np.ndarray:
    rng = np.random.default_rng(2)
    found = np.tile(np.eye(4), (count, 1, 1))
    for place in found:
        place[:3, :3] = Rotation.from_rotvec(0.3 * rng.normal(size=3)).as_matrix()
        place[:3, 3] = rng.normal(size=3)
    return found


def metashape_pixel(point: np.ndarray, lens: dict[str, float], *, fisheye: bool) -> np.ndarray:
    """The manual's formulas, one point at a time; pixels from the corner of the image."""
    x, y = point[0] / point[2], point[1] / point[2]
    r = np.hypot(x, y)
    if fisheye:
        x, y = x * np.arctan(r) / r, y * np.arctan(r) / r
        r = np.hypot(x, y)
    k1, k2, k3, k4, p1, p2 = (lens.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6 + k4 * r**8
    bent_x = x * radial + p1 * (r**2 + 2 * x**2) + 2 * p2 * x * y
    bent_y = y * radial + p2 * (r**2 + 2 * y**2) + 2 * p1 * x * y
    u = WIDTH / 2 + lens.get("cx", 0.0) + bent_x * (lens["f"] + lens.get("b1", 0.0))
    return np.array([u, HEIGHT / 2 + lens.get("cy", 0.0) + bent_y * lens["f"]])


@pytest.mark.parametrize("kind", ["frame", "fisheye", "equidistant_fisheye"])
@pytest.mark.parametrize("where", ["chunk", "component", "nowhere"])
@pytest.mark.parametrize("folder", [False, True])
def test_points_fall_where_metashape_puts_them(tmp_path: Path, kind: str, where: str, folder: bool):
    fisheye = kind != "frame"
    lens = {k: v for k, v in LENS.items() if not (fisheye and k in ("p1", "p2"))} | ({"k4": 0.002} if fisheye else {})
    rotation, translation, scale = Rotation.from_rotvec([0.4, -1.0, 2.0]).as_matrix(), np.array([3.0, -2.0, 0.5]), 0.25
    if where == "nowhere":
        rotation, translation, scale = np.eye(3), np.zeros(3), 1.0
    T_local_camera = places(3)
    tag = 'sensor_id="0" component_id="7"' if where == "component" else 'sensor_id="0"'
    cameras = "".join(camera(index, place, tag) for index, place in enumerate(T_local_camera))
    placed = "" if where == "nowhere" else similarity(rotation, translation, scale)
    if where == "component":
        placed = f'<components><component id="7" label="Component 1">{placed}</component></components>'
    inside = f'<group id="0" label="ring">{cameras}</group>' if folder else cameras
    sensors = sensor(0, calibration({"f": 1.0}, kind, "initial"), calibration(lens, kind), kind=kind)
    rig, left_out = read_metashape(document(tmp_path / "cameras.xml", chunk(sensors, inside, placed)))
    assert (rig.names, left_out) == (("cam 0", "cam 1", "cam 2"), [])
    assert rig.lenses == ("fisheye" if fisheye else "brown",) * 3
    points = np.random.default_rng(0).uniform(-0.8, 0.8, (20, 3)) + np.array([0, 0, 2.0])
    for index, T in enumerate(T_local_camera):
        world = scale * (points @ T[:3, :3].T + T[:3, 3]) @ rotation.T + translation
        expected = np.array([metashape_pixel(point, lens, fisheye=fisheye) for point in points])
        np.testing.assert_allclose(project_world(rig, index, world)[0], expected - 0.5, atol=1e-8)


def test_what_is_left_out_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    from tests.command_line import run

    place = places(1)[0]
    cameras = [
        camera(0, place),
        camera(1, place, 'sensor_id="0" enabled="false"'),
        camera(2, place, 'sensor_id="0" enabled="0"'),
        camera(3, None),
        camera(4, None, 'sensor_id="0" master_id="0"'),
        camera(5, place, label="IMG_0001.JPG"),
    ]
    source = document(tmp_path / "c.xml", chunk(sensor(0, calibration(LENS)), "".join(cameras)))
    assert run("convert-rig", source, "--output", tmp_path / "rig.json", "--scale", "0.001") == 0
    said = capsys.readouterr().err
    assert "left out cam 1 (disabled), cam 2 (disabled), cam 3 (not aligned), cam 4 (placed by its" in said
    found = load_rig(tmp_path / "rig.json")
    assert found.names == ("cam 0", "IMG_0001")
    np.testing.assert_allclose(found.centres, 0.001 * np.stack([place[:3, 3]] * 2), atol=1e-12)


HERE = camera(0, np.eye(4))
LENSES = sensor(0, calibration(LENS))
TWINS = HERE + camera(1, np.eye(4), label="cam 0")


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("<document/>", "expected a Metashape document with a chunk, found <document>"),
        ("<kml><Folder/></kml>", "with a chunk, found <kml>"),
        ("<document><chunk>", r":1: not valid XML \("),
        ("<", r":1: not valid XML"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><document/>", "without a document type"),
        ("<!DOCTYPE a SYSTEM 'file:///etc/passwd'><a/>", "without a document type"),
        ("<a>" * 3000, "at most 50 elements inside each other"),
        (f"<document>{chunk('', camera(0, None))}</document>", "found none that is enabled and aligned"),
        (
            f"<document>{chunk('', HERE)}</document>",
            "camera 'cam 0': expected its sensor 0, found none",
        ),
        (f"<document>{chunk(sensor(0), HERE)}</document>", "sensor 'lens 0': expected a calibration"),
        (
            f"<document>{2 * chunk(LENSES, HERE)}</document>",
            "expected one chunk with aligned cameras, found 'Chunk 1', 'Chunk 1'",
        ),
        (
            f"<document>{chunk(LENSES, camera(0, np.eye(3)))}</document>",
            "camera 'cam 0': expected 16 finite numbers as transform",
        ),
        (
            f"<document>{chunk(LENSES, camera(0, np.full((4, 4), np.nan)))}</document>",
            "expected 16 finite numbers",
        ),
        (
            f"<document>{chunk(LENSES, camera(0, np.diag([2.0, 1, 1, 1])))}</document>",
            "camera 'cam 0': expected a rotation in T_camera_world",
        ),
        (
            f"<document>{chunk(LENSES, TWINS)}</document>",
            "images with different names, found 'cam 0' twice",
        ),
        (
            "<document>"
            + chunk(
                sensor(0, calibration(LENS)),
                camera(0, np.eye(4), 'sensor_id="0" component_id="0"')
                + camera(1, np.eye(4), 'sensor_id="0" component_id="1"'),
                '<components><component id="0" label="A"/><component id="1" label="B"/></components>',
            )
            + "</document>",
            "expected cameras of one component, found some of 'A', 'B'",
        ),
        *(
            (f"<document>{chunk(sensor(0, calibration(LENS | extra, kind)), HERE)}</document>", fault)
            for extra, kind, fault in [
                ({"b2": 0.1}, "frame", "sensor 'lens 0': expected no b2 of a frame camera"),
                ({"k4": 0.1}, "frame", "expected no k4 of a frame camera"),
                ({"p3": 0.1}, "frame", "expected no p3"),
                ({}, "fisheye", "expected no p1 of a fisheye camera"),
                ({}, "spherical", "expected a camera of frame, fisheye, equidistant_fisheye, found 'spherical'"),
                ({"f": -3.0}, "frame", "camera 'cam 0': expected positive focal lengths"),
                ({"k1": float("nan")}, "frame", "expected 1 finite numbers as k1"),
            ]
        ),
    ],
)
def test_what_cannot_be_meant_is_one_line(tmp_path: Path, text: str, fault: str):
    path = tmp_path / "cameras.xml"
    path.write_text(text)
    with pytest.raises(InputError, match=fault) as caught:
        read_metashape(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError):
        convert_rig(path, tmp_path / "rig.json")
    assert not (tmp_path / "rig.json").exists()


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_any_encoding_of_xml_will_do_and_hides_no_document_type(tmp_path: Path, encoding: str):
    path = tmp_path / "cameras.xml"
    inside = chunk(LENSES, camera(0, np.eye(4), label="Kamera_ä"))
    path.write_bytes(f"<document>{inside}</document>".encode(encoding))
    convert_rig(path, tmp_path / "rig.json")
    assert load_rig(tmp_path / "rig.json").names == ("Kamera_ä",)
    path.write_bytes(f"<!DOCTYPE a [<!ENTITY b 'c'>]><document>{inside}</document>".encode(encoding))
    with pytest.raises(InputError, match="without a document type"):
        read_metashape(path)
