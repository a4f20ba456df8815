import json
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.app.drawing.charts import Line, line_chart, nice_ticks
from capture4d.app.drawing.panels import Panel, data_uri, write_panel
from capture4d.app.report.metrics import summarise
from capture4d.app.report.take import ReportConfig, run
from capture4d.body.anny import load_anny
from capture4d.captures.capture import Capture, read_capture, write_capture_description, write_scan
from capture4d.captures.truth import TruthFrame, TruthModel, write_truth_frame, write_truth_model
from capture4d.captures.work_folder import open_work
from capture4d.errors import InputError
from capture4d.files.atomic import write_bytes, write_json, write_npy, write_npz
from capture4d.files.records import save_body, save_garment, save_poses
from capture4d.geometry.mesh import boundary_loops
from capture4d.runs.stage import StageResult, open_stage
from capture4d.types import Garment, Mesh, PoseSequence, Scan
from tests.shapes import tube

FRAMES = 8


def record(index, **changes):
    return {
        "frame_id": index, "verdict": "good", "reasons": [], "fit_mean_mm": 0.5, "fit_p95_mm": 1.0,
        "boundary_mean_mm": None, "stretch_p99": 1.1, "cpu_s": 0.2 + 0.1 * (index == 0),
        "regions": {"left armpit": {"fit_p95_mm": 0.4, "fit_max_mm": 3.0, "fit_beyond_percent": 1.0,
                                    "cut_percent": 17.5, "creased_percent": 9.0, "covered_percent": 71.0}}, **changes,
    }  # fmt: skip


@pytest.fixture
def work(tmp_path):
    """A finished registration that lies a growing distance above the truth, whose scan is the truth."""
    mesh = tube(20, 12, 0.2, 0.6)
    loops = {f"border_{i}": loop for i, loop in enumerate(boundary_loops(mesh.faces))}
    capture = Capture(tmp_path / "capture", "tube", 60.0, tuple(range(FRAMES)), (47, 98, 201), {})
    write_capture_description(capture)
    first = mesh.faces[:, 0]
    owner = np.array([np.flatnonzero((mesh.faces == v).any(axis=1))[0] for v in range(len(mesh.vertices))], np.int32)
    barycentric = (mesh.faces[owner] == np.arange(len(mesh.vertices))[:, None]).astype(np.float32)
    write_truth_model(tmp_path / "capture" / "truth" / "model.npz", TruthModel(mesh, loops, owner, barycentric))
    stage = open_stage(tmp_path / "registration", name="register", schema=1, config=ReportConfig(), upstream={})
    vertices, lines = [], []
    for index in range(FRAMES):
        truth = mesh.vertices + np.float32(0.1 * index)
        name = f"{index:06d}"
        labels = np.ones(len(truth), np.uint8)
        none = np.zeros((0, 3, 3), np.float32), np.zeros(3, np.float32)
        write_truth_frame(tmp_path / "capture" / "truth" / f"{name}.npz", TruthFrame(truth, *none, labels))
        colours = np.full((len(truth), 3), 90, np.uint8)
        write_scan(tmp_path / "capture" / "scans" / f"{name}.ply", Scan(Mesh(truth, mesh.faces), colours, index, 0.0))
        vertices.append(truth + np.array([0, 0.001 * (1 + index), 0], np.float32))
        residual = np.full(len(truth), 0.0005, np.float32)
        residual[first[:3]] = np.nan
        write_npz(stage.frame_path(index), vertices=vertices[-1], residual_m=residual, verdict=np.uint8(0))
        lines.append(json.dumps(record(index)))
    lines[5] = json.dumps(record(5, verdict="failed", reasons=["a <reason> to escape"], fit_p95_mm=9.0))
    save_garment(tmp_path / "registration" / "garment.npz", Garment(mesh, loops))
    write_npy(tmp_path / "registration" / "vertices.npy", np.stack(vertices))
    write_bytes(tmp_path / "registration" / "metrics.jsonl", "\n".join(lines).encode())
    stage.finish([tmp_path / "registration" / "vertices.npy"])
    return tmp_path


def draw(work: Path, config: ReportConfig | None = None, *, capture: Path | None = None) -> StageResult:
    return run(open_work(work), config or ReportConfig(), capture=None if capture is None else read_capture(capture))


def metrics_of(work):
    metrics = json.loads((work / "report" / "metrics.json").read_text())["metrics"]
    return {entry["key"]: entry["value"] for entry in metrics}


