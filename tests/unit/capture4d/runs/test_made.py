"""Files know what they were made from, whatever kills whoever makes them."""

import json
import os
import shutil
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest

from capture4d.files.atomic import file_digest
from capture4d.runs.made import FileState, Ledger, file_state, is_as, make, noted


def place(folder: Path, number: int) -> Path:
    return folder / "frames" / f"{number:06d}.npz"


def written(folder: Path, number: int, content: str = "x", **inputs: str) -> Path:
    path = place(folder, number)
    path.parent.mkdir(parents=True, exist_ok=True)
    make(folder, path, lambda: path.write_text(content), inputs=inputs, said={"number": number})
    return path


def work(folder: Path, number: int) -> None:
    written(folder, number, str(number), a="1")


def test_a_file_stands_while_it_is_there_and_would_be_made_from_the_same(tmp_path: Path):
    path = written(tmp_path, 1, a="1", b="2")
    ledger = Ledger.open(tmp_path)
    assert ledger.stands(path, {"b": "2", "a": "1"})
    assert not ledger.stands(path, {"a": "1"})
    assert not ledger.stands(path, {"a": "1", "b": "3"})
    assert not ledger.stands(place(tmp_path, 2), {"a": "1", "b": "2"})
    made = ledger.of(path)
    assert made is not None
    assert made.said == {"number": 1}
    path.unlink()
    assert not ledger.stands(path, {"a": "1", "b": "2"})


def test_what_many_processes_have_made_is_known_and_settled(tmp_path: Path):
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        list(pool.map(work, [tmp_path] * 12, range(12)))
    assert noted(tmp_path) == 12
    before = Ledger.read(tmp_path)
    ledger = Ledger.open(tmp_path)
    assert not (tmp_path / "made").exists()
    assert noted(tmp_path) == 0
    for known in (before, ledger, Ledger.read(tmp_path)):
        assert all(known.stands(place(tmp_path, number), {"a": "1"}) for number in range(12))


def test_one_digest_of_all_is_that_of_the_files(tmp_path: Path):
    paths = [written(tmp_path, number, str(number), a="1") for number in (3, 1, 2)]
    ledger = Ledger.open(tmp_path)
    assert ledger.digest_of(paths) == file_digest(paths, root=tmp_path)


def test_a_file_that_was_being_replaced_does_not_stand_for_what_it_was(tmp_path: Path):
    """Killed between the new file and its line; then what it was made from is as it was before."""
    path = written(tmp_path, 1, "old", a="1")

    def write_and_die() -> None:
        found = path.stat()
        path.write_text("new")
        os.utime(path, ns=(found.st_atime_ns, found.st_mtime_ns))  # at the same moment, of the same size
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make(tmp_path, path, write_and_die, inputs={"a": "2"})
    assert not Ledger.open(tmp_path).stands(path, {"a": "1"})
    assert not Ledger.open(tmp_path).stands(path, {"a": "2"})


def test_lines_that_a_kill_cut_off_are_passed_over(tmp_path: Path):
    for number in range(3):
        written(tmp_path, number, a="1")
    (journal,) = (tmp_path / "made").iterdir()
    whole = journal.read_bytes()
    for cut in range(0, len(whole), 17):
        journal.write_bytes(whole[:cut])
        known = Ledger.read(tmp_path)
        done = whole[:cut].count(b"\n")
        assert [known.stands(place(tmp_path, number), {"a": "1"}) for number in range(3)][:done] == [True] * done
    journal.write_text("[]\n3\n{}\n" + json.dumps({"path": 3, "digest": "a"}) + "\n")
    assert Ledger.read(tmp_path).of(place(tmp_path, 0)) is None


def test_merging_that_was_cut_off_is_done_again(tmp_path: Path):
    path = written(tmp_path, 1, a="1")
    shutil.copytree(tmp_path / "made", tmp_path / "kept")
    Ledger.open(tmp_path)
    (tmp_path / "kept").rename(tmp_path / "made")
    assert Ledger.open(tmp_path).stands(path, {"a": "1"})


def test_a_copied_folder_stands_by_its_contents(tmp_path: Path):
    path = written(tmp_path / "one", 1, "content", a="1")
    Ledger.open(tmp_path / "one")
    shutil.copytree(tmp_path / "one", tmp_path / "two", copy_function=shutil.copyfile)
    copied = tmp_path / "two" / path.relative_to(tmp_path / "one")
    os.utime(copied, (1, 1))
    assert Ledger.open(tmp_path / "two").stands(copied, {"a": "1"})
    copied.write_text("CONTENT")
    assert not Ledger.open(tmp_path / "two").stands(copied, {"a": "1"})


def test_files_that_are_forgotten_are_not_known(tmp_path: Path):
    paths = [written(tmp_path, number, a="1") for number in range(4)]
    ledger = Ledger.open(tmp_path)
    ledger.forget(lambda name: name != paths[2].name)
    ledger.settle()
    assert [Ledger.read(tmp_path).of(path) is not None for path in paths] == [True, True, False, True]


def test_a_file_of_the_users_is_known_by_size_and_time(tmp_path: Path):
    path = tmp_path / "scan.ply"
    path.write_bytes(b"abc")
    moment = path.stat().st_mtime_ns
    fresh, old = file_state(path, "scan.ply"), file_state(path, "scan.ply", now_ns=moment + 3 * 10**9)
    assert (fresh.time_ns, old.time_ns, fresh.digest) == (0, moment, old.digest)
    assert is_as(path, old)
    assert not is_as(path, fresh), "it may have been written again within the same moment"
    os.utime(path, ns=(moment, moment + 1))
    assert not is_as(path, old)
    path.unlink()
    assert file_state(path, "scan.ply") == FileState("scan.ply", 0, 0, "absent")
    assert is_as(path, FileState("scan.ply", 0, 0, "absent"))


def test_a_pipe_is_not_waited_for(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe")
    assert file_state(tmp_path / "pipe", "pipe").digest == "unreadable"
