"""The lines of a Wavefront OBJ file as tables of numbers: at once where all is as usual, else line by line.

Both give the same. The first is fast; the second knows the line that is at fault.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from capture4d.errors import InputError, NotFiniteError
from capture4d.files.text_lines import (
    BLANKS,
    Numbers,
    TextLines,
    number,
    parsed,
    token_offsets,
    token_starts,
    without_indents,
)

__all__ = ["Tables", "at_once", "line_by_line"]

_MOST = 2**31 - 1
"""What our own indices can count."""
_SPACE, _SLASH = 32, 47
_COMMENT_BEHIND = re.compile(rb"^((?:vt|[vf])[ \t\v\f\\][^\n#]*)#[^\n]*", re.MULTILINE | re.IGNORECASE)
_BREAK = re.compile(rb"\\[ \t\v\f]*\n")
_CONTINUED = re.compile(
    rb"^(?:vt|[vf])(?=[ \t\v\f\\])[^\n\\]*(?:\\[ \t\v\f]*\n[^\n\\]*)+", re.MULTILINE | re.IGNORECASE
)
"""A line of numbers that goes on in the next. Names do not: one that ends in a backslash would swallow a vertex."""
_CONTINUED_COMMENT = re.compile(rb"(?:^[^\n#]+|\\[ \t\v\f]*\n[ \t\v\f]*)#[^\n]*\\[ \t\v\f]*$", re.MULTILINE)
_NUMERIC = (b"v", b"vt", b"f")


class Names:
    """The materials and the files of materials that a text names, and the material that holds now."""

    def __init__(self) -> None:
        self.materials: list[bytes] = []
        self.libraries: dict[bytes, None] = {}
        self.current = -1
        self._places: dict[bytes, int] = {}

    def take(self, line: bytes) -> int:
        """The material that holds after a line."""
        keyword, *rest = line.split(None, 1)
        name = rest[0].strip() if rest else b""
        if keyword.lower() == b"usemtl":
            self.current = self._places.setdefault(name, len(self.materials)) if name else -1
            self.materials += [name] if self.current == len(self.materials) else []
        elif keyword.lower() == b"mtllib" and name:
            self.libraries[name] = None
        return self.current


@dataclass(slots=True, eq=False)
class Tables:
    """What the lines of a file hold."""

    vertices: Numbers
    texture: Numbers
    sizes: np.ndarray
    corners: np.ndarray
    """Vertices of all faces, one after the other."""
    corner_texture: np.ndarray
    """Rows of `texture`, -1 where a corner has none."""
    material: np.ndarray
    """Of each face: which of the names' materials, -1 for none."""
    names: Names


# --- at once ---------------------------------------------------------------------------------------------------------


def at_once(text: bytes) -> Tables | None:
    """The tables of a plain text; None if anything in it is odd."""
    text = _without_comments(without_indents(text))
    if b"\\" in text:
        if _CONTINUED_COMMENT.search(text):
            return None
        text = _CONTINUED.sub(lambda found: _BREAK.sub(b" ", found[0]), text)
        text = _without_comments(text if text.endswith(b"\n") else text + b"\n")
    lines = TextLines(text)
    first, second, third = (lines.letters(place) for place in range(3))
    is_v = (first == ord("v")) & (second <= _SPACE)
    is_vt = (first == ord("v")) & (second == ord("t")) & (third <= _SPACE)
    rows = np.flatnonzero((first == ord("f")) & (second <= _SPACE))
    vertices = lines.numbers(np.flatnonzero(is_v), np.float64, keyword=1)
    texture = lines.numbers(np.flatnonzero(is_vt), np.float64, keyword=2)
    faces = _corners(*lines.text(rows, keyword=1))
    if vertices is None or texture is None or faces is None:
        return None
    sizes, corners, corner_texture, textured = faces
    if vertices.counts.min(initial=3) < 3 or texture.counts.min(initial=1) < 1 or sizes.min(initial=3) < 3:
        return None
    if not np.isfinite(vertices.columns(3)).all():
        return None
    found = _from_zero(corners, is_v, rows, sizes)
    if found is None:
        return None
    found_texture = np.full(len(corners), -1)
    if textured.any():
        stand_in = np.where(textured, corner_texture, 1)
        resolved = _from_zero(stand_in, is_vt, rows, sizes)
        if resolved is None:
            return None
        found_texture = np.where(textured, resolved, -1)
    names = Names()
    naming = np.flatnonzero((first == ord("u")) | (first == ord("m")))
    latest = [names.take(lines.bytes[lines.starts[row] : lines.ends[row]].tobytes()) for row in naming.tolist()]
    material = np.array([-1, *latest])[np.searchsorted(naming, rows)]
    return Tables(vertices, texture, sizes, found, found_texture, material, names)


