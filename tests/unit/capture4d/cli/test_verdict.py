"""What a command says at its end: counts, figures, and which frames to look at."""

import json
from pathlib import Path
from typing import Any

import pytest

from capture4d.cli.verdict import flagged_line, say_flagged, say_verdict, say_work, verdict_line
from capture4d.files.atomic import write_json_lines


def record(frame_id: int, verdict: str = "good", *reasons: str, **numbers: float | None) -> dict[str, Any]:
    return {"frame_id": frame_id, "verdict": verdict, "reasons": list(reasons), **numbers}


def test_counts_and_figures_are_those_of_the_frames():
    records = [
        record(1, fit_mean_mm=0.2, boundary_mean_mm=1.0),
        record(2, "check", "wide", fit_mean_mm=0.4, boundary_mean_mm=None),
        record(3, "failed", "no scan"),
    ]
    said = "register: 1 of 3 frames good, 1 to check, 1 failed; fit 0.30 mm, border 1.00 mm"
    assert verdict_line("register", records) == said
    assert verdict_line("track", [record(1), record(2, "lost")]) == "track: 1 of 2 frames good, 0 to check, 1 lost"
    animated = [record(1, inside_body_percent=0.02)]
    assert verdict_line("animate", animated) == (
        "animate: 1 of 1 frames good, 0 to check, 0 failed; inside the body 0.02 %"
    )


def test_flagged_frames_are_ranges_with_the_reason_of_the_first():
    reasons = {14: "late", 13: "wide", 20: "thin"}
    assert flagged_line("to check", reasons) == "to check: 13-14, 20; frame 13: wide"
    assert flagged_line("lost", {2: "a", 4: "b"}, among=[2, 4, 6]) == "lost: 2-4; frame 2: a"
    assert "and 8 more; frame 0: x" in flagged_line("lost", dict.fromkeys(range(0, 40, 2), "x"))


def test_what_is_bad_is_on_stderr(capsys: pytest.CaptureFixture[str]):
    say_flagged("lost in 1 of 3 frames", {6: "cut off"})
    say_flagged("lost in 0 of 3 frames", {})
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", "capture4d: lost in 1 of 3 frames: 6; frame 6: cut off\n")


def test_a_work_folder_tells_of_each_stage_that_has_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    write_json_lines(tmp_path / "body" / "metrics.jsonl", [record(1), record(2)])
    registered = [record(1, fit_mean_mm=0.25), record(2, "check", "wide", fit_mean_mm=0.25)]
    write_json_lines(tmp_path / "registration" / "metrics.jsonl", registered)
    say_work(tmp_path)
    assert capsys.readouterr().out.splitlines() == [
        "track: 2 of 2 frames good, 0 to check, 0 lost",
        "register: 1 of 2 frames good, 1 to check, 0 failed; fit 0.25 mm",
        "to check: 2; frame 2: wide",
    ]
    say_verdict(tmp_path / "garment", "extract")
    assert capsys.readouterr().out == ""


def test_the_figures_are_those_of_the_report(tmp_path: Path):
    from capture4d.app.report.metrics import summarise

    records = [record(each, fit_mean_mm=0.1 * each, boundary_mean_mm=1.0 * each, cpu_s=1.0) for each in range(1, 6)]
    summary = summarise(json.loads(json.dumps(records)))
    assert f"fit {summary['fit_mean_mm']:.2f} mm, border {summary['boundary_mean_mm']:.2f} mm" in verdict_line(
        "register", records
    )