def test_metrics_follow_their_definitions(work):
    draw(work, config=ReportConfig(film_frames=0, pictures=1))
    metrics = metrics_of(work)
    assert metrics["correspondence_mean_mm"] == pytest.approx(np.mean(1 + np.arange(FRAMES)), rel=1e-4)
    assert metrics["drift_mm_per_frame"] == pytest.approx(1, rel=1e-4)
    assert metrics["drift_ratio"] == pytest.approx((5 + 6 + 7 + 8) / (1 + 2 + 3 + 4), rel=1e-4)
    assert metrics["border_mean_mm"] == pytest.approx(metrics["correspondence_mean_mm"], rel=1e-4)
    assert metrics["truth_distance_mean_mm"] < 0.2 * metrics["correspondence_mean_mm"]  # it slid along the surface
    assert metrics["fit_p95_mm"] == pytest.approx((7 * 1 + 9) / 8)
    assert metrics["frames_good_percent"] == pytest.approx(100 * 7 / 8)
    assert metrics["frames_failed"] == 1
    assert metrics["cpu_s"] == pytest.approx(0.2)
    assert metrics["boundary_mean_mm"] is None


def test_the_page_stands_alone_and_shows_what_it_should(work):
    page = draw(work).path.read_text()
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert page.count("data:image/webp") >= 6 * 2 * 4
    assert "a &lt;reason&gt; to escape" in page
    assert "Frame 5" in page  # the failed frame, drawn on top of the six
    assert page.count("data-uri=") == FRAMES, "the film has every frame"
    assert f'max="{FRAMES - 1}"' in page
    assert re.search(r"<td>left armpit</td>.*17\.5.*71\.0", page)
    assert "beyond, up to" in page or "no scan data" in page
    for chart in re.findall(r"<svg.*?</svg>", page, re.DOTALL):
        ElementTree.fromstring(chart)
    assert (work / "report" / "index.html").stat().st_size < 2e6
    assert "data-uri=" not in draw(work, ReportConfig(film_frames=0)).path.read_text()


def test_a_comparison_is_shown_and_makes_the_report_anew(work):
    config = ReportConfig(film_frames=0, pictures=1, truth_frames=1)
    assert "Surfaces compared" not in draw(work, config=config).path.read_text()
    stage = open_stage(work / "compare", name="compare", schema=1, config=None, upstream={})
    write_panel(stage.path / "pictures" / "a.webp", Panel("map of the scan", data_uri(np.zeros((8, 8, 3), np.uint8))))
    row = {"name": "network", "vertex_mm": None, "normal_deg": 7.25, "wrinkle_energy_kept": 0.5, "flicker_deg": 1,
           "ms_per_frame": 3, "model_mb": 2}  # fmt: skip
    picture = {"frame_id": 7, "panels": [{"title": "map of the scan", "file": "a.webp"}]}
    write_json(
        stage.path / "compare.json",
        {"frames": [6, 7], "against_truth": False, "methods": [row], "pictures": [picture], "people": picture},
    )
    assert "Surfaces compared" not in draw(work, config=config).path.read_text(), "the comparison is not finished"
    stage.finish([stage.path / "compare.json"])
    page = draw(work, config=config).path.read_text()
    assert "On 2 held-out frames" in page
    assert 'alt="map of the scan, frame 7"' in page
    assert "Frame 7, from its pose, on five people" in page
    assert re.search(r"<td>network</td>.*–.*7\.25", page)


def test_a_report_is_made_once(work):
    draw(work, config=ReportConfig(film_frames=0, pictures=1))
    before = (work / "report" / "index.html").stat().st_mtime_ns
    draw(work, config=ReportConfig(film_frames=0, pictures=1))
    assert (work / "report" / "index.html").stat().st_mtime_ns == before
    draw(work, config=ReportConfig(film_frames=0, pictures=2))
    assert (work / "report" / "index.html").stat().st_mtime_ns != before


def test_truth_on_every_nth_frame_keeps_the_slope(work):
    draw(work, config=ReportConfig(film_frames=0, pictures=1, truth_frames=3))
    assert metrics_of(work)["drift_mm_per_frame"] == pytest.approx(1, rel=0.1)


def test_a_capture_that_has_moved_is_named(work):
    (work / "capture").rename(work / "elsewhere")
    with pytest.raises(InputError, match="capture"):
        draw(work)
    draw(work, capture=work / "elsewhere", config=ReportConfig(film_frames=0, pictures=1, truth_frames=1))


def test_an_unfinished_registration_names_the_repair(tmp_path, work):
    stage = json.loads((work / "registration" / "stage.json").read_text())
    write_json(work / "registration" / "stage.json", {**stage, "status": "running"})
    with pytest.raises(InputError, match="capture4d register"):
        draw(work)


def test_a_take_without_truth_has_no_truth_metrics(work):
    (work / "capture" / "truth" / "model.npz").unlink()
    draw(work, config=ReportConfig(film_frames=0, pictures=1))
    metrics = metrics_of(work)
    assert "correspondence_mean_mm" not in metrics
    assert "fit_mean_mm" in metrics


def test_numbers_nobody_measured_are_null_not_nan():
    summary = summarise([record(0), record(1)])
    assert summary["boundary_mean_mm"] is None
    assert "border_mean_mm" not in summary


