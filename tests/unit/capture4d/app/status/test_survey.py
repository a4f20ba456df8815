import dataclasses
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from capture4d.app.status.staleness import rebuilt
from capture4d.app.status.survey import WorkStatus, as_json, survey
from capture4d.app.status.table import duration, size, status_lines
from capture4d.errors import InputError
from capture4d.files.atomic import plain_value, read_json, write_json
from capture4d.files.records import load_garment, save_garment
from capture4d.tracking.config import TrackingConfig
from registration.config import PRESETS, RegistrationConfig
from tests.command_line import fails, run


def states(found: WorkStatus) -> dict[str, str]:
    return {stage.name: stage.state for stage in found.stages}


def why(found: WorkStatus, name: str) -> str:
    return "; ".join(next(stage.why for stage in found.stages if stage.name == name))


def test_what_is_done_is_told_with_what_it_cost(ran: Path):
    found = survey(ran / "work")
    assert states(found) == {"extract": "done", "register": "done", "report": "done"}
    assert (found.take, found.capture, found.running, found.notes) == ("tube", ran / "capture", (), ())
    extracted, registered, _ = found.stages
    assert (extracted.done, extracted.frames, registered.done, registered.frames) == (3, 3, 3, 3)
    assert registered.cpu_s is not None
    assert registered.cpu_s > 0
    files = [path for path in (ran / "work" / "registration").rglob("*") if path.is_file()]
    assert registered.bytes == sum(path.stat().st_size for path in files)
    lines = status_lines(found)
    assert lines[0] == f"{ran / 'work'}: tube, from {ran / 'capture'}"
    assert [line.split()[:3] for line in lines if line.startswith("register")] == [["register", "done", "3/3"]]


def test_nothing_is_written(ran: Path):
    before = {path: (path.stat().st_mtime_ns, path.is_file() and path.read_bytes()) for path in ran.rglob("*")}
    survey(ran / "work")
    assert run("status", ran / "work") == 0
    assert {path: (path.stat().st_mtime_ns, path.is_file() and path.read_bytes()) for path in ran.rglob("*")} == before


def test_a_replaced_scan_makes_stale_what_comes_of_it(ran: Path):
    scans = ran / "capture" / "scans"
    shutil.copy(scans / "000005.ply", scans / "000006.ply")
    found = survey(ran / "work")
    assert states(found) == {"extract": "stale", "register": "stale", "report": "stale"}
    assert "frame 6 replaced" in why(found, "extract")
    assert "frame 6 to do" in why(found, "extract")
    assert "6" in why(found, "register")
    assert why(found, "report") == "registration is stale"


def test_frames_that_came_and_another_template_are_told(ran: Path):
    scans = ran / "capture" / "scans"
    description = read_json(ran / "capture" / "capture.json")
    write_json(ran / "capture" / "capture.json", {**description, "frames": [5, 6, 7, 8]})
    shutil.copy(scans / "000005.ply", scans / "000008.ply")
    found = survey(ran / "work")
    assert "frame 8 added" in why(found, "extract")
    assert (found.stages[0].done, found.stages[0].frames) == (3, 4)
    template = load_garment(ran / "capture" / "template.npz")
    moved = template.template.with_vertices(template.template.vertices + 0.001)
    save_garment(ran / "capture" / "template.npz", dataclasses.replace(template, template=moved))
    assert "template changed" in why(survey(ran / "work"), "register")


def test_a_stage_that_was_stopped_goes_on(ran: Path):
    record = read_json(ran / "work" / "registration" / "stage.json")
    write_json(ran / "work" / "registration" / "stage.json", {**record, "status": "running"})
    (ran / "work" / "registration" / "frames" / "000007.npz").unlink()
    found = survey(ran / "work")
    assert states(found)["register"] == "stopped"
    assert next(stage.done for stage in found.stages if stage.name == "register") == 2
    assert "frame 7 to do" in why(found, "register")
    assert states(found)["report"] == "stale"


HOLD = """
import sys, time
from pathlib import Path
from capture4d.runs.locks import alone
sys.argv = ["capture4d", "register", "take", "--output", "work"]
with alone(Path(ARGUMENT), folder=True):
    print("held", flush=True)
    time.sleep(60)
"""


def test_who_is_writing_is_told_and_keeps_writing(ran: Path):
    work = ran / "work"
    record = read_json(work / "registration" / "stage.json")
    write_json(work / "registration" / "stage.json", {**record, "status": "running"})
    script = HOLD.replace("ARGUMENT", repr(str(work)))
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        found = survey(work)
        (holder,) = found.running
        assert (holder.command, holder.process) == ("capture4d register take --output work", process.pid)
        assert states(found)["register"] == "running"
        assert any(line.startswith("running: capture4d register take") for line in status_lines(found))
        assert len(survey(work).running) == 1, "asking takes the lock from nobody"
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()
    assert survey(work).running == (), "a lock file that a kill left behind is nobody's"
    assert states(survey(work))["register"] == "stopped"


