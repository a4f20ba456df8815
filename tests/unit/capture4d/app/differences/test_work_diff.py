import shutil

import pytest

from capture4d.app.differences.page import write_page
from capture4d.app.differences.sides import short_names
from capture4d.app.differences.table import aligned, table_lines
from capture4d.app.differences.work_diff import VerdictChange, as_json, broken_limits, diff_works, parse_worse_limits
from capture4d.captures.work_folder import open_work
from capture4d.errors import InputError
from capture4d.files.atomic import write_json_lines
from tests.unit.capture4d.app.differences.conftest import record


@pytest.fixture
def diff(tmp_path):
    return lambda first="a", second="b": diff_works(open_work(tmp_path / first), open_work(tmp_path / second))


def test_frames_are_matched_by_number(write_work, tmp_path, diff):
    write_work(tmp_path / "a", [record(1), record(2), record(3), record(5)])
    write_work(tmp_path / "b", [record(2, verdict="check"), record(3, verdict="check"), record(5), record(7)],
               moved_m=0.002)  # fmt: skip
    found = diff()
    assert (found.frame_ids, found.only_before, found.only_after) == ((2, 3, 5), (1,), (7,))
    assert found.verdicts == (VerdictChange("good", "check", (2, 3)),)
    assert found.apart_mm == pytest.approx([2.0] * 3, rel=1e-4)
    text = "\n".join(table_lines(found))
    assert "good to check: frames 2-3" in text
    assert "Only in a: frame 1" in text
    assert "3 frames are in both, of 4 in a and 4 in b; means are over these." in text


def test_an_unfinished_folder_counts_with_the_frames_that_are_done(write_work, tmp_path, diff):
    write_work(tmp_path / "a", [record(1), record(2), record(3)])
    write_work(tmp_path / "b", [record(1), record(2), record(3)], finished=False)
    found = diff()
    assert found.frame_ids == (1, 2)
    assert found.apart_mm is None
    assert any("walk" in line or "2 frames registered so far, unfinished" in line for line in table_lines(found))


def test_other_takes_are_told(write_work, write_report, tmp_path, diff):
    write_work(tmp_path / "a", [record(1)])
    write_work(tmp_path / "b", [record(1)], upstream={"capture": "others"})
    found = diff()
    assert not found.same_take
    assert found.takes == "Different takes, a and b: frames of one number are not one moment."
    for name in "ab":
        write_report(tmp_path / name, {})
    found = diff()
    assert found.same_take
    assert found.takes == "One take by its name, walk; no scan was read in both."
    assert diff("a", "a").takes == "One take, walk."


def test_the_scans_that_were_read_decide(write_work, tmp_path, diff):
    def read(name: str, scans: dict[int, str]) -> None:
        lines = [{"path": f"frames/{number:06d}.npz", "inputs": {"scan": scan}, "digest": "", "size": 0, "time": 0}
                 for number, scan in scans.items()]  # fmt: skip
        work = write_work(tmp_path / name, [record(number) for number in scans], upstream={"capture": name})
        write_json_lines(work / "garment" / "made.jsonl", lines)

    read("a", {1: "x", 2: "y", 3: "z"})
    read("b", {2: "y", 3: "z", 4: "w"})
    read("c", {1: "x", 2: "changed", 3: "z"})
    read("d", {1: "p", 2: "q"})
    assert (diff("a", "b").same_take, diff("a", "b").takes) == (True, "One take, b.")
    assert (diff("a", "c").same_take, diff("a", "c").takes) == (True, "One take, c; frame 2 replaced.")
    assert not diff("a", "d").same_take


def test_animations_are_told_by_motion_and_garment(write_work, tmp_path, diff):
    made = {"poses": "1", "model": "1"}
    frames = [record(1, inside_body_percent=0.1, pose_distance_deg=4.0, unlike_deg=20.0)]
    for name, changes in {"a": {}, "b": {"model": "2"}, "c": {"poses": "2"}}.items():
        write_work(tmp_path / name, frames, name="animate", upstream={**made, **changes})
    write_work(tmp_path / "d", frames)
    assert diff("a", "a").takes == "One motion, one learned garment."
    assert diff("a", "b").takes == "One motion, two learned garments."
    assert not diff("a", "c").same_take
    assert diff("a", "d").takes == "a is animated, d is registered: little can be compared."
    keys = {metric.key for metric in diff("a", "b").metrics}
    assert {"inside_body_percent", "unlike_percent", "frames_check"} <= keys