@pytest.mark.parametrize(("low", "high"), [(0, 1), (0, 0.037), (-3, 12), (1, 1.3), (0, 9999)])
def test_ticks_are_round_and_enclose_the_values(low, high):
    ticks = nice_ticks(low, high)
    assert ticks[0] <= low < high <= ticks[-1]
    assert 3 <= len(ticks) <= 8
    steps = np.diff(ticks)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-6)


def test_gaps_interrupt_a_curve():
    values = np.array([1.0, 2.0, np.nan, 3.0, np.nan, 4.0, 5.0])
    chart = line_chart(range(7), [Line("x", values, "#000")])
    curve = re.search(r'class="curve" d="([^"]*)"', chart).group(1)
    assert curve.count("M") == 3
    assert curve.count("h.1") == 1


def test_tracking_is_shown_beside_the_truth(work):
    body = load_anny()
    still = np.repeat(np.eye(3, dtype=np.float32)[None], len(body.joint_names), axis=0)
    rotations, ids = np.repeat(still[None], FRAMES, axis=0), np.arange(FRAMES, dtype=np.int32)
    places, shape = np.zeros((FRAMES, 3), np.float32), np.zeros(3, np.float32)
    truth = PoseSequence(rotations, places, shape, ids, 60.0, body.joint_names)
    save_poses(work / "capture" / "truth" / "poses.npz", truth)
    save_body(work / "body" / "body.npz", body)
    off = np.array([0.002, 0, 0], np.float32)
    save_poses(work / "body" / "poses.npz", replace(truth, translations=places + off))
    lines = []
    for index in range(FRAMES):
        seen = np.arange(len(body.joint_names)) < 5
        write_npz(work / "body" / "refined" / f"{index:06d}.npz", seen=seen)
        lines.append({"frame_id": index, "verdict": "good", "reasons": [], "unseen": ["left foot"], "explained": 0.97,
                      "median_m": 0.0008, "inside": 0.0, "started_from": "motion", "cpu_s": 0.2})  # fmt: skip
    lines[3] |= {"verdict": "lost", "reasons": ["skin & suit are gone"], "median_m": None}
    write_bytes(work / "body" / "metrics.jsonl", "\n".join(json.dumps(line) for line in lines).encode())
    page = draw(work, config=ReportConfig(film_frames=0, pictures=1, stage_pictures=2)).path.read_text()
    metrics = metrics_of(work)
    assert metrics["joint_mean_mm"] == pytest.approx(2.0, rel=1e-4)
    assert metrics["track_good_percent"] == pytest.approx(87.5)
    assert metrics["track_median_mm"] == pytest.approx(0.8)
    assert "skin &amp; suit are gone" in page
    assert f"Not scanned, so guessed: left foot ({FRAMES} of {FRAMES} frames)." in page
    assert "Joints to their true places" in page
    assert page.count('alt="in the scan') == 4, "two frames from two sides"


def test_a_report_without_tracking_and_rig_shows_neither(work):
    page = draw(work, config=ReportConfig(film_frames=0, pictures=1, stage_pictures=1)).path.read_text()
    assert "<h2>Tracking</h2>" not in page
    assert "<h2>Rig</h2>" not in page
    assert "<h2>Extraction</h2>" in page


def test_a_calibrated_rig_is_shown_with_its_uncertainty(work):
    camera = {"name": "cam00", "centre_sigma_mm": 0.123, "coverage_percent": 77.0}
    report = {
        "cameras": [camera], "poses": [{"name": "000", "median_px": 0.1, "rms_px": 0.2}], "corners": 1234,
        "board": "charuco:9x7:90:68:DICT_4X4_50", "residual_median_px": 0.1, "hold_out": [],
        "volume": [{"name": "000", "corner_rms_mm": 0.3}],
    }  # fmt: skip
    write_json(work / "capture" / "calibration.json", report)
    page = draw(work, config=ReportConfig(film_frames=0, pictures=1, stage_pictures=1)).path.read_text()
    assert "<h2>Rig</h2>" in page
    assert "1,234 corners" in page
    assert "0.123" in page


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04nothing", None])
def test_the_truth_of_one_frame_may_be_damaged(work, damage: bytes | None):
    path = work / "capture" / "truth" / "000003.npz"
    path.unlink() if damage is None else path.write_bytes(damage)
    draw(work, config=ReportConfig(film_frames=0, pictures=4))
    metrics = metrics_of(work)
    assert (metrics["frames_check"], metrics["frames_failed"]) == (1, 1)
    assert metrics["drift_mm_per_frame"] == pytest.approx(1, rel=0.1)
    assert "no truth: " in (page := (work / "report" / "index.html").read_text())
    assert "truth/000003.npz" in page


def test_names_of_a_capture_are_escaped(work):
    path = work / "capture" / "capture.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "name": "<script>alert(1)</script>"}))
    draw(work, config=ReportConfig(film_frames=0, pictures=1))
    page = (work / "report" / "index.html").read_text()
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert(1)" in page
