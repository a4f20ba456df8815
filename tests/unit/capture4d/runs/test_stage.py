"""Output is whole or absent, stages resume and refuse, workers end with their parent."""

import ast
import errno
import importlib
import os
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from capture4d.errors import InputError
from capture4d.files.atomic import read_json, write_bytes, write_json, write_npy_rows, write_npz
from capture4d.runs.stage import SCHEMAS, Stage, open_stage, require_complete
from capture4d.runs.workers import WorkerDied, run_jobs

FRAMES = (3, 4, 7)


@dataclass(frozen=True)
class Settings:
    weight: float = 1.0
    sizes: tuple[int, ...] = (1, 2)


def open_test_stage(folder: Path, settings: Settings | None = None, *, garment: str = "aa", overwrite: bool = False):
    return open_stage(
        folder,
        name="test",
        schema=1,
        config=settings or Settings(),
        upstream={"garment": garment},
        overwrite=overwrite,
    )


def finish_frames(stage: Stage) -> str:
    for frame_id in stage.pending(FRAMES):
        write_npz(stage.frame_path(frame_id), value=np.full(5, frame_id))
    return stage.finish([stage.frame_path(frame_id) for frame_id in FRAMES]).digest


# --- files


def test_equal_arrays_give_equal_bytes(tmp_path: Path):
    for name in ("a.npz", "b.npz"):
        write_npz(tmp_path / name, x=np.arange(4), y=np.eye(2))
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_rows_make_the_array_they_come_from(tmp_path: Path):
    array = np.random.default_rng(0).random((5, 7, 3), np.float32)
    write_npy_rows(tmp_path / "rows.npy", iter(array), count=len(array))
    np.testing.assert_array_equal(np.load(tmp_path / "rows.npy", allow_pickle=False), array)


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "frame.npz"
    write_bytes(path, b"old")

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as caught:
        write_bytes(path, b"new")
    assert caught.value.filename == str(path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["frame.npz"]
    assert path.read_bytes() == b"old"


def test_json_refuses_nan(tmp_path: Path):
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "x.json", {"fit": float("nan")})
    assert not list(tmp_path.iterdir())


def test_damaged_json_is_named(tmp_path: Path):
    (tmp_path / "x.json").write_text('{"a": ')
    with pytest.raises(InputError, match=r"x\.json: not valid JSON"):
        read_json(tmp_path / "x.json")


def test_a_writer_killed_at_any_moment_leaves_whole_files_only(tmp_path: Path):
    script = textwrap.dedent(
        """
        import sys, numpy as np
        from pathlib import Path
        from capture4d.files.atomic import write_npz
        print("ready", flush=True)
        for round in range(10**6):
            for frame in range(4):
                write_npz(Path(sys.argv[1]) / f"{frame}.npz", value=np.full(200_000, round))
        """
    )
    for delay in (0.02, 0.05, 0.11):
        writer = subprocess.Popen([sys.executable, "-c", script, str(tmp_path)], stdout=subprocess.PIPE)
        assert writer.stdout is not None
        writer.stdout.readline()
        time.sleep(delay)
        writer.kill()
        writer.communicate()
        for path in tmp_path.glob("[0-9].npz"):
            with np.load(path, allow_pickle=False) as arrays:
                assert len(np.unique(arrays["value"])) == 1


# --- stages


def test_a_stage_resumes_with_the_same_digest(tmp_path: Path):
    whole = finish_frames(open_test_stage(tmp_path / "whole"))
    stage = open_test_stage(tmp_path / "halted")
    write_npz(stage.frame_path(4), value=np.full(5, 4))
    assert open_test_stage(tmp_path / "halted").pending(FRAMES) == [3, 7]
    assert finish_frames(open_test_stage(tmp_path / "halted")) == whole
    assert require_complete(tmp_path / "halted", "test", "make") == whole


def test_a_complete_stage_is_not_hashed_again_unless_something_was_written(tmp_path: Path):
    stage = open_test_stage(tmp_path)
    digest = finish_frames(stage)
    paths = [stage.frame_path(frame_id) for frame_id in FRAMES]
    write_npz(paths[0], value=np.zeros(1))  # behind its back
    again = open_test_stage(tmp_path)
    assert again.was_complete
    assert again.finish(paths, changed=False).digest == digest
    assert require_complete(tmp_path, "test", "make") == digest
    assert open_test_stage(tmp_path).finish(paths).digest != digest
    open_test_stage(tmp_path)  # and is killed
    assert not open_test_stage(tmp_path).was_complete


def test_frames_are_counted_by_their_files(tmp_path: Path):
    stage = open_test_stage(tmp_path)
    assert stage.count() == 0
    finish_frames(stage)
    (tmp_path / "frames" / ".000009.npz.x.partial").touch()
    assert stage.count() == len(FRAMES)