def _without_comments(text: bytes) -> bytes:
    behind = text.count(b"#") > text.count(b"\n#") + text.startswith(b"#")
    return _COMMENT_BEHIND.sub(rb"\1", text) if behind else text


def _corners(text: np.ndarray, begins: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Of lines of corners v, v/vt, v//vn or v/vt/vn: sizes; of each corner v, vt, and whether there is a vt."""
    corner, slash = token_starts(text), np.flatnonzero(text == _SLASH)
    sizes = np.diff(token_offsets(corner, begins))
    spaced = text
    if len(slash):
        spaced = text.copy()
        spaced[slash] = _SPACE
    flat = parsed(spaced.tobytes(), np.int64)
    numbers = token_starts(spaced) if len(slash) else corner
    if flat is None or len(flat) != len(numbers) or (len(slash) and (text[corner] == _SLASH).any()):
        return None
    if not len(slash):
        return sizes, flat, flat, np.zeros(len(flat), bool)
    place = _before(numbers, corner)
    behind = np.append(_before(slash, corner), len(slash))
    after = text[np.minimum(slash + 1, len(text) - 1)]
    named = np.append((after > _SPACE) & (after != _SLASH), False)
    textured = (behind[1:] > behind[:-1]) & named[behind[:-1]]
    return sizes, flat[place], flat[np.minimum(place + 1, len(flat) - 1)], textured


def _before(marks: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """How many of the marks stand before each corner; quick where all corners have as many."""
    step = len(marks) // len(corner)
    if step * len(corner) == len(marks) and step:
        table = marks.reshape(len(corner), step)
        if (table[:, 0] >= corner).all() and (table[:-1, -1] < corner[1:]).all():
            return np.arange(0, len(marks), step)
    return np.searchsorted(marks, corner)


def _from_zero(indices: np.ndarray, entries: np.ndarray, rows: np.ndarray, sizes: np.ndarray) -> np.ndarray | None:
    """Indices that count from 0, of those from 1, or from -1 backwards; None if one means nothing.

    Args:
        entries: which lines are what is counted.
        rows: the lines of the faces, of so many corners.
    """
    found = indices - 1
    if len(indices) and indices.min() < 0:
        latest = np.repeat(np.cumsum(entries)[rows], sizes)
        found = np.where(indices < 0, latest + indices, found)
    count = int(np.count_nonzero(entries))
    return found if not len(found) or (found.min() >= 0 and found.max() < count) else None


# --- line by line ----------------------------------------------------------------------------------------------------


def line_by_line(text: bytes) -> Tables:
    """The same, slowly.

    Raises:
        InputError: names the line.
    """
    vertices: list[list[float]] = []
    texture: list[list[float]] = []
    corners: list[tuple[int, int]] = []
    faces: list[tuple[int, int, int]] = []
    names = Names()
    for number_of_line, line in _logical_lines(text):
        keyword, *words = line.split()
        try:
            match keyword.lower():
                case b"v":
                    vertices.append(_numbers(words, at_least=3))
                    if not np.isfinite(vertices[-1][:3]).all():
                        raise NotFiniteError(f"expected finite numbers, found '{_shown(words)}'")
                case b"vt":
                    texture.append(_numbers(words, at_least=1))
                case b"f":
                    if len(words) < 3:
                        raise InputError(f"expected a face of at least 3 corners, found {len(words)}")
                    faces.append((number_of_line, len(words), names.current))
                    corners += [_corner(word, len(vertices), len(texture)) for word in words]
                case _:
                    names.take(line)
        except InputError as error:
            raise type(error)(error.reason, line=number_of_line) from None
    lines, sizes, material = np.array(faces, np.int64).reshape(-1, 3).T
    vertex, corner_texture = np.array(corners, np.int64).reshape(-1, 2).T
    for name, indices, count in (
        ("vertex", vertex, len(vertices)),
        ("texture coordinate", corner_texture, len(texture)),
    ):
        beyond = np.flatnonzero(indices >= count)
        if len(beyond):
            line = int(lines[np.searchsorted(np.cumsum(sizes), beyond[0], side="right")])
            raise InputError(f"{name} {indices[beyond[0]] + 1} does not exist, the file has {count}", line=line)
    return Tables(_ragged(vertices), _ragged(texture), sizes, vertex, corner_texture, material, names)


def _logical_lines(text: bytes) -> Iterator[tuple[int, bytes]]:
    """Lines that are not blank, whole where they go on in the next, and the number of their first."""
    waiting: list[bytes] = []
    first = 0
    for number_of_line, line in enumerate(text.split(b"\n"), start=1):
        piece = line.strip(BLANKS)
        first = first if waiting else number_of_line
        words = (waiting[0] if waiting else piece).replace(b"\\", b" ").split(None, 1)
        if words and words[0].lower() in _NUMERIC:
            piece = piece.partition(b"#")[0].rstrip(BLANKS)
            if piece.endswith(b"\\"):
                waiting.append(piece[:-1] + b" ")
                continue
        whole = b"".join([*waiting, piece])
        waiting = []
        if whole.strip(BLANKS) and not whole.lstrip(BLANKS).startswith(b"#"):
            yield first, whole
    whole = b"".join(waiting)
    if whole.strip(BLANKS):
        yield first, whole


def _numbers(words: list[bytes], *, at_least: int) -> list[float]:
    try:
        numbers = [number(word) for word in words]
    except ValueError:
        raise InputError(f"expected numbers, found '{_shown(words)}'") from None
    if len(numbers) < at_least:
        raise InputError(f"expected at least {at_least} number{'s' * (at_least > 1)}, found {len(numbers)}")
    return numbers


def _corner(word: bytes, vertices: int, texture: int) -> tuple[int, int]:
    """Vertex and texture coordinate of a corner, from 0; -1 for no texture coordinate."""
    vertex, _, rest = word.partition(b"/")
    uv = rest.partition(b"/")[0]
    return _index(vertex, vertices), _index(uv, texture) if uv else -1


def _index(word: bytes, count: int) -> int:
    """OBJ counts from 1, or backwards from the latest entry with -1."""
    if not re.fullmatch(rb"[+-]?\d{1,4300}", word):
        raise InputError(f"expected an index, found '{_shown([word])}'")
    index = int(word)
    if abs(index) > _MOST:
        raise InputError(f"expected an index of at most {_MOST}, found '{_shown([word])}'")
    if index == 0 or index < -count:
        raise InputError(f"expected an index from 1, or from -1 down to -{count}, found {index}")
    return index - 1 if index > 0 else count + index


def _ragged(rows: list[list[float]]) -> Numbers:
    first = np.cumsum([0, *(len(row) for row in rows)])
    return Numbers(np.array([each for row in rows for each in row], np.float64), first)


def _shown(words: list[bytes]) -> str:
    return b" ".join(words).decode("utf-8", errors="replace")[:80]
