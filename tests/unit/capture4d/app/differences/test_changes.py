import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture4d.app.differences.changes import MetricChange, SettingChange, metric_changes, setting_changes
from capture4d.app.differences.sides import Side, read_side
from capture4d.app.report.limits import KNOWN_METRICS
from capture4d.captures.work_folder import open_work
from tests.unit.capture4d.app.differences.conftest import record

FIGURES = st.one_of(st.none(), st.floats(0, 1e4), st.integers(0, 5).map(float))


@given(st.sampled_from(KNOWN_METRICS), FIGURES, FIGURES)
def test_better_and_worse_are_each_others_mirror(key: str, before: float | None, after: float | None):
    there, back = MetricChange(key, before, after), MetricChange(key, after, before)
    mirror = {"better": "worse", "worse": "better", "same": "same", "unknown": "unknown"}
    assert back.verdict == mirror[there.verdict]
    if there.verdict == "worse":
        assert there.worse_percent > 0
    if there.verdict == "better":
        assert there.worse_percent < 0
    if None in (before, after):
        assert math.isinf(there.worse_percent)


def test_the_direction_is_the_metrics_own():
    assert MetricChange("fit_mean_mm", 1.0, 2.0).verdict == "worse"
    assert MetricChange("covered_percent", 80.0, 90.0).verdict == "better"
    assert MetricChange("frames_failed", 0.0, 1.0).worse_percent == math.inf
    assert MetricChange("frames_failed", 0.0, 0.0).worse_percent == 0.0
    assert MetricChange("covered_percent", 80.0, 60.0).worse_percent == pytest.approx(25.0)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (MetricChange("fit_mean_mm", 0.5, 0.6), "+0.1 (+20 %)"),
        (MetricChange("fit_mean_mm", 0.5, 0.49), "−0.01 (−2.0 %)"),
        (MetricChange("fit_mean_mm", 0.5, 0.50001), "same"),
        (MetricChange("covered_percent", 80.0, 60.0), "−20"),
        (MetricChange("frames_failed", 0.0, 2.0), "+2"),
        (MetricChange("frames_failed", None, 2.0), "–"),
    ],
)
def test_a_change_as_tables_print_it(change: MetricChange, text: str):
    assert change.change == text


def test_a_meaning_stands_alone():
    meanings = {key: MetricChange(key, 1.0, 1.0).meaning for key in KNOWN_METRICS}
    assert [key for key, meaning in meanings.items() if meaning.startswith("the same")] == []
    assert (
        meanings["fit_p95_mm"]
        == "template vertices to the scan's surface, where it has data, 95th percentile of a frame"
    )
    assert (
        meanings["fit_max_mm"]
        == "template vertices to the scan's surface, where it has data, the farthest vertex of the take"
    )


@pytest.fixture
def side(write_work, tmp_path):
    def make(folder: str, frames, **options) -> Side:
        return read_side(open_work(write_work(tmp_path / folder, frames, **options)), folder)

    return make


def values(before: Side, after: Side) -> dict[str, tuple[float | None, float | None]]:
    return {metric.key: (metric.before, metric.after) for metric in metric_changes(before, after)}


def test_means_are_over_the_frames_that_both_have_measured(side):
    """A frame that one folder lacks, or in which it failed, makes the other neither better nor worse."""
    before = side("a", [record(1), record(2, fit_mean_mm=0.7), record(3, fit_mean_mm=9.0)])
    after = side("b", [record(1, fit_mean_mm=None, verdict="failed"), record(2, fit_mean_mm=0.6)])
    found = values(before, after)
    assert found["fit_mean_mm"] == (0.7, 0.6)
    assert found["fit_p95_mm"] == (1.0, 1.0)
    assert found["frames_failed"] == (0.0, 1.0)
    assert found["frames_good_percent"] == (100.0, 50.0)


def test_without_a_common_frame_all_of_each_count(side):
    found = values(side("a", [record(1), record(2, fit_mean_mm=0.7)]), side("b", [record(3, fit_mean_mm=0.9)]))
    assert found["fit_mean_mm"] == pytest.approx((0.6, 0.9))


def test_what_only_the_report_knows_is_marked(side, write_report, tmp_path):
    for name in "ab":
        side(name, [record(1), record(2)])
    write_report(tmp_path / "a", {"border_mean_mm": 2.0})
    write_report(tmp_path / "b", {"border_mean_mm": 3.0})
    pair = [read_side(open_work(tmp_path / name), name) for name in "ab"]
    changes = {metric.key: metric for metric in metric_changes(*pair)}
    assert (changes["border_mean_mm"].before, changes["border_mean_mm"].after) == (2.0, 3.0)
    assert changes["border_mean_mm"].over_all
    assert not changes["fit_mean_mm"].over_all


def test_frames_of_the_report_are_compared_frame_by_frame(side, write_report, tmp_path):
    for name in "ab":
        side(name, [record(1), record(2)])
    truth = [{"frame_id": 1, "correspondence_mean_mm": 1.0}, {"frame_id": 2, "correspondence_mean_mm": 3.0}]
    write_report(tmp_path / "a", {"correspondence_mean_mm": 2.0}, truth)
    write_report(tmp_path / "b", {"correspondence_mean_mm": 2.5}, [{"frame_id": 2, "correspondence_mean_mm": 2.5}])
    pair = [read_side(open_work(tmp_path / name), name) for name in "ab"]
    assert values(*pair)["correspondence_mean_mm"] == (3.0, 2.5)


def test_settings_and_inputs_are_said_in_words(side):
    before = side("a", [record(1)], config={"graph": {"nodes": 300}, "rule": "plane"},
                  upstream={"template": "1", "motion": "1"})  # fmt: skip
    after = side("b", [record(1)], config={"graph": {"nodes": 60}, "rule": "plane", "gate": [0.1, 0.2]},
                 upstream={"template": "2", "body": "1"})  # fmt: skip
    assert [change.words for change in setting_changes(before, after)] == [
        "register: made from another template",
        "register: no longer made from the poses of the capture",
        "register: now made from the tracked body",
        "register: graph.nodes was 300, now 60",
        "register: gate was not there, now [0.1, 0.2]",
    ]
    assert setting_changes(before, before) == []


def test_an_unfinished_stage_and_another_one_are_told(side):
    before, after = side("a", [record(1)]), side("b", [record(1), record(2)], finished=False)
    assert SettingChange("register", "stage", "", "done", "unfinished") in setting_changes(before, after)
    animated = side("c", [record(1)], name="animate")
    assert "register: was done, now done by 'animate'" in [each.words for each in setting_changes(before, animated)]
