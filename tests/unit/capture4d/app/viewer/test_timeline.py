"""Frames as they come, what is said of them, and which is due while they are played."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from capture4d.app.viewer.clock import Clock
from capture4d.app.viewer.panels import FLAGGED, curve_rows, frame_line, frame_options, frames_with, verdict_strip
from capture4d.app.viewer.timeline import OPEN, Registered, Timeline, curve, curve_names, flagged
from capture4d.files.atomic import write_json, write_npz


def write_frame(folder: Path, frame_id: int, verdict: str, **measures: float) -> None:
    record = {"frame_id": frame_id, "verdict": verdict, "reasons": ["torn"] if verdict == "failed" else [], **measures}
    write_json(folder / "metrics" / f"{frame_id:06d}.json", record)
    write_npz(folder / "frames" / f"{frame_id:06d}.npz", vertices=np.zeros((3, 3), np.float32))


def test_frames_appear_one_by_one(tmp_path: Path):
    found = Registered(tmp_path)
    assert not found.look()
    assert found.records == {}
    write_frame(tmp_path, 12, "good", fit_mean_mm=0.4)
    assert found.look()
    assert not found.look()
    write_frame(tmp_path, 3, "failed", fit_mean_mm=9.0)
    (tmp_path / "frames" / ".000004.npz.partial").write_bytes(b"")
    assert found.look()
    assert [*found.records] == [3, 12]
    timeline = Timeline((3, 7, 12), found.records)
    assert [timeline.verdict(each) for each in (3, 7, 12)] == ["failed", OPEN, "good"]
    assert timeline.said(3) == "3: failed; torn"
    assert flagged(timeline, ["failed"]) == [3]
    np.testing.assert_array_equal(curve(timeline, "fit_mean_mm"), [9.0, np.nan, 0.4])


def test_a_frame_that_is_registered_anew_is_read_again(tmp_path: Path):
    write_frame(tmp_path, 1, "check")
    found = Registered(tmp_path)
    found.look()
    before = found.states[1]
    write_frame(tmp_path, 1, "good")
    os.utime(tmp_path / "frames" / "000001.npz", ns=(before + 10**9, before + 10**9))
    assert found.look()
    assert found.records[1]["verdict"] == "good"
    assert found.states[1] != before


def test_finished_takes_are_read_from_one_file(tmp_path: Path):
    for frame_id in range(5):
        write_frame(tmp_path, frame_id, "good")
    rows = [{"frame_id": frame_id, "verdict": "check", "reasons": []} for frame_id in range(5)]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    found = Registered(tmp_path)
    found.look()
    assert {record["verdict"] for record in found.records.values()} == {"check"}


def test_measures_in_the_order_of_the_report():
    records = {
        1: {"frame_id": 1, "verdict": "good", "zebra": 1.0, "boundary_mean_mm": 2, "fit_mean_mm": 1.0, "ok": True}
    }
    assert curve_names(Timeline((1,), records)) == ["fit_mean_mm", "boundary_mean_mm", "zebra"]


def long_timeline(count: int) -> Timeline:
    verdicts = {each: "failed" if each == 777 else "check" if each % 50 == 0 else "good" for each in range(count)}
    return Timeline(tuple(range(count)), {each: {"verdict": verdict, "x": each} for each, verdict in verdicts.items()})


def test_one_bad_frame_of_ten_thousand_is_seen_in_the_strip():
    timeline = long_timeline(10_000)
    strip = verdict_strip([timeline], timeline.frame_ids)
    assert strip.count("#c8383a") == 1
    assert "1 failed" in strip
    assert len(strip) < 40_000


def test_lists_name_the_frames_around():
    timeline = long_timeline(10_000)
    frames = frames_with(timeline, "good")
    lines = frame_options(timeline, frames, near=5003)
    assert len(lines) == 200
    assert "5003: good" in lines
    assert frames_with(timeline, FLAGGED)[:3] == [0, 50, 100]
    assert 777 in frames_with(timeline, FLAGGED)
    assert frame_options(timeline, [], near=0) == []


def test_curves_of_long_takes_keep_their_peaks():
    timeline = long_timeline(10_000)
    ids, row = curve_rows([timeline], timeline.frame_ids, "x")
    assert len(ids) == len(row) == 1000
    assert row.max() == 9999
    short, values = curve_rows([timeline], timeline.frame_ids[:20], "x")
    np.testing.assert_array_equal(short, values)


def test_two_takes_on_one_axis():
    one, other = Timeline((1, 2), {1: {"x": 5.0}, 2: {"x": 6.0}}), Timeline((2, 3), {3: {"x": 7.0}})
    _, first, second = curve_rows([one, other], [1, 2, 3], "x")
    np.testing.assert_array_equal(first, [5.0, 6.0, np.nan])
    np.testing.assert_array_equal(second, [np.nan, np.nan, 7.0])
    assert frame_line(["a", "b"], [one, other], 1).splitlines() == ["a: not judged  ", "b: no such frame"]


@pytest.mark.parametrize(
    ("speed", "after_s", "due"),
    [
        (1, 0.0, 12),
        (1, 0.05, 12),
        (1, 0.11, 13),
        (1, 0.85, 20),
        (2, 0.15, 14),
        (1, 1.15, 12),
        (0.5, 0.1, 12),
        (-1, 0.1, 10),
    ],
)
def test_the_frame_that_is_due(speed: float, after_s: float, due: int):
    """Frames 10, 12, 13, 14 and 20, ten a second."""
    clock = Clock((10, 12, 13, 14, 20), 10.0, speed, 12, 100.0)
    assert clock.frame(100.0 + after_s + 1e-6) == due


def test_what_comes_next_goes_round():
    clock = Clock((10, 12, 13), 10.0, 1.0, 12, 0.0)
    assert clock.next_frames(13, 3) == [10, 12, 13]
    assert Clock((10, 12, 13), 10.0, -1.0, 12, 0.0).next_frames(10, 2) == [13, 12]
