"""Files that a command writes among files of the user's: never onto an input, and onto what is there only if told."""

from __future__ import annotations

import contextlib
import filecmp
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from capture4d.errors import InputError
from capture4d.files.atomic import TEMPORARY_SUFFIX

__all__ = ["new_files", "new_files_in", "require_apart", "require_free"]


def require_apart(outputs: Iterable[Path], inputs: Iterable[Path | None]) -> None:
    """See that nothing is written onto what is read, by whatever name: through links, hard ones too.

    Args:
        inputs: files; None for those that were not given.
    Raises:
        InputError: an output is an input; names both.
    """
    sources = [path for path in inputs if path is not None]
    for output in outputs:
        for source in sources:
            if _is_same(output, source):
                raise InputError(f"expected a file to write to, found the input {source}", where=output)


def require_free(place: Path, made: Path) -> None:
    """Raises InputError where something else is than the file that was made for the place."""
    if os.path.lexists(place) and not _hold_the_same(made, place):
        raise InputError("expected no file yet, or this very result; found another; use --overwrite", where=place)


@contextlib.contextmanager
def new_files(
    outputs: Sequence[Path], *, inputs: Iterable[Path | None] = (), overwrite: bool = False
) -> Iterator[Path]:
    """Write files of one folder, which are put in their places once all are written, and none if anything fails before.

    What is in a place already and holds the same bytes stays as it is, so that the same command may be given again.

    Args:
        inputs: what the files are made from, as for `require_apart`.
        overwrite: put them also over files that hold something else.
    Yields:
        A folder beside them to write to, under the same names.
    Raises:
        InputError: an output is an input or a folder; or it holds something else, and `overwrite` is off.
        OSError: nothing can be written there; names it.
    """
    (folder,) = {path.parent for path in outputs}
    require_apart(outputs, inputs)
    for path in outputs:
        if path.is_dir():
            raise InputError("expected a file to write to, found a folder", where=path)
    with _placed_in(folder, (), overwrite) as workshop:
        yield workshop


@contextlib.contextmanager
def new_files_in(folder: Path, *, inputs: Iterable[Path | None] = (), overwrite: bool = False) -> Iterator[Path]:
    """`new_files` of one folder whose names are known once they are written."""
    if folder.exists() and not folder.is_dir():
        raise InputError("expected a folder to write to, found a file", where=folder)
    with _placed_in(folder, tuple(inputs), overwrite) as workshop:
        yield workshop


@contextlib.contextmanager
def _placed_in(folder: Path, inputs: Sequence[Path | None], overwrite: bool) -> Iterator[Path]:
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _beside(folder) as workshop, _naming_the_place(workshop, folder):
            yield workshop
            _put_in_place(workshop, folder, inputs, overwrite)
    finally:
        for each in made:
            with contextlib.suppress(OSError):  # it holds something now
                each.rmdir()


def _put_in_place(workshop: Path, folder: Path, inputs: Sequence[Path | None], overwrite: bool) -> None:
    places = {path: folder / path.name for path in sorted(workshop.iterdir()) if path.is_file()}
    require_apart(places.values(), inputs)
    changed = {path: place for path, place in places.items() if not _hold_the_same(path, place)}
    if not overwrite:
        for path, place in changed.items():
            require_free(place, path)
    for path, place in changed.items():
        os.replace(path, place)


@contextlib.contextmanager
def _beside(folder: Path) -> Iterator[Path]:
    """A folder on the same disk, from which files move whole."""
    try:
        workshop = Path(tempfile.mkdtemp(prefix=".capture4d.", suffix=TEMPORARY_SUFFIX, dir=folder))
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(folder)) from None
    try:
        yield workshop
    finally:
        shutil.rmtree(workshop, ignore_errors=True)


@contextlib.contextmanager
def _naming_the_place(workshop: Path, folder: Path) -> Iterator[None]:
    """What is said of a file that is being made is said of the place it is made for."""

    def place(path: str | bytes | None) -> Path | None:
        found = None if path is None else Path(os.fsdecode(path))
        return folder / found.relative_to(workshop) if found is not None and found.is_relative_to(workshop) else None

    try:
        yield
    except InputError as error:
        meant = place(error.where)
        if meant is None:
            raise
        raise error.at(meant) from None
    except OSError as error:
        meant = place(error.filename)
        if meant is None:
            raise
        raise OSError(error.errno, error.strerror, str(meant)) from error


def _is_same(one: Path, other: Path) -> bool:
    """Whether two paths lead to one file, or would if it were there."""
    try:
        return os.path.samefile(one, other)
    except OSError:  # one of them is not there
        return os.path.normcase(one.resolve()) == os.path.normcase(other.resolve())


def _hold_the_same(one: Path, other: Path) -> bool:
    return other.is_file() and filecmp.cmp(one, other, shallow=False)
