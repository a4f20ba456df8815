"""The records of a PLY file, element by element, as columns."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import numpy as np

from capture4d.errors import InputError
from capture4d.files.text_lines import Numbers, TextLines, parsed, plain_text, spans

__all__ = ["COLOURS", "Element", "Lists", "read_binary", "read_text"]

COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
"""What the channels of a colour are called."""
_LETTERS = {"i1": "b", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "i8": "q", "u8": "Q"}
_CHANNELS = {channel for channels in COLOURS for channel in channels}


@dataclass(frozen=True, slots=True, eq=False)
class Lists:
    """A list of every record, one after the other."""

    sizes: np.ndarray
    flat: np.ndarray


@dataclass(slots=True, eq=False)
class Element:
    """One kind of record in a PLY file, and its columns once they are read."""

    name: str
    count: int
    properties: list[tuple[str, str, str]] = field(default_factory=list)
    """Name, type, and for a list the type of its length, else ''."""
    values: dict[str, np.ndarray] = field(default_factory=dict)
    lists: dict[str, Lists] = field(default_factory=dict)
    _names: set[str] = field(default_factory=set)

    def add(self, name: str, kind: str, length: str) -> None:
        if name in self._names or length.startswith("f"):
            raise ValueError(name)
        self._names.add(name)
        self.properties.append((name, kind, length))

    def keep(self, name: str, flat: np.ndarray, sizes: np.ndarray | None) -> None:
        if sizes is None:
            self.values[name.lower()] = flat
        else:
            self.lists[name.lower()] = Lists(sizes, flat)

    def cut_off(self, found: int) -> InputError:
        return InputError(f"cut off, expected {self.count} records of '{self.name}', found {found}")


# --- binary ----------------------------------------------------------------------------------------------------------


def read_binary(elements: list[Element], body: memoryview, order: str) -> None:
    """Fill elements with what stands in bytes.

    Args:
        order: of the bytes in a number, '<' or '>'.
    """
    offset = 0
    for element in elements:
        if not element.properties:  # whatever their number, nothing is there
            continue
        offset = _equal_records(element, body, offset, order) or _mixed_records(element, body, offset, order)


def _equal_records(element: Element, body: memoryview, offset: int, order: str) -> int | None:
    """Read all records at once if each has lists as long as the first one's; the offset behind them, or None."""
    fields: list[tuple] = []
    size = offset
    for index, (_, kind, length) in enumerate(element.properties):
        entries = 0
        if length:
            step = np.dtype(length).itemsize
            if size + step > len(body):
                return None
            entries = int(np.frombuffer(body, order + length, 1, size)[0])
            if entries < 0 or entries > len(body):
                return None
            fields.append((f"length {index}", order + length))
            size += step
        width = np.dtype(kind).itemsize * (entries if length else 1)
        # A list is copied as bytes: numbers that lie askew are slow to copy one by one.
        fields.append(
            (f"{index}", f"V{width}") if width and length else (f"{index}", order + kind, (entries,) * bool(length))
        )
        size += width
    record = np.dtype(fields)
    end = offset + record.itemsize * element.count
    if end > len(body) or not element.count:
        return None
    records = np.frombuffer(body, record, element.count, offset)
    lengths = [records[f"length {index}"] for index, (_, _, length) in enumerate(element.properties) if length]
    if any((length != length[0]).any() for length in lengths):
        return None
    for index, (name, kind, length) in enumerate(element.properties):
        column = records[f"{index}"]
        if not length:
            element.keep(name, column, None)
            continue
        flat = np.ascontiguousarray(column).view(order + kind) if column.dtype.kind == "V" else column.reshape(-1)
        sizes = np.broadcast_to(np.int64(len(flat) // element.count), element.count)
        element.keep(name, flat.astype(kind, copy=False), sizes)
    return end


def _mixed_records(element: Element, body: memoryview, offset: int, order: str) -> int:
    """Read records of lists of any lengths: find where they begin, then take them at once."""
    begins, starts, sizes, end = _walked(element, body, offset, order)
    place, which = begins, 0
    for name, kind, length in element.properties:
        width = np.dtype(kind).itemsize
        if length:
            place = starts[which]
            element.keep(name, _taken(body, place, sizes[which], order + kind), sizes[which])
            place, which = place + width * sizes[which], which + 1
        else:
            element.keep(name, _taken(body, place, np.ones(len(place), np.int64), order + kind), None)
            place = place + width
    return end


def _walked(
    element: Element, body: memoryview, offset: int, order: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Where records begin, (records,); where their lists begin and how long they are, (lists, records); the end."""
    plan, skipped = [], 0
    for _, kind, length in element.properties:
        if length:
            unpack = None if length == "u1" else struct.Struct(order + _LETTERS[length]).unpack_from
            plan.append((skipped, unpack, np.dtype(length).itemsize, np.dtype(kind).itemsize))
            skipped = 0
        else:
            skipped += np.dtype(kind).itemsize
    least = skipped + sum(before + width for before, _, width, _ in plan)
    if least * element.count > len(body) - offset:
        raise InputError(
            f"cut off, expected {element.count} records of '{element.name}', found {len(body) - offset} bytes"
        )
    begins: list[int] = []
    starts: list[int] = []
    sizes: list[int] = []
    for record in range(element.count):
        begins.append(offset)
        try:
            for before, unpack, width, entry in plan:
                offset += before
                size = body[offset] if unpack is None else unpack(body, offset)[0]
                if size < 0:
                    raise IndexError
                offset += width
                starts.append(offset)
                sizes.append(size)
                offset += size * entry
        except (IndexError, struct.error):
            raise element.cut_off(record) from None
        offset += skipped
        if offset > len(body):
            raise element.cut_off(record)
    shape = (element.count, len(plan))
    return (
        np.array(begins, np.int64),
        np.array(starts, np.int64).reshape(shape).T,
        np.array(sizes, np.int64).reshape(shape).T,
        offset,
    )


def _taken(body: memoryview, starts: np.ndarray, sizes: np.ndarray, kind: str) -> np.ndarray:
    """Lists of numbers that begin at any bytes."""
    dtype = np.dtype(kind)
    if not sizes.sum():
        return np.zeros(0, kind[1:])
    anywhere = np.ndarray((len(body) - dtype.itemsize + 1,), dtype, body, strides=(1,))
    entry = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return anywhere[np.repeat(starts, sizes) + dtype.itemsize * entry].astype(kind[1:])


# --- text ------------------------------------------------------------------------------------------------------------


def read_text(elements: list[Element], body: bytes, first_line: int) -> None:
    """Fill elements with what stands in text: a record a line, whatever follows in the line.

    A text that is broken otherwise is read if its numbers are exactly as many as its header wants.

    Raises:
        InputError: names the line.
    """
    lines = TextLines(plain_text(body), first_line)
    try:
        _by_lines(elements, lines)
    except InputError:
        numbers = parsed(lines.bytes.tobytes(), np.float64)
        if numbers is None or not _as_stream(elements, numbers):
            raise


def _by_lines(elements: list[Element], lines: TextLines) -> None:
    rows, done = lines.filled, 0
    for element in elements:
        if not element.properties:
            continue
        own = rows[done : done + element.count]
        done += element.count
        whole = all(kind[0] != "f" for _, kind, _ in element.properties)
        numbers = lines.numbers(own, np.int64) if whole else None
        _columns(element, numbers or lines.needed(own), lines, own)
        if len(own) < element.count:
            raise element.cut_off(len(own))


def _columns(element: Element, numbers: Numbers, lines: TextLines, rows: np.ndarray) -> None:
    cursor, ends = numbers.first[:-1], numbers.first[1:]
    for name, kind, length in element.properties:
        short = cursor >= ends
        sizes = np.ones(len(rows), np.int64)
        if length and not short.any():
            found = numbers.flat[cursor]
            short = ~((found >= 0) & (found == np.rint(found)) & (found <= ends - cursor - 1))
            sizes = np.where(short, 0, found).astype(np.int64)
            cursor = cursor + 1
        if short.any():
            row = int(np.flatnonzero(short)[0])
            count = int(numbers.counts[row])
            raise lines.fault(int(rows[row]), f"expected more numbers, for {name}, found {count} in the line")
        flat = numbers.flat[spans(cursor, sizes)] if length else numbers.flat[cursor]
        typed, wrong = _typed(flat, kind, name)
        if wrong is not None:
            row = int(np.searchsorted(np.cumsum(sizes), wrong, side="right"))
            raise lines.fault(int(rows[row]), _beyond(name, kind, flat[wrong]))
        element.keep(name, typed, sizes if length else None)
        cursor = cursor + sizes


def _as_stream(elements: list[Element], numbers: np.ndarray) -> bool:
    """Read numbers whatever lines they stand in; whether they are exactly as many as there have to be."""
    offset = 0
    for element in elements:
        found = _streamed(element, numbers, offset)
        if found is None:
            return False
        columns, offset = found
        for column, (name, kind, length) in zip(columns, element.properties, strict=True):
            flat = np.concatenate([*column, np.zeros(0)])
            typed, wrong = _typed(flat, kind, name)
            if wrong is not None:
                return False
            element.keep(name, typed, np.array([len(each) for each in column], np.int64) if length else None)
    return offset == len(numbers)


def _streamed(element: Element, numbers: np.ndarray, offset: int) -> tuple[list[list[np.ndarray]], int] | None:
    """The columns of an element, in pieces, and the place behind it; None if there are too few numbers."""
    width = len(element.properties)
    if not any(length for _, _, length in element.properties):
        table = numbers[offset : offset + width * element.count]
        whole = len(table) == width * element.count
        return (
            ([[column] for column in table.reshape(-1, max(width, 1)).T[:width]], offset + len(table))
            if whole
            else None
        )
    columns: list[list[np.ndarray]] = [[] for _ in element.properties]
    for _ in range(element.count):
        for column, (_, _, length) in zip(columns, element.properties, strict=True):
            entries = 1
            if length and offset < len(numbers):
                entries = _entries(numbers[offset], len(numbers))
                offset += 1
            column.append(numbers[offset : offset + entries])
            offset += entries
            if offset > len(numbers):
                return None
    return columns, offset


def _entries(number: float, most: int) -> int:
    """The length of a list; what none can be is the most there could be, and too many."""
    return int(number) if 0 <= number <= most and number == int(number) else most


def _typed(numbers: np.ndarray, kind: str, name: str) -> tuple[np.ndarray, int | None]:
    """Numbers of a text file as the type that its header gives them, and which is the first that has another."""
    if kind.startswith("f"):
        return numbers.astype(kind), None
    least, most = _range(kind, name)
    if numbers.size and not (numbers.min() >= least and numbers.max() <= most and _whole(numbers)):
        wrong = ~((numbers >= least) & (numbers <= most) & (numbers == np.rint(numbers)))
        return numbers, int(np.flatnonzero(wrong)[0])
    return numbers.astype(np.int64).astype(kind), None


def _whole(numbers: np.ndarray) -> bool:
    return numbers.dtype.kind == "i" or bool((numbers == np.rint(numbers)).all())


def _range(kind: str, name: str) -> tuple[int, int]:
    """Colours of signed bytes may be written as they are meant."""
    return np.iinfo(kind).min, 255 if kind == "i1" and name.lower() in _CHANNELS else np.iinfo(kind).max


def _beyond(name: str, kind: str, found: float) -> str:
    least, most = _range(kind, name)
    return f"expected {name} from {least} to {most}, found {found:g}"