def test_a_stage_made_from_something_else_names_the_repair(tmp_path: Path):
    finish_frames(open_test_stage(tmp_path, garment="aa"))
    require_complete(tmp_path, "test", "make", made_from={"garment": "aa"})
    with pytest.raises(InputError, match=r"from this garment as it is now.*run: make --overwrite"):
        require_complete(tmp_path, "test", "make", made_from={"garment": "bb"})


def test_a_frame_cut_off_by_other_means_is_pending(tmp_path: Path):
    stage = open_test_stage(tmp_path / "stage")
    finish_frames(stage)
    path = stage.frame_path(7)
    path.write_bytes(path.read_bytes()[:-30])
    assert stage.pending(FRAMES) == [7]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"settings": Settings(weight=2.0)}, "other settings (weight 1.0 to 2.0); with --overwrite"),
        ({"settings": Settings(sizes=(1,))}, "other settings (sizes [1, 2] to [1]); with --overwrite"),
        ({"garment": "bb"}, "other inputs (garment changed); with --overwrite"),
    ],
)
def test_a_stage_refuses_other_settings_and_keeps_its_files(tmp_path: Path, change: dict, message: str):
    folder = tmp_path / "stage"
    digest = finish_frames(open_test_stage(folder))
    with pytest.raises(InputError) as caught:
        open_test_stage(folder, **change)
    assert message in str(caught.value)
    assert "--overwrite" in str(caught.value)
    assert require_complete(folder, "test", "make") == digest


def test_overwrite_leaves_nothing_of_the_old_run(tmp_path: Path):
    folder = tmp_path / "stage"
    finish_frames(open_test_stage(folder))
    (folder / "metrics.jsonl").write_text("old")
    stage = open_test_stage(folder, Settings(weight=2.0), overwrite=True)
    assert stage.pending(FRAMES) == list(FRAMES)
    assert [path.name for path in folder.rglob("*") if path.is_file()] == ["stage.json"]


def test_an_interrupted_overwrite_goes_on(tmp_path: Path):
    folder = tmp_path / "stage"
    finish_frames(open_test_stage(folder))
    record = read_json(folder / "stage.json")
    write_json(folder / "stage.json", {**record, "status": "discarded"})
    with pytest.raises(InputError, match="not finished; run: make"):
        require_complete(folder, "test", "make")
    assert open_test_stage(folder, Settings(weight=2.0)).pending(FRAMES) == list(FRAMES)


def test_a_stage_never_touches_a_folder_of_something_else(tmp_path: Path):
    (tmp_path / "thesis.tex").write_text("important")
    with pytest.raises(InputError, match="expected an empty folder"):
        open_test_stage(tmp_path, overwrite=True)
    assert (tmp_path / "thesis.tex").read_text() == "important"
    open_stage(tmp_path / "other", name="other", schema=1, config=Settings(), upstream={})
    with pytest.raises(InputError, match="found output of 'other'"):
        open_test_stage(tmp_path / "other", overwrite=True)


def test_finishing_removes_what_killed_writers_left(tmp_path: Path):
    stage = open_test_stage(tmp_path)
    (stage.path / "frames").mkdir()
    ((stage.path / "frames") / ".000003.npz.abc.partial").write_bytes(b"half")
    finish_frames(stage)
    assert not list((stage.path / "frames").glob(".*"))


def test_an_unfinished_stage_names_the_command_that_finishes_it(tmp_path: Path):
    with pytest.raises(InputError, match="found none; run: capture4d extract x"):
        require_complete(tmp_path / "garment", "extract", "capture4d extract x")
    open_test_stage(tmp_path / "garment")
    with pytest.raises(InputError, match="'test' is not finished; run: capture4d test x"):
        require_complete(tmp_path / "garment", "test", "capture4d test x")


# --- workers


def square(number: int) -> int:
    return number * number


def fail_on_three(number: int) -> int:
    if number == 3:
        raise InputError("frame 3: expected cloth")
    return number


def kill_itself(number: int) -> int:
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


@pytest.mark.parametrize("workers", [1, 2])
def test_jobs_give_the_same_results_on_any_number_of_workers(workers: int):
    assert sorted(run_jobs(square, range(7), workers=workers, label="square")) == [n * n for n in range(7)]


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_of_a_job_reaches_the_caller(workers: int):
    with pytest.raises(InputError, match="frame 3: expected cloth"):
        list(run_jobs(fail_on_three, range(6), workers=workers, label="fail"))


def test_a_killed_worker_is_one_clear_error():
    with pytest.raises(WorkerDied, match="finished frames are kept"):
        list(run_jobs(kill_itself, range(4), workers=2, label="kill"))