def test_equal_results_are_told_and_nothing_is_worse(write_work, tmp_path, diff):
    write_work(tmp_path / "a", [record(1), record(2)])
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    found = diff()
    assert "The registered frames are the same, bit for bit." in found.notes
    assert {metric.verdict for metric in found.metrics} == {"same"}
    assert broken_limits(found, [(metric.key, 0.0) for metric in found.metrics]) == []
    assert not found.apart_mm.any()


def test_limits_are_percent_in_the_metrics_own_direction(write_work, tmp_path, diff):
    write_work(tmp_path / "a", [record(1, fit_mean_mm=1.0, covered_percent=80.0)])
    write_work(tmp_path / "b", [record(1, fit_mean_mm=1.1, covered_percent=76.0, verdict="failed", fit_p95_mm=None)])
    found = diff()
    limits = parse_worse_limits(["fit_mean_mm=9.9", "covered_percent=4.9", "frames_failed=1000", "fit_p95_mm=50"])
    assert broken_limits(found, limits) == [
        "fit_mean_mm was 1, now 1.1: worse, 10 %, more than 9.9 % allowed",
        "covered_percent was 80, now 76: worse, 5 %, more than 4.9 % allowed",
        "frames_failed was 0, now 1: worse, more than 1000 % allowed",
        "fit_p95_mm was not measured in both, which breaks the limit of 50 %",
    ]
    assert broken_limits(found, parse_worse_limits(["fit_mean_mm=10.1", "covered_percent=5.1"])) == []
    with pytest.raises(InputError, match="no metric 'joint_max_mm' in either folder"):
        broken_limits(found, parse_worse_limits(["joint_max_mm=1"]))
    with pytest.raises(InputError, match="--fail-if-worse: expected METRIC=PERCENT such as fit_mean_mm=5, found"):
        parse_worse_limits(["fit_mean_mm=-5"])


def test_what_is_no_work_folder_is_one_line(tmp_path, write_work, diff):
    write_work(tmp_path / "a", [record(1)])
    with pytest.raises(InputError, match="expected a work folder, found no such folder"):
        diff("a", "nowhere")
    (tmp_path / "b").mkdir()
    with pytest.raises(InputError, match="expected a work folder, found none of its stages there"):
        diff()


def test_the_page_stands_alone_and_names_what_it_shows(write_work, tmp_path, diff):
    write_work(tmp_path / "a", [record(1), record(2)])
    failed = record(2, verdict="failed", reasons=["a <reason> to escape"], fit_mean_mm=2.0)
    write_work(tmp_path / "b", [record(1, fit_mean_mm=0.8), failed], config={"nodes": 60})
    write_page(diff(), tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "src=" not in page
    assert "href=" not in page
    assert "a &lt;reason&gt; to escape" in page
    assert "nodes was 300, now 60" in page
    assert page.count("<svg") == 1 + 4  # how far apart; fit, its percentile, what is covered, CPU
    write_page(diff(), tmp_path / "page.html")
    with pytest.raises(InputError, match="use --overwrite"):
        write_page(diff("a", "a"), tmp_path / "page.html")


def test_machines_get_what_people_get(write_work, tmp_path, diff):
    write_work(tmp_path / "a", [record(1)])
    write_work(tmp_path / "b", [record(1, fit_mean_mm=0.6)])
    found = as_json(diff())
    (fit,) = [metric for metric in found["metrics"] if metric["key"] == "fit_mean_mm"]
    assert fit == {"key": "fit_mean_mm", "unit": "mm", "better": "lower", "before": 0.5, "after": 0.6,
                   "verdict": "worse", "worse_percent": pytest.approx(20.0)}  # fmt: skip
    assert (found["before"]["frames"], found["frames_in_both"], found["same_take"]) == (1, 1, True)


def test_names_are_as_long_as_it_takes(tmp_path):
    assert short_names(tmp_path / "x" / "work", tmp_path / "y" / "work") == ("x/work", "y/work")
    assert short_names(tmp_path / "x", tmp_path / "y") == ("x", "y")
    assert short_names(tmp_path / "x", tmp_path / "x" / ".." / "x") == ("x (1)", "x (2)")


def test_columns_line_up():
    lines = aligned([("name", "1", "x"), ("n", "1000", "")], left=(0, 2))
    assert lines == ["name     1  x", "n     1000"]
