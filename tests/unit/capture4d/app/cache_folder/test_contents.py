"""Every entry of the cache folder is told with its size, its last use, and whether it is still used."""

import os
from pathlib import Path

import pytest

from capture4d.app.cache_folder import contents as module
from capture4d.app.cache_folder.contents import Contents, Entry, look
from capture4d.errors import InputError
from capture4d.runs.locks import alone
from tests.unit.capture4d.app.cache_folder.conftest import OLD_TAKE, TAKE, Record


def entry(contents: Contents, name: str) -> Entry:
    return next(each for each in contents.entries if each.name == name)


def states(folder: Path) -> dict[str, str]:
    return {each.name: each.state for each in look(folder).entries}


def snapshot(folder: Path) -> dict[str, tuple[int, int]]:
    """Every path with its mtime and size."""
    return {str(path): (path.lstat().st_mtime_ns, path.lstat().st_size) for path in sorted(folder.rglob("*"))}


def test_takes_and_what_was_made_from_them_are_told_apart(filled: Path):
    assert states(filled) == {
        f"printed/{OLD_TAKE[6:]}-stripes-1234": "old",
        f"printed/{TAKE[6:]}-stripes-1234": "current",
        OLD_TAKE: "old",
        TAKE: "current",
        f"works/{OLD_TAKE[6:]}": "old",
        f"works/{TAKE[6:]}": "current",
        "body-anny-v1.npz": "current",
        "people": "unknown",
    }


def test_the_largest_comes_first_and_sums_are_those_of_the_files(filled: Path):
    found = look(filled)
    sizes = [each.bytes for each in found.entries]
    assert sizes == sorted(sizes, reverse=True)
    files = [path for path in filled.rglob("*") if path.is_file() or path.is_symlink()]
    links = sum(path.is_symlink() for path in files)
    assert links == 2, "they lead to folders, and are not counted"
    assert found.bytes == sum(path.lstat().st_size for path in files if not path.is_symlink())
    assert entry(found, "body-anny-v1.npz").bytes == 300


def test_looking_changes_nothing(filled: Path):
    before = snapshot(filled)
    look(filled)
    assert snapshot(filled) == before


def test_no_folder_and_an_empty_one_keep_nothing(tmp_path: Path):
    (tmp_path / "empty" / "takes").mkdir(parents=True)
    assert look(tmp_path / "absent").entries == look(tmp_path / "empty").entries == ()
    assert not (tmp_path / "absent").exists()


def test_a_file_in_place_of_the_folder_is_one_line(tmp_path: Path):
    (tmp_path / "cache").write_text("")
    with pytest.raises(InputError, match=r"cache: expected a folder, found a file$"):
        look(tmp_path / "cache")


@pytest.mark.parametrize(("read", "written"), [(5000, 2000), (1000, 5000)])
def test_last_used_is_when_a_file_was_written_or_read(filled: Path, read: int, written: int):
    for path in (filled / TAKE).rglob("*"):
        os.utime(path, (9000 if path.suffix == ".json" else 100, 100))  # records are read by whoever looks
    os.utime(filled / TAKE / "scan.ply", (read, written))
    assert entry(look(filled), TAKE).used == 5000


def test_what_its_take_has_left_is_old(filled: Path):
    (filled / TAKE).rename(filled.parent / "elsewhere")
    found = look(filled)
    for name in (f"printed/{TAKE[6:]}-stripes-1234", f"works/{TAKE[6:]}"):
        assert (entry(found, name).state, entry(found, name).why) == ("old", "its take is gone")


def test_works_that_were_written_from_the_truth_go_by_their_names(filled: Path, record: Record):
    for name in ("tryon-" + TAKE[6:], "tryon-" + OLD_TAKE[6:]):
        record(f"works/{name}/registration", "register", config={}, schema=1)
    record(f"works/unseen/{OLD_TAKE[6:]}/registration", "register", config={}, schema=1)
    found = states(filled)
    assert found[f"works/tryon-{TAKE[6:]}"] == "current"
    assert found[f"works/tryon-{OLD_TAKE[6:]}"] == found["works/unseen"] == "old"


def test_takes_of_a_training_set_decide_and_works_in_it_do_not(cache: Path, record: Record):
    config = {"name": "a", "takes": {}, "held_out": [], "reversed": [], "bodies": {}}
    record("takes/set-0123456789ab", "training-set", config=config)
    record("takes/set-0123456789ab/takes/walk")
    record("takes/set-0123456789ab/works/walk/garment", "extract", config={"x": 1}, schema=1)
    assert states(cache) == {"takes/set-0123456789ab": "current"}
    record("takes/set-0123456789ab/takes/walk", schema=1)
    assert states(cache) == {"takes/set-0123456789ab": "old"}


def test_another_bake_of_the_body_is_old_and_a_later_one_is_not(filled: Path, monkeypatch: pytest.MonkeyPatch):
    (filled / "body-anny-v3.npz").write_bytes(b"x")
    monkeypatch.setattr(module, "BAKE_VERSION", 2)
    found = states(filled)
    assert (found["body-anny-v1.npz"], found["body-anny-v3.npz"]) == ("old", "unknown")


def test_who_is_writing_is_told(filled: Path):
    with alone(filled / TAKE, folder=False), alone(filled / "works" / TAKE[6:] / "garment", folder=True):
        found = look(filled)
    writing = {each.name for each in found.entries if each.writer}
    assert writing == {TAKE, f"works/{TAKE[6:]}"}
    assert entry(found, TAKE).writing == f"being written (process {os.getpid()})"


def test_a_lock_that_a_kill_left_behind_is_neither_an_entry_nor_a_writer(filled: Path):
    (filled / "takes" / f".{TAKE[6:]}.capture4d.lock").write_text("{}")
    found = look(filled)
    assert entry(found, TAKE).writer is None
    assert not any("lock" in each.name for each in found.entries)


@pytest.mark.parametrize(
    "place", ["thesis.tex", "photos/a.jpg", "people/mother.jpg", "works/house/plan.pdf", "takes/b.mov"]
)
def test_what_does_not_look_like_ours_is_strange(filled: Path, place: str):
    (filled / place).parent.mkdir(parents=True, exist_ok=True)
    (filled / place).write_bytes(b"x")
    (strange,) = (each for each in look(filled).entries if each.is_strange)
    assert (filled / place).is_relative_to(strange.path)
    assert strange.state == "unknown"


def test_links_are_not_followed(filled: Path, tmp_path: Path):
    away = tmp_path / "away"
    (filled / TAKE).rename(away)
    (filled / TAKE).symlink_to(away)
    (filled / "printed").rename(tmp_path / "other")
    (filled / "printed").symlink_to(tmp_path / "other")
    found = look(filled)
    assert entry(found, TAKE).bytes < 1000
    assert (entry(found, TAKE).state, entry(found, TAKE).why) == ("unknown", "a link")
    assert entry(found, "printed").is_strange
    assert not any(each.name.startswith("printed/") for each in found.entries)
