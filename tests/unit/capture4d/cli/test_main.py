"""The command line: what is wrong is one line and exit 1, and nothing that was done is lost."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d import pipeline
from capture4d.captures.garment_scans import load_garment_scan
from capture4d.cli.main import COMMANDS, main
from capture4d.errors import InputError
from capture4d.files.atomic import write_bytes, write_json
from capture4d.files.records import load_garment, save_garment, save_poses
from capture4d.mesh_files.meshes import read_mesh, write_mesh
from capture4d.mesh_files.ply import ply_bytes
from capture4d.runs.stage import StageResult
from capture4d.types import Mesh, PoseSequence
from data_synth.config import SynthConfig
from tests.command_line import fails, run


def still_poses(frames: tuple[int, ...]) -> PoseSequence:
    """Of a body of one joint."""
    return PoseSequence(
        rotations=np.tile(np.eye(3, dtype=np.float32), (len(frames), 1, 1, 1)),
        translations=np.zeros((len(frames), 3), np.float32),
        shape=np.zeros(1, np.float32),
        frame_ids=np.array(frames, np.int32),
        fps=60.0,
        joint_names=("root",),
    )


def extract(capture: Path, work: Path) -> tuple[str | Path, ...]:
    return "extract", capture, "--output", work, "--workers", "1"


@pytest.fixture
def work(tmp_path: Path) -> Path:
    return tmp_path / "work"


# --- the command itself


def test_help_names_every_command_and_loads_nothing_heavy():
    script = (
        "import sys; from capture4d.cli.main import main\n"
        "try: main(['--help'])\n"
        "except SystemExit as end: code = end.code\n"
        "heavy = {'numpy', 'scipy', 'torch', 'open3d', 'numba', 'warp', 'newton', 'trimesh'} & set(sys.modules)\n"
        "sys.exit(code or bool(heavy) and f'loaded {heavy}')"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert set(re.findall(r"^  (\S+(?: \S+)?)  ", done.stdout, re.MULTILINE)) == set(COMMANDS)


@pytest.mark.parametrize(
    "arguments", [["regster"], ["run"], ["run", "x"], ["run", "x", "--output", "y", "--wrokers", "3"]]
)
def test_a_wrong_command_line_is_exit_2(arguments: list[str], capsys: pytest.CaptureFixture[str]):
    assert run(*arguments) == 2
    said = capsys.readouterr()
    assert "Traceback" not in said.err + said.out


def test_the_scanner_is_chosen_in_one_word(monkeypatch: pytest.MonkeyPatch):
    seen = []

    def synth(output: Path, config: SynthConfig, **_: object) -> StageResult:
        seen.append(config.scanner.sensor)
        return StageResult(output, "")

    monkeypatch.setattr(pipeline, "synth", synth)
    for chosen in ((), ("--scanner", "stereo"), ("--scanner.sensor", "stereo")):
        assert run("synth", "take", "--preset", "tiny", *chosen) == 0
    assert seen == ["depth", "stereo", "stereo"]


def test_a_near_miss_gets_a_hint(capsys: pytest.CaptureFixture[str]):
    run("regster")
    assert "did you mean 'register'?" in capsys.readouterr().err


def test_a_preset_is_what_single_options_start_from(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    from capture4d.cli.commands import stages
    from registration.config import PAPER, GraphConfig, RegistrationConfig

    seen = []

    def register(capture: Path, work: Path, config: RegistrationConfig, **_: object) -> StageResult:
        seen.append(config)
        return StageResult(work, "")

    monkeypatch.setattr(pipeline, "register", register)
    monkeypatch.setattr(stages, "_say_lengths", lambda capture: None)
    for options in ([], ["--preset", "paper"], ["--preset=paper", "--registration.graph.nodes", "99"]):
        run("register", "capture", "--output", tmp_path, *options)
    assert seen[0] == RegistrationConfig()
    assert seen[1] == PAPER
    assert seen[2] == replace(PAPER, graph=GraphConfig(nodes=99, vertices=0))


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (
            InputError("expected cloth,\nfound none", where="scan.ply"),
            1,
            "capture4d: scan.ply: expected cloth,\\nfound none\n",
        ),
        (PermissionError(13, "Permission denied", "out/x.npz"), 1, "capture4d: out/x.npz: Permission denied\n"),
        (
            OSError(28, "No space left on device", "out/x.npz"),
            1,
            "finished frames are kept, the same command goes on\n",
        ),
    ],
)
def test_what_is_the_users_to_repair_is_one_line(
    error: Exception, code: int, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(pipeline, "extract", fail)
    assert run("extract", "capture", "--output", "work") == code
    written = capsys.readouterr().err
    assert written.endswith(said)
    assert written.count("\n") == 1


def test_our_own_bugs_keep_their_traceback(monkeypatch: pytest.MonkeyPatch):
    def fail(*_: object, **__: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(pipeline, "extract", fail)
    with pytest.raises(ZeroDivisionError):
        main(["extract", "capture", "--output", "work"])


# --- bad input


def test_missing_capture(work: Path, capsys: pytest.CaptureFixture[str]):
    assert "nowhere: no such capture folder" in fails(capsys, *extract(Path("nowhere"), work))
    assert not work.exists()


def damaged(path: Path) -> dict[str, bytes]:
    """What may have become of a good scan, by what is said of it."""
    good, found = path.read_bytes(), read_mesh(path)
    head, body = good.split(b"end_header\n")
    empty = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    return {
        "000006.ply: cut off": good[: len(good) // 2],
        "000006.ply: expected a colour per vertex": ply_bytes(found.mesh, None, None),
        "000006.ply: empty mesh": ply_bytes(empty, np.zeros((0, 3), np.uint8), None),
        "expected finite numbers, found NaN": head + b"end_header\n" + np.float32(np.nan).tobytes() + body[4:],
        "000006.ply: ": b"",
    }


def test_a_scheduler_that_is_not_there(
    tube_capture: Path, work: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    pytest.importorskip("distributed")
    monkeypatch.setattr("capture4d.runs.cluster.jobs.CONNECT_S", 0.3)
    said = fails(capsys, *extract(tube_capture, work), "--scheduler", "tcp://127.0.0.1:9")
    assert "--scheduler: expected a scheduler such as tcp://HOST:8786, found none at tcp://127.0.0.1:9" in said


def test_a_damaged_scan_is_flagged_and_the_take_goes_on(
    tube_capture: Path, work: Path, capsys: pytest.CaptureFixture[str]
):
    path = tube_capture / "scans" / "000006.ply"
    for number, (said, data) in enumerate(damaged(path).items()):
        path.write_bytes(data)
        folder = work / str(number)
        assert run(*extract(tube_capture, folder)) == 0
        line = capsys.readouterr().err.splitlines()[-1]
        assert line.startswith("capture4d: no garment in 1 of 3 frames: 6; frame 6: ")
        assert said in line
        with np.load(folder / "garment" / "frames" / "000006.npz") as arrays:
            assert said in str(arrays["reason"])
        for frame in ("000005", "000007"):
            assert len(load_garment_scan(folder / "garment" / "frames" / f"{frame}.npz", int(frame)).mesh.vertices)
    register = ("register", tube_capture, "--output", folder, "--workers", "1")
    assert run(*register) == 3
    assert "1 of 3 frames failed (33.3 %, more than the 5 % allowed): 6; frame 6: " in capsys.readouterr().err
    assert run(*register, "--max-failed", "34") == 0
    assert "--max-failed: expected from 0 to 100, found 101" in fails(capsys, *register, "--max-failed", "101")
    records = [json.loads(line) for line in (folder / "registration" / "metrics.jsonl").read_text().splitlines()]
    assert [record["verdict"] == "failed" for record in records] == [False, True, False]
    assert said in records[1]["reasons"][0]


def test_a_damaged_first_scan_is_flagged_too_and_nothing_but_damaged_scans_is_an_error(
    tube_capture: Path, work: Path, capsys: pytest.CaptureFixture[str]
):
    scans = sorted((tube_capture / "scans").iterdir())
    scans[0].write_bytes(b"")
    assert run(*extract(tube_capture, work)) == 0
    for scan in scans:
        scan.write_bytes(b"ply")
    assert "000005.ply: " in fails(capsys, *extract(tube_capture, work / "2"))
    scans[1].unlink()
    assert "000006.ply: no such scan" in fails(capsys, *extract(tube_capture, work / "3"))


def test_a_repaired_scan_is_read_by_the_same_command(
    tube_capture: Path, work: Path, capsys: pytest.CaptureFixture[str]
):
    path = tube_capture / "scans" / "000007.ply"
    good = path.read_bytes()
    path.write_bytes(good[:-9])
    assert run(*extract(tube_capture, work)) == 0
    assert ": 7; frame 7: " in capsys.readouterr().err
    done = work / "garment" / "frames" / "000005.npz"
    before = done.stat().st_mtime_ns
    path.write_bytes(good)
    assert run(*extract(tube_capture, work)) == 0
    assert "no garment" not in capsys.readouterr().err
    assert len(load_garment_scan(work / "garment" / "frames" / "000007.npz", 7).mesh.vertices)
    assert done.stat().st_mtime_ns == before
    scan = tube_capture / "scans" / "000005.ply"
    scan.write_bytes(scan.read_bytes() + b"0")
    assert run(*extract(tube_capture, work)) == 0
    assert "garment: frame 5 replaced" in capsys.readouterr().err
    assert done.stat().st_mtime_ns != before


def test_what_registration_starts_from_is_what_it_was(
    tube_capture: Path, work: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    register = ("register", tube_capture, "--output", work, "--workers", "1")
    assert run(*extract(tube_capture, work)) == 0
    other = shutil.copytree(tube_capture, tmp_path / "other")
    description = json.loads((other / "capture.json").read_text())
    write_json(other / "capture.json", {**description, "garment_colour": "#2f62ca"})
    said = fails(capsys, "register", other, "--output", work)
    assert "'extract' is of the take as it was before (garment colour #2f62c9 to #2f62ca)" in said
    assert said.endswith(f"run: capture4d extract {other} --output {work}")
    write_json(other / "capture.json", {**description, "fps": 30.0})
    assert run("register", other, "--output", work, "--workers", "1") == 0, "no stage of these reads the frame rate"

    frames = work / "registration" / "frames"
    assert run(*register) == 0
    before = {path: path.stat().st_mtime_ns for path in frames.iterdir()}
    template = load_garment(tube_capture / "template.npz")
    moved = template.template.with_vertices(template.template.vertices + np.float32(0.001))
    save_garment(tube_capture / "template.npz", replace(template, template=moved))
    capsys.readouterr()
    assert run(*register) == 0
    assert "registration: template changed" in capsys.readouterr().err
    after = {path: path.stat().st_mtime_ns for path in frames.iterdir()}
    assert all(before[path] != after[path] for path in before)
    save_poses(tube_capture / "poses.npz", still_poses((5, 6, 7)))
    assert run(*extract(tube_capture, work)) == 0, "poses do not concern it"
    assert run(*register) == 0
    assert "registration: motion added" in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in frames.iterdir()} == after, "nor a template without weights"


def test_another_take_is_not_taken_for_one_that_has_changed(
    tube_capture: Path, work: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert run(*extract(tube_capture, work)) == 0
    other = shutil.copytree(tube_capture, tmp_path / "other")
    assert run(*extract(other, work)) == 0, "the same take elsewhere"
    assert run(*extract(tube_capture, work)) == 0
    for path in (other / "scans").iterdir():
        path.write_bytes(path.read_bytes() + b"0")
    said = fails(capsys, *extract(other, work))
    assert said == (
        f"{work / 'garment'}: was made from another take, {tube_capture.resolve()}: none of its scans is the same; "
        "give another --output, or --overwrite"
    )
    assert run(*extract(other, work), "--overwrite") == 0


def test_a_run_without_a_template_ends_before_it_begins(
    tube_capture: Path, work: Path, capsys: pytest.CaptureFixture[str]
):
    (tube_capture / "template.npz").unlink()
    assert "registration needs a template" in fails(capsys, "run", tube_capture, "--output", work)
    assert not work.exists()


@pytest.mark.parametrize("entry", ["garment_colour", "boundary_colours"])
def test_a_colour_that_is_not_in_the_scan(
    entry: str, tube_capture: Path, work: Path, capsys: pytest.CaptureFixture[str]
):
    description = json.loads((tube_capture / "capture.json").read_text())
    description[entry] = "#00ff00" if entry == "garment_colour" else {"neck": "#00ff00", "hem": "#00ff00"}
    write_json(tube_capture / "capture.json", description)
    said = fails(capsys, *extract(tube_capture, work))
    assert "000005.ply" in said
    assert "#00ff00" in said


def test_a_template_without_the_borders_that_are_painted(
    tube_capture: Path, work: Path, capsys: pytest.CaptureFixture[str]
):
    template = load_garment(tube_capture / "template.npz")
    save_garment(tube_capture / "template.npz", replace(template, loops={}))
    assert run(*extract(tube_capture, work)) == 0
    said = fails(capsys, "register", tube_capture, "--output", work, "--workers", "1")
    assert "border" in said


def test_poses_that_do_not_match_the_scans(tube_capture: Path, work: Path, capsys: pytest.CaptureFixture[str]):
    save_poses(tube_capture / "poses.npz", still_poses((5, 6)))
    assert run(*extract(tube_capture, work)) == 0
    said = fails(capsys, "register", tube_capture, "--output", work, "--workers", "1")
    assert "poses.npz: expected a pose for each of 3 scans, found none for 1 of them, frame 7 first" in said


def test_registering_what_was_not_extracted(tube_capture: Path, work: Path, capsys: pytest.CaptureFixture[str]):
    said = fails(capsys, "register", tube_capture, "--output", work)
    assert f"run: capture4d extract {tube_capture} --output {work}" in said


def test_other_settings_are_refused_and_overwrite_starts_clean(
    tube_capture: Path, work: Path, capsys: pytest.CaptureFixture[str]
):
    register = ("register", tube_capture, "--output", work, "--workers", "1")
    assert run(*extract(tube_capture, work)) == 0
    assert run(*register) == 0
    stacked = (work / "registration" / "vertices.npy").read_bytes()

    said = fails(capsys, *register, "--registration.graph.nodes", "77")
    assert "was made with other settings (nodes 300 to 77); with --overwrite the same command makes it anew" in said
    assert "--overwrite" in said
    assert (work / "registration" / "vertices.npy").read_bytes() == stacked
    assert run(*register, "--registration.graph.nodes", "77", "--overwrite") == 0
    assert (work / "registration" / "vertices.npy").read_bytes() != stacked


def test_an_output_folder_of_something_else(tube_capture: Path, work: Path, capsys: pytest.CaptureFixture[str]):
    write_bytes(work / "garment" / "notes.txt", b"mine")
    assert "expected an empty folder" in fails(capsys, *extract(tube_capture, work), "--overwrite")
    assert (work / "garment" / "notes.txt").read_bytes() == b"mine"


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 400 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = os.geteuid() == 0 and shutil.which("mount")
    if not mounted or subprocess.run(["mount", "-t", "tmpfs", "-o", "size=400k", "none", folder]).returncode:
        pytest.skip("needs the right to mount a tmpfs")
    yield folder
    subprocess.run(["umount", folder], check=True)


def test_a_full_disk_loses_nothing(
    tube_capture: Path, small_disk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    said = fails(capsys, *extract(tube_capture, small_disk))
    assert "No space left on device; finished frames are kept, the same command goes on" in said
    assert str(small_disk) in said
    finished = sorted((small_disk / "garment" / "frames").glob("*.npz"))
    assert finished
    assert not list(small_disk.rglob("*.partial"))
    assert run(*extract(tube_capture, tmp_path / "large")) == 0
    for path in finished:
        assert path.read_bytes() == (tmp_path / "large" / "garment" / "frames" / path.name).read_bytes()

    subprocess.run(["mount", "-o", "remount,size=4m", small_disk], check=True)
    assert run(*extract(tube_capture, small_disk)) == 0


def test_run_does_every_stage_and_a_second_run_nothing(
    tube_capture: Path, work: Path, capsys: pytest.CaptureFixture[str]
):
    command = ("run", tube_capture, "--output", work, "--workers", "1")
    assert run(*command) == 0
    assert f"report: {work / 'report' / 'index.html'}" in capsys.readouterr().out
    made = {path: path.stat().st_mtime_ns for path in work.rglob("*.npz")}
    assert run(*command) == 0
    assert {path: path.stat().st_mtime_ns for path in work.rglob("*.npz")} == made
    assert run("report", work, "--fail-above", "fit_mean_mm=1.0") == 0
    assert "no metric 'beauty'" in fails(capsys, "report", work, "--fail-above", "beauty=1")


def test_run_reports_a_take_with_a_scan_that_is_cut_short(tube_capture: Path, work: Path):
    path = tube_capture / "scans" / "000006.ply"
    path.write_bytes(path.read_bytes()[:1000])
    assert run("run", tube_capture, "--output", work, "--workers", "1") == 3
    page = (work / "report" / "index.html").read_text()
    assert "000006.ply: cut off" in page
    assert 'alt="no scan, frame 6"' in page
    metrics = json.loads((work / "report" / "metrics.json").read_text())["metrics"]
    assert {entry["key"]: entry["value"] for entry in metrics}["frames_failed"] == 1


def test_run_reports_a_take_in_which_every_frame_failed(tube_capture: Path, work: Path):
    template = load_garment(tube_capture / "template.npz")
    far = template.template.with_vertices(template.template.vertices + np.float32(9))
    save_garment(tube_capture / "template.npz", replace(template, template=far))
    assert run("run", tube_capture, "--output", work, "--workers", "1", "--max-failed", "99") == 3
    metrics = json.loads((work / "report" / "metrics.json").read_text())["metrics"]
    assert {entry["key"]: entry["value"] for entry in metrics}["frames_failed"] == 3


def test_register_mesh_keeps_the_templates_faces_and_measures(
    tube_capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    template, scan = tmp_path / "template.obj", tube_capture / "scans" / "000007.ply"
    mesh = load_garment(tube_capture / "template.npz").template
    write_mesh(template, mesh)
    assert run("register-mesh", template, scan, "--output", tmp_path / "out.ply", "--border-colour", "ffd200") == 0
    np.testing.assert_array_equal(read_mesh(tmp_path / "out.ply").mesh.faces, mesh.faces)
    measures = json.loads((tmp_path / "out.json").read_text())
    assert measures["fit_mean_mm"] < 1
    assert measures["boundary_mean_mm"] < 5
    assert measures["cpu_s"] > 0

    half = tmp_path / "half.ply"
    write_mesh(half, mesh.with_vertices(0.4 * mesh.vertices))
    assert run("register-mesh", template, half, "--output", tmp_path / "3.ply", "--lengths", "kept") == 3
    said = capsys.readouterr()
    assert said.out.endswith(f"failed: {tmp_path / '3.ply'}, measures: {tmp_path / '3.json'}\n")
    assert "3.ply: failed: " in said.err
    assert len(read_mesh(tmp_path / "3.ply").mesh.vertices) == len(mesh.vertices)

    uncoloured = tmp_path / "uncoloured.ply"
    write_mesh(uncoloured, read_mesh(scan).mesh)
    command = ("register-mesh", template, uncoloured, "--output", tmp_path / "2.ply", "--border-colour", "ffd200")
    assert "uncoloured.ply: expected a colour per vertex" in fails(capsys, *command)
    assert "no such mesh file" in fails(capsys, "register-mesh", template, "no.ply", "--output", tmp_path / "2.ply")
    assert not (tmp_path / "2.ply").exists()


# --- the gate


@pytest.mark.parametrize(
    ("limits", "code"),
    [
        (["above fit_mean_mm=1.0"], 0),
        (["above fit_mean_mm=0.5"], 3),
        (["above fit_mean_mm=1.0", "above boundary_mean_mm=1.0"], 3),
        (["above border_mean_mm=1e9"], 3),  # null: not measured
        (["below covered_percent=90"], 0),
        (["below covered_percent=99.5"], 3),
        (["below border_mean_mm=0"], 3),
        (["above fit_mean_mm=1.0", "below covered_percent=99.5"], 3),
        (["above fit=1"], 1),
        (["below joint_max_mm=1"], 1),  # there is such a metric, but not of this take
        (["above fit_mean_mm"], 1),
        (["below covered_percent=nan"], 1),
    ],
)
def test_the_report_gates(
    limits: list[str], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    values = {"fit_mean_mm": 0.7, "boundary_mean_mm": 2.0, "border_mean_mm": None, "covered_percent": 98.0}
    write_json(
        tmp_path / "report" / "metrics.json",
        {"metrics": [{"key": key, "value": value, "unit": "mm", "better": "lower"} for key, value in values.items()]},
    )
    monkeypatch.setattr(pipeline, "report", lambda work, **_: StageResult(work / "report" / "index.html", ""))
    options = [word for limit in limits for word in f"--fail-{limit}".split()]
    assert run("report", tmp_path, *options) == code
    assert capsys.readouterr().err.count("\n") == bool(code)