def test_workers_do_not_outlive_a_killed_parent(tmp_path: Path):
    script = tmp_path / "parent.py"
    script.write_text(
        textwrap.dedent(
            f"""
            import os, time
            from pathlib import Path
            from capture4d.runs.workers import run_jobs

            def announce(number):
                Path({str(tmp_path)!r}, f"{{os.getpid()}}.pid").touch()
                time.sleep(60)

            if __name__ == "__main__":
                list(run_jobs(announce, range(2), workers=2, label="announce"))
            """
        )
    )
    parent = subprocess.Popen([sys.executable, script], stderr=subprocess.DEVNULL, cwd=Path(__file__).parents[4])
    try:
        wait_for(lambda: len(list(tmp_path.glob("*.pid"))) == 2)
    finally:
        parent.kill()
        parent.wait()
    workers = [int(path.stem) for path in tmp_path.glob("*.pid")]
    wait_for(lambda: not any(is_running(worker) for worker in workers))


def is_running(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().split()[2] != "Z"
    except FileNotFoundError:
        return False


def wait_for(condition, *, seconds: float = 60) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def count_preparations(folder: Path) -> Path:
    (folder / f"{os.getpid()}-{len(list(folder.iterdir()))}").touch()
    return folder


def add_to(folder: Path, job: int) -> tuple[Path, int]:
    return folder, job


@pytest.mark.parametrize("workers", [1, 2])
def test_each_process_prepares_once(tmp_path: Path, workers: int):
    prepare = partial(count_preparations, tmp_path)
    results = list(run_jobs(add_to, range(8), prepare=prepare, workers=workers, label="prepare"))
    assert sorted(results) == [(tmp_path, job) for job in range(8)]
    processes = [path.name.partition("-")[0] for path in tmp_path.iterdir()]
    assert len(processes) == len(set(processes)) <= workers


def refuse() -> int:
    raise InputError("expected a folder, found none", where="work")


@pytest.mark.parametrize("workers", [1, 2])
def test_what_is_wrong_with_a_preparation_is_said_as_it_is(workers: int):
    with pytest.raises(InputError, match=r"^work: expected a folder, found none$") as caught:
        list(run_jobs(add_to, range(2), prepare=refuse, workers=workers, label="prepare"))
    assert (caught.value.where, caught.value.reason) == ("work", "expected a folder, found none")


OPENERS = ("open_stage", "open_growing_stage", "open_file_stage")


def test_the_formats_that_are_known_are_those_that_are_written() -> None:
    """What every opened stage in the packages hands on as its name and its schema."""
    root, written = Path(__file__).parents[4], dict[str, int]()
    for package in ("capture4d", "data_synth", "registration", "retarget", "wrinkles"):
        for path in (root / package).rglob("*.py"):
            text = path.read_text()
            if not any(f"{opener}(" in text for opener in OPENERS) or "SCHEMA = " not in text:
                continue
            module = importlib.import_module(path.relative_to(root).with_suffix("").as_posix().replace("/", "."))
            for call in ast.walk(ast.parse(text)):
                if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id in OPENERS:
                    name = next(word.value for word in call.keywords if word.arg == "name")
                    stage = name.value if isinstance(name, ast.Constant) else getattr(module, ast.unparse(name))
                    written[stage] = max(module.SCHEMA, written.get(stage, 0))
    assert written == SCHEMAS


def test_a_record_of_a_later_version_is_refused(tmp_path: Path):
    stage = open_test_stage(tmp_path / "stage")
    finish_frames(stage)
    record = read_json(tmp_path / "stage" / "stage.json")
    for name, schema in (("register", SCHEMAS["register"] + 1), ("pairs", SCHEMAS["wrinkles maps"] + 1)):
        write_json(tmp_path / "stage" / "stage.json", {**record, "stage": name, "schema": schema})
        for read in (
            lambda: require_complete(tmp_path / "stage", "register", "capture4d register"),
            lambda: open_test_stage(tmp_path / "stage"),
        ):
            with pytest.raises(InputError, match=rf"format .* found {schema}: it comes from a later version of"):
                read()


@pytest.mark.parametrize("changed", [
    {"stage": 3}, {"stage": "a\nb"}, {"schema": "1"}, {"schema": True}, {"digest": 7}, {"upstream": []},
    {"upstream": {"garment": 1}}, {"sources": {"capture": None}},
])  # fmt: skip
def test_a_record_that_is_none_is_one_line(tmp_path: Path, changed: dict[str, object]):
    finish_frames(open_test_stage(tmp_path / "stage"))
    record = read_json(tmp_path / "stage" / "stage.json")
    write_json(tmp_path / "stage" / "stage.json", record | changed)
    with pytest.raises(InputError) as caught:
        require_complete(tmp_path / "stage", "test", "capture4d test")
    assert str(caught.value).startswith(str(tmp_path / "stage" / "stage.json"))
    assert "\n" not in str(caught.value)
