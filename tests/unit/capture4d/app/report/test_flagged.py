"""Flagged frames: no frame is lost, those with the same reasons share a row, the worst comes first."""

from capture4d.app.drawing.page import Badge
from capture4d.app.report.flagged import flagged_table, verdict_counts, verdict_runs


def record(frame_id, verdict="good", *reasons, fit=0.1):
    return {"frame_id": frame_id, "verdict": verdict, "reasons": list(reasons), "fit_mean_mm": fit}


TAKE = [
    record(2),
    record(4, "check", "fit_mean_mm 1.20 > 1 mm", fit=1.2),
    record(6, "check", "fit_mean_mm 1.50 > 1 mm", fit=1.5),
    record(8),
    record(10, "check", "fit_mean_mm 1.10 > 1 mm", fit=1.1),
    record(12, "failed", "no scan"),
    record(14, "check", "left armpit: 14.0 % of its faces cut others > 12 %"),
]


def test_frames_with_the_same_reasons_share_a_row_and_its_figures_are_the_worst():
    table = flagged_table(TAKE, measures=(("fit mean, mm", "fit_mean_mm"),))
    assert [column.name for column in table.columns] == ["frames", "verdict", "reasons", "fit mean, mm"]
    assert [row[0] for row in table.rows] == ["12", "4-6, 10", "14"]
    assert table.rows[1][1:] == [Badge("check"), "in 6: fit_mean_mm 1.50 > 1 mm", "1.5"]
    assert table.rows[0][2] == "no scan", "a row of one frame does not repeat its number"
    assert table.stacks


def test_a_frame_without_the_measure_does_not_hide_others():
    table = flagged_table([record(1, "lost", "a", fit=None), record(2, "lost", "a", fit=3.0)], worst_by="fit_mean_mm")
    assert table.rows == [["1-2", Badge("lost"), "in 2: a"]]


def test_sides_and_further_regions_do_not_part_what_is_of_one_kind():
    left = "left armpit: 14.9 % of its faces cut others > 12 %"
    right = "right armpit: 16.2 % of its faces cut others > 12 %, and in 1 more"
    table = flagged_table([record(1, "check", left), record(2, "check", right), record(3, "check", left + "; x")])
    assert [row[0] for row in table.rows] == ["1-2", "3"]


def test_a_take_without_faults_has_no_rows():
    assert flagged_table(TAKE[:1]).rows == []


def test_verdicts_along_the_take():
    assert verdict_runs(TAKE) == [("good", 1), ("check", 2), ("good", 1), ("check", 1), ("failed", 1), ("check", 1)]
    assert verdict_counts(TAKE, ("good", "check", "failed", "lost")) == [("good", 2), ("check", 4), ("failed", 1)]
