import json
import shutil
from pathlib import Path

import pytest

from capture4d import pipeline
from capture4d.app.status.plan import Plan, StagePlan
from capture4d.app.status.table import plan_lines
from capture4d.files.atomic import read_json, write_json
from registration.config import GraphConfig, RegistrationConfig
from tests.command_line import fails, run

OTHER = RegistrationConfig(graph=GraphConfig(nodes=50))


def contents(*folders: Path) -> dict[Path, tuple[int, bytes]]:
    """Every file and folder, its content and its time."""
    return {
        path: (path.stat().st_mtime_ns, path.read_bytes() if path.is_file() else b"")
        for folder in folders
        for path in (folder, *folder.rglob("*"))
    }


def by_name(plan: Plan) -> dict[str, StagePlan]:
    return {stage.name: stage for stage in plan.stages}


COMMANDS = (
    ("run",),
    ("run", "--overwrite"),
    ("run", "--registration.graph.nodes", "50"),
    ("run", "--frames", "5,7"),
    ("run", "--renew", "colours"),
    ("extract",),
    ("extract", "--learn-colours"),
    ("register", "--overwrite"),
)


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_both_folders_are_byte_for_byte_what_they_were(command: tuple[str, ...], ran: Path):
    scans = ran / "capture" / "scans"
    shutil.copy(scans / "000005.ply", scans / "000006.ply")  # so that there is something to do
    before = contents(ran / "capture", ran / "work")
    name, *options = command
    arguments = (name, ran / "capture", *options, "--workers", "1", "--dry-run", "--output")
    assert run(*arguments, ran / "work") in (0, 3)
    assert contents(ran / "capture", ran / "work") == before
    assert run(*arguments, ran / "new" / "work") in (0, 3)
    assert not (ran / "new").exists()


def test_what_is_done_stays(ran: Path):
    plan = pipeline.plan(ran / "capture", ran / "work")
    assert [stage.state for stage in plan.stages] == ["nothing"] * 3
    assert (plan.wall_s, plan.bytes, plan.refuses) == ((0.0, 0.0), 0, False)
    assert plan_lines(plan)[-1] == "Nothing was done, and nothing is to do."


def test_what_was_never_done_is_guessed(ran: Path):
    plan = pipeline.plan(ran / "capture", ran / "none", workers=3)
    assert [(stage.name, stage.state, stage.to_do, stage.is_guess) for stage in plan.stages] == [
        ("extract", "do", 3, True), ("register", "do", 3, True), ("report", "do", 0, True),
    ]  # fmt: skip
    assert 0 < plan.wall_s[0] <= sum(stage.cpu_s for stage in plan.stages)
    written = sum(path.stat().st_size for path in (ran / "work").rglob("*.npz"))
    assert 0.3 < sum(stage.bytes for stage in plan.stages[:2]) / written < 3


def test_the_plan_is_what_the_run_then_does(ran: Path):
    """Frames that are planned for certain are made anew, those that may be are, or are not; no others."""
    shutil.copy(ran / "capture" / "scans" / "000005.ply", ran / "capture" / "scans" / "000007.ply")
    plan = by_name(pipeline.plan(ran / "capture", ran / "work"))
    assert (plan["extract"].to_do, plan["extract"].perhaps, plan["extract"].kept) == (1, 0, 2)
    assert plan["extract"].why == ("frame 7 replaced", "frame 7 to do")
    frames = {name: sorted((ran / "work" / name / "frames").glob("*.npz")) for name in ("garment", "registration")}
    before = {path: path.stat().st_mtime_ns for paths in frames.values() for path in paths}
    pipeline.run(ran / "capture", ran / "work", draw=False)
    for name, stage in (("garment", plan["extract"]), ("registration", plan["register"])):
        redone = sum(path.stat().st_mtime_ns != before[path] for path in frames[name])
        assert stage.to_do <= redone <= stage.to_do + stage.perhaps


def test_other_settings_are_refused_unless_told_and_stop_what_comes_after(ran: Path):
    plan = by_name(pipeline.plan(ran / "capture", ran / "work", OTHER))
    assert [plan[name].state for name in ("extract", "register", "report")] == ["nothing", "refuse", "refuse"]
    assert plan["register"].why == ("other settings (nodes 300 to 50): needs --overwrite",)
    told = by_name(pipeline.plan(ran / "capture", ran / "work", OTHER, overwrite=True))
    assert [told[name].state for name in ("extract", "register", "report")] == ["nothing", "renew", "do"]
    assert told["register"].to_do == 3
    assert not told["register"].is_guess, "frames of before tell what one costs"
    assert run("run", ran / "capture", "--output", ran / "work", "--dry-run", "--registration.graph.nodes", "50") == 3


def test_a_stage_alone_needs_what_it_is_made_from(ran: Path, capsys: pytest.CaptureFixture[str]):
    capsys.readouterr()
    assert run("register", ran / "capture", "--output", ran / "none", "--dry-run") == 3
    said = capsys.readouterr().out
    assert "register: the scans' garments are missing: run extract first" in said
    assert said.splitlines()[-1] == "Nothing was done. This command would refuse."


def test_what_was_stopped_goes_on(ran: Path):
    record = read_json(ran / "work" / "registration" / "stage.json")
    write_json(ran / "work" / "registration" / "stage.json", {**record, "status": "running"})
    (ran / "work" / "registration" / "frames" / "000007.npz").unlink()
    stage = by_name(pipeline.plan(ran / "capture", ran / "work"))["register"]
    assert (stage.state, stage.to_do) == ("go on", 1)


def test_times_come_from_earlier_frames_and_from_the_log(ran: Path):
    path = ran / "work" / "registration" / "metrics.jsonl"
    lines = [{**json.loads(line), "cpu_s": 7.0} for line in path.read_text().splitlines()]
    path.write_text("\n".join(map(json.dumps, lines)))
    (ran / "work" / "log.jsonl").write_text(
        json.dumps({"event": "stage ends", "stage": "extract", "wall_s": 1.0, "cpu_s": 6.0}) + "\n"
    )
    plan = by_name(pipeline.plan(ran / "capture", ran / "work", OTHER, overwrite=True))
    assert plan["register"].cpu_s == 21.0
    assert (plan["extract"].frame_s, plan["extract"].is_guess) == (2.0, False)


def test_a_decision_that_is_unknown_is_one_line(ran: Path, capsys: pytest.CaptureFixture[str]):
    command = ("run", ran / "capture", "--output", ran / "work", "--dry-run", "--renew", "beauty")
    assert fails(capsys, *command) == "--renew: expected shape or colours, found 'beauty'"