def test_flagged_frames_are_ranges(ran: Path):
    path = ran / "work" / "registration" / "metrics.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    for line, verdict in zip(lines, ("check", "check", "failed"), strict=True):
        line["verdict"] = verdict
    path.write_text("\n".join(map(json.dumps, lines)))
    found = survey(ran / "work")
    assert next(stage.flagged for stage in found.stages if stage.name == "register") == {
        "check": (5, 6), "failed": (7,),
    }  # fmt: skip
    assert "register: check: 5-6 (2)" in status_lines(found)


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b'{"stage": "register"}', b"\xff\xfe\x00"])
def test_damage_is_one_line_of_its_stage_and_exit_code_3(data: bytes, ran: Path, capsys: pytest.CaptureFixture[str]):
    (ran / "work" / "registration" / "stage.json").write_bytes(data)
    found = survey(ran / "work")
    assert states(found)["register"] == "damaged"
    assert states(found)["extract"] == "done"
    capsys.readouterr()
    assert run("status", ran / "work") == 3
    assert "damaged" in capsys.readouterr().out


def test_a_lost_file_of_measures_is_damage(ran: Path):
    (ran / "work" / "registration" / "metrics.jsonl").unlink()
    found = survey(ran / "work")
    assert states(found)["register"] == "damaged"
    assert "metrics.jsonl: no such file" in why(found, "register")


def test_without_the_capture_the_rest_is_told(ran: Path):
    (ran / "capture").rename(ran / "elsewhere")
    found = survey(ran / "work")
    assert states(found)["register"] == "done"
    assert found.notes[0].startswith(f"The capture is not at {ran / 'capture'}: ")


def test_what_is_no_work_folder_is_one_line(ran: Path, capsys: pytest.CaptureFixture[str]):
    expected = "expected a work folder, found"
    assert fails(capsys, "status", ran / "nowhere") == f"{ran / 'nowhere'}: {expected} no such folder"
    assert fails(capsys, "status", ran / "capture") == f"{ran / 'capture'}: {expected} a capture folder"
    inside = ran / "work" / "garment"
    assert fails(capsys, "status", inside) == (
        f"{inside}: {expected} the folder of one stage; its work folder is {ran / 'work'}"
    )
    assert fails(capsys, "status", ran) == f"{ran}: {expected} none of its stages there"
    file = ran / "capture" / "capture.json"
    assert fails(capsys, "status", file) == f"{file}: {expected} a file"


def test_the_log_tells_what_all_runs_took(ran: Path):
    lines = [
        {"event": "stage ends", "stage": "extract", "wall_s": 2.0, "cpu_s": 3.0},
        {"event": "stage ends", "stage": "extract", "wall_s": 1.0, "cpu_s": 0.5},
        {"event": "said", "text": "hello"},
    ]
    (ran / "work" / "log.jsonl").write_text("\n".join(map(json.dumps, lines)) + '\n{"event": "stage en')
    extracted = survey(ran / "work").stages[0]
    assert (extracted.wall_s, extracted.cpu_s) == (3.0, 3.5)


def test_machines_get_what_people_get(ran: Path, capsys: pytest.CaptureFixture[str]):
    capsys.readouterr()
    assert run("status", ran / "work", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found == json.loads(json.dumps(as_json(survey(ran / "work"))))
    assert [stage["state"] for stage in found["stages"]] == ["done"] * 3


@pytest.mark.parametrize("settings", [*PRESETS.values(), TrackingConfig()])
def test_settings_come_back_from_a_record(settings: RegistrationConfig | TrackingConfig):
    said = json.loads(json.dumps(settings, default=plain_value))
    assert rebuilt(type(settings), said) == settings


def test_settings_of_another_version_are_told():
    with pytest.raises(InputError, match="made by another version of capture4d, with settings beauty"):
        rebuilt(TrackingConfig, {"beauty": 1})


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(None, "–"), (0.123, "0.12 s"), (42.4, "42 s"), (90, "2 min"), (7200, "2.0 h"), (360000, "100 h")],
)
def test_times_are_short(seconds: float | None, text: str):
    assert duration(seconds) == text


@pytest.mark.parametrize(
    ("count", "text"), [(0, "0 B"), (999, "999 B"), (1500, "1.5 kB"), (2.5e10, "25 GB"), (3e12, "3.0 TB")]
)
def test_sizes_are_short(count: float, text: str):
    assert size(count) == text
