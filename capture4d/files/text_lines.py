"""Text files of numbers, a record a line, parsed at the speed of C: in one go where all is well.

What is not a number makes these functions answer None: who called then goes line by line, to name the one at fault.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from capture4d.errors import InputError

__all__ = [
    "BLANKS",
    "Numbers",
    "TextLines",
    "number",
    "parsed",
    "plain_text",
    "spans",
    "token_offsets",
    "token_starts",
    "without_indents",
]

BLANKS = b" \t\v\f"
"""What stands between the words of a line."""
_NEWLINE, _SPACE = 10, 32
_INDENT = re.compile(rb"^[ \t\v\f]+", re.MULTILINE)
_NOT_NUMBERS = re.compile(rb"(?<![^\s])[+-]?1[.,]#(?:QNAN|SNAN|IND|INF)\w*", re.IGNORECASE)
"""How older Windows programs print what is no number."""
_NUMBER = re.compile(
    rb"[+-]?(?:(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?|nan(?:\([\w-]*\))?|inf(?:inity)?)", re.IGNORECASE
)


def plain_text(data: bytes) -> bytes:
    r"""Text without a byte order mark, every line of it ended by \n.

    Raises:
        InputError: it is UTF-16, or no text.
    """
    head = data[:256]
    nuls = sorted((head[::2].count(0), head[1::2].count(0)))
    if head[:2] in (b"\xff\xfe", b"\xfe\xff") or (nuls[1] > len(head) // 4 and nuls[0] <= len(head) // 16):
        raise InputError("expected UTF-8, found UTF-16 text")
    if nuls[1] > len(head) // 4:
        raise InputError("expected a text, found other bytes")
    data = data.removeprefix(b"\xef\xbb\xbf")
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b".#" in data or b",#" in data:
        data = _NOT_NUMBERS.sub(b"nan", data)
    return data if data.endswith(b"\n") else data + b"\n"


@dataclass(frozen=True, slots=True, eq=False)
class Numbers:
    """Numbers of some lines, one after the other."""

    flat: np.ndarray
    first: np.ndarray
    """(lines + 1,): the place in `flat` of each line's first one, and the end."""

    @property
    def counts(self) -> np.ndarray:
        return np.diff(self.first)

    def columns(self, count: int) -> np.ndarray:
        """(lines, count): the first ones of each line, which must have as many."""
        width = len(self.flat) // max(len(self.first) - 1, 1)
        if width and (self.counts == width).all():
            return self.flat.reshape(-1, width)[:, :count]
        return self.flat[self.first[:-1, None] + np.arange(count)]


