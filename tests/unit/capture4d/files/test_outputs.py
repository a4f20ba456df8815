import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from capture4d.errors import InputError
from capture4d.files.outputs import new_files, new_files_in, require_apart


def write(place: Path, data: bytes, **options) -> None:
    with new_files([place], **options) as workshop:
        (workshop / place.name).write_bytes(data)


def spellings(path: Path) -> Iterator[Path]:
    """Other names of a file."""
    yield path
    yield path.parent / "." / path.name
    yield path.parent / ".." / path.parent.name / path.name
    yield Path(os.path.relpath(path))
    link, hard, folder = path.with_name("link"), path.with_name("hard"), path.parent.with_name("folder")
    link.symlink_to(path)
    yield link
    os.link(path, hard)
    yield hard
    folder.symlink_to(path.parent)
    yield folder / path.name


def test_an_input_is_known_by_every_name_and_never_written_to(tmp_path: Path):
    source = tmp_path / "inputs" / "mesh.ply"
    source.parent.mkdir()
    source.write_bytes(b"the input")
    for output in spellings(source):
        with pytest.raises(InputError, match="expected a file to write to, found the input"):
            write(output, b"another", inputs=[None, source], overwrite=True)
        assert source.read_bytes() == b"the input"
    write(tmp_path / "inputs" / "other.ply", b"another", inputs=[source])


def test_a_file_that_is_not_there_yet_is_known_too(tmp_path: Path):
    """Both may be wrong: then it is said that they are one, not that one is missing."""
    with pytest.raises(InputError, match=r"b\.ply: expected a file to write to, found the input"):
        require_apart([tmp_path / "a" / ".." / "b.ply"], [tmp_path / "b.ply"])


def test_the_same_result_is_written_again_and_another_needs_a_word(tmp_path: Path):
    place = tmp_path / "new" / "folder" / "out.bin"
    write(place, b"one")
    time_ns = place.stat().st_mtime_ns
    write(place, b"one")
    assert place.stat().st_mtime_ns == time_ns, "what is the same stays"
    with pytest.raises(InputError, match=r"out\.bin: expected no file yet, or this very result; found another"):
        write(place, b"two")
    assert place.read_bytes() == b"one"
    write(place, b"two", overwrite=True)
    assert place.read_bytes() == b"two"
    assert list(place.parent.iterdir()) == [place], "nothing is left beside it"


def test_of_two_files_none_is_written_if_one_may_not_be(tmp_path: Path):
    (tmp_path / "b").write_bytes(b"of the user")

    def both() -> None:
        with new_files([tmp_path / "a", tmp_path / "b"]) as made:
            (made / "a").write_bytes(b"1")
            (made / "b").write_bytes(b"2")

    with pytest.raises(InputError, match="b: expected no file yet"):
        both()
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"b": b"of the user"}


def test_a_fault_leaves_nothing_and_names_the_place(tmp_path: Path):
    place = tmp_path / "new" / "out.bin"
    with pytest.raises(InputError) as fault, new_files([place]) as workshop:
        raise InputError("expected better", where=workshop / place.name)
    assert str(fault.value) == f"{place}: expected better"
    with pytest.raises(OSError, match="No such file") as answer, new_files([place]) as workshop:
        (workshop / "deeper" / "x").write_bytes(b"")
    assert answer.value.filename == str(place.parent / "deeper" / "x")
    assert not place.parent.exists()


def test_a_dangling_link_is_something_else(tmp_path: Path):
    place = tmp_path / "out.bin"
    place.symlink_to(tmp_path / "nowhere")
    with pytest.raises(InputError, match="expected no file yet"):
        write(place, b"1")
    write(place, b"1", overwrite=True)
    assert not place.is_symlink()


def test_a_folder_where_a_file_should_go(tmp_path: Path):
    with pytest.raises(InputError, match="expected a file to write to, found a folder"):
        write(tmp_path, b"", overwrite=True)
    (tmp_path / "file").touch()
    with (
        pytest.raises(InputError, match="expected a folder to write to, found a file"),
        new_files_in(tmp_path / "file", overwrite=True),
    ):
        pass


def test_files_whose_names_come_late_are_guarded_alike(tmp_path: Path):
    source = tmp_path / "model" / "cameras.bin"
    source.parent.mkdir()
    source.write_bytes(b"the input")

    def model(**options) -> None:
        with new_files_in(source.parent, **options) as workshop:
            (workshop / "cameras.bin").write_bytes(b"new")
            (workshop / "images.bin").write_bytes(b"new")

    with pytest.raises(InputError, match="found the input"):
        model(inputs=[source], overwrite=True)
    with pytest.raises(InputError, match="use --overwrite"):
        model()
    assert [path.name for path in source.parent.iterdir()] == ["cameras.bin"]
    model(overwrite=True)
    assert {path.name: path.read_bytes() for path in source.parent.iterdir()} == {
        "cameras.bin": b"new", "images.bin": b"new",
    }  # fmt: skip
