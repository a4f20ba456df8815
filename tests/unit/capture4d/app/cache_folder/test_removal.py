"""What is to go goes, whole, and nothing else does."""

import shutil
from pathlib import Path

import pytest

from capture4d.app.cache_folder import removal
from capture4d.app.cache_folder.contents import look
from capture4d.app.cache_folder.removal import Removal, chosen, remove
from capture4d.errors import InputError
from capture4d.runs.locks import alone
from tests.unit.capture4d.app.cache_folder.conftest import OLD_TAKE, TAKE

OLD = {OLD_TAKE, f"printed/{OLD_TAKE[6:]}-stripes-1234", f"works/{OLD_TAKE[6:]}"}


def removed(folder: Path, *words: str, dry_run: bool = False) -> Removal:
    contents = look(folder)
    return remove(contents, chosen(contents, words), dry_run=dry_run)


def names(folder: Path) -> set[str]:
    return {entry.name for entry in look(folder).entries}


def test_what_is_old_goes_and_the_rest_stays(filled: Path):
    before, kept = look(filled), names(filled) - OLD
    done = removed(filled, "old")
    assert {entry.name for entry in done.removed} == OLD
    assert done.freed_bytes == before.bytes - look(filled).bytes
    assert names(filled) == kept
    assert not list(filled.rglob(".*")), "neither a lock nor a remainder"


def test_a_dry_run_tells_the_same_and_removes_nothing(filled: Path):
    before = sorted(filled.rglob("*"))
    would = removed(filled, "old", dry_run=True)
    assert sorted(filled.rglob("*")) == before
    assert would == removed(filled, "old")


@pytest.mark.parametrize(
    ("words", "gone"),
    [
        ((TAKE,), {TAKE}),
        ((f"{TAKE}/", "people"), {TAKE, "people"}),
        (("takes",), {TAKE, OLD_TAKE}),
        (("old", "body-anny-v1.npz"), {*OLD, "body-anny-v1.npz"}),
    ],
)
def test_names_folders_of_them_and_words_may_stand_together(filled: Path, words: tuple[str, ...], gone: set[str]):
    before = names(filled)
    removed(filled, *words)
    assert before - names(filled) == gone


def test_all_leaves_what_is_not_ours_and_its_name_removes_it(filled: Path):
    (filled / "thesis.tex").write_text("x")
    removed(filled, "all")
    assert names(filled) == {"thesis.tex"}
    removed(filled, "thesis.tex")
    assert names(filled) == set()


@pytest.mark.parametrize("word", ["takes/tiny-01234", "", "..", "../outside", "/", "takes/../takes", "tak"])
def test_an_unknown_name_is_one_line_that_names_what_there_is(filled: Path, word: str):
    (filled.parent / "outside").mkdir()
    with pytest.raises(InputError, match=rf"found '{word}'; there is .*{TAKE}"):
        chosen(look(filled), [word])


def test_where_nothing_is_kept_a_name_is_unknown(cache: Path):
    with pytest.raises(InputError, match=r"nothing is kept$"):
        chosen(look(cache), ["takes/a"])


def test_what_is_being_written_stays_and_what_it_is_made_from(filled: Path):
    printed = f"printed/{OLD_TAKE[6:]}-stripes-1234"
    with alone(filled / printed, folder=False):
        done = removed(filled, "old")
    assert {entry.name for entry in done.removed} == {f"works/{OLD_TAKE[6:]}"}
    assert done.left[printed].startswith("being written")
    assert done.left[OLD_TAKE].startswith(f"{printed}, made from it, is being written")
    assert (filled / printed / "scan.ply").is_file()
    assert (filled / OLD_TAKE / "scan.ply").is_file()


@pytest.mark.parametrize("place", ["", "garment"])
def test_who_began_after_the_look_is_not_disturbed(filled: Path, place: str):
    work = filled / "works" / TAKE[6:]
    contents = look(filled)
    with alone(work / place, folder=bool(place)):
        done = remove(contents, chosen(contents, [f"works/{TAKE[6:]}"]))
    assert done.left == {f"works/{TAKE[6:]}": "being written"}
    assert (work / "garment" / "stage.json").is_file()


def test_links_go_and_what_lies_behind_them_stays(filled: Path, tmp_path: Path):
    away = tmp_path / "away"
    (filled / TAKE).rename(away)
    (filled / TAKE).symlink_to(away)
    (filled / "people" / "b.npz").symlink_to(away / "scan.ply")
    (filled / "works" / TAKE[6:] / "capture").symlink_to(away)
    removed(filled, "all")
    assert names(filled) == set()
    assert (away / "scan.ply").stat().st_size == 1000


def test_a_removal_that_was_cut_short_is_old_and_is_finished(filled: Path, monkeypatch: pytest.MonkeyPatch):
    def cut_short(path: Path) -> None:
        (path / "scan.ply").unlink()
        raise OSError(5, "Input/output error", str(path))

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", cut_short)
        done = removed(filled, TAKE)
    assert done.left == {TAKE: "Input/output error"}
    assert TAKE not in names(filled), "half a take is none"
    (rest,) = (entry for entry in look(filled).entries if entry.path.name.endswith(removal.INTERRUPTED))
    assert (rest.state, rest.why) == ("old", "its removal was interrupted")
    removed(filled, "old")
    assert not rest.path.exists()