class TextLines:
    """Where the lines of a plain text begin and end.

    Args:
        first: the number of its first line in the file.
    """

    def __init__(self, text: bytes, first: int = 1) -> None:
        self.first = first
        self.bytes = np.frombuffer(text, np.uint8)
        self.ends = np.flatnonzero(self.bytes == _NEWLINE)
        self.starts = np.concatenate([[0], self.ends[:-1] + 1]) if len(self.ends) else np.zeros(0, np.int64)

    def __len__(self) -> int:
        return len(self.starts)

    @cached_property
    def filled(self) -> np.ndarray:
        """The lines that are not blank."""
        tokens = token_starts(self.bytes)
        return np.flatnonzero(np.diff(np.searchsorted(tokens, np.append(self.starts, len(self.bytes)))))

    def letters(self, place: int) -> np.ndarray:
        """The letter at a place of each line, that of its end where it is shorter, small."""
        found = self.bytes[np.minimum(self.starts + place, self.ends)]
        return np.where((found >= 65) & (found <= 90), found + 32, found)

    def text(self, rows: np.ndarray, *, keyword: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """The bytes of some lines, ascending, their keywords of so many letters blank; and where each line begins."""
        if not len(rows):
            return np.zeros(0, np.uint8), np.zeros(0, np.int64)
        first, last = rows[0], rows[-1]
        begins = self.starts[rows]
        if last - first + 1 == len(rows):
            found = self.bytes[self.starts[first] : self.ends[last] + 1]
            found, begins = (found.copy() if keyword else found), begins - self.starts[first]
        else:
            chosen = np.zeros(len(self), bool)
            chosen[rows] = True
            found = self.bytes[: self.ends[-1] + 1][np.repeat(chosen, self.ends - self.starts + 1)]
            lengths = self.ends[rows] - begins + 1
            begins = np.cumsum(lengths) - lengths
        for letter in range(keyword):
            found[begins + letter] = _SPACE
        return found, begins

    def numbers(self, rows: np.ndarray, dtype: type, *, keyword: int = 0) -> Numbers | None:
        """All numbers of some lines, ascending; None if there is anything else."""
        text, begins = self.text(rows, keyword=keyword)
        flat = parsed(text.tobytes(), dtype)
        tokens = token_starts(text)
        if flat is None or len(flat) != len(tokens):
            return None
        return Numbers(flat, token_offsets(tokens, begins))

    def needed(self, rows: np.ndarray, at_least: int = 1, *, keyword: int = 0) -> Numbers:
        """All numbers of some lines, of which none may be short.

        Raises:
            InputError: names the line that is, or that holds anything else.
        """
        found = self.numbers(rows, np.float64, keyword=keyword)
        if found is not None and (found.counts >= at_least).all():
            return found
        for row in rows.tolist():
            words = self.line(row)[keyword:].split()
            try:
                count = len([number(word) for word in words])
            except ValueError:
                raise self.fault(row, f"expected numbers, found '{_shown(words)}'") from None
            if count < at_least:
                raise self.fault(row, f"expected at least {at_least} numbers, found {count}")
        raise self.fault(int(rows[0]), "expected numbers")

    def line(self, row: int) -> bytes:
        return self.bytes[self.starts[row] : self.ends[row]].tobytes()

    def fault(self, row: int, reason: str) -> InputError:
        """What is wrong in a line, with its number."""
        return InputError(reason, line=self.first + row)


def spans(starts: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """The places of all entries of lists that begin somewhere, one list after the other."""
    if len(lengths) and (lengths == lengths[0]).all():
        return (starts[:, None] + np.arange(lengths[0])).reshape(-1)
    return np.repeat(starts - (np.cumsum(lengths) - lengths), lengths) + np.arange(lengths.sum())


def _shown(words: list[bytes]) -> str:
    return b" ".join(words).decode("utf-8", errors="replace")[:80]


def without_indents(text: bytes) -> bytes:
    """A text whose lines begin with what is not blank."""
    indented = text[:1] in (b" ", b"\t", b"\v", b"\f") or any(b"\n%c" % blank in text for blank in BLANKS)
    return _INDENT.sub(b"", text) if indented else text


def parsed(text: bytes, dtype: type) -> np.ndarray | None:
    """The numbers of a text; None if there is anything else. Two that touch, as in 1.5-2, are two."""
    if not text or text.isspace():  # of which numpy makes -1
        return np.zeros(0, dtype)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return np.fromstring(text, dtype, sep=" ")
        except (DeprecationWarning, ValueError):
            return None


def token_starts(text: np.ndarray) -> np.ndarray:
    """Where the words of a text begin."""
    filled = text > _SPACE
    starts = np.flatnonzero(filled[1:] & ~filled[:-1]) + 1
    return np.concatenate([[0], starts]) if len(text) and filled[0] else starts


def token_offsets(tokens: np.ndarray, begins: np.ndarray) -> np.ndarray:
    """(lines + 1,): how many words stand before each line, and in all."""
    count = len(tokens) // max(len(begins), 1)
    if count and count * len(begins) == len(tokens):
        table = tokens.reshape(-1, count)
        if (table[:, 0] >= begins).all() and (table[:-1, -1] < begins[1:]).all():
            return np.arange(len(begins) + 1) * count
    return np.append(np.searchsorted(tokens, begins), len(tokens))


def number(word: bytes) -> float:
    """One number, as `parsed` would read it.

    Raises:
        ValueError: it is none.
    """
    if not _NUMBER.fullmatch(word):
        raise ValueError(word)
    return float("nan") if word.lower().lstrip(b"+-").startswith(b"nan") else float(word)
