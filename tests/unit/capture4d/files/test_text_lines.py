"""Lines of numbers, against Python's own reading of them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from capture4d.errors import InputError
from capture4d.files.text_lines import TextLines, number, parsed, plain_text, spans

WORDS = (
    st.floats(width=64).map(repr) | st.integers(-(10**20), 10**20).map(str) | st.sampled_from([".5", "1.", "+2", "1e3"])
)


@given(st.lists(st.lists(WORDS, max_size=5), max_size=8), st.sampled_from([" ", "\t", "  ", " \v"]))
@settings(max_examples=200, deadline=None)
def test_numbers_of_lines_are_what_python_reads(rows: list[list[str]], blank: str):
    lines = TextLines(plain_text("".join(f"{blank.join(row)}\n" for row in rows).encode()))
    found = lines.numbers(np.arange(len(lines)), np.float64)
    assert found is not None
    assert found.counts.tolist() == [len(row) for row in rows or [[]]]
    np.testing.assert_array_equal(found.flat, [float(word) for row in rows for word in row])
    assert lines.filled.tolist() == [index for index, row in enumerate(rows) if row]


@given(st.text(alphabet="0123456789+-.eExnaif_()#, \t", max_size=12))
@settings(max_examples=500, deadline=None)
def test_one_number_is_read_as_many_are(text: str):
    """What the slow reading takes, the quick one takes for the same; the other way round, or they may differ."""
    words = text.split()
    try:
        slow = [number(word.encode()) for word in words]
    except ValueError:
        return
    quick = parsed(text.encode(), np.float64)
    assert quick is not None
    np.testing.assert_array_equal(quick, slow)


@pytest.mark.parametrize(
    "word", ["1_0", "0x10", "1,5", "", "1e", "--1", "\u0663", "1 2", "infinit", "nan1", "1" * 10_000 + "x"]
)
def test_what_is_no_number(word: str):
    with pytest.raises(ValueError, match=r".*"):
        number(word.encode())


def test_some_lines_among_others():
    lines = TextLines(b"a 1 2\nb\n a 3\na\nb 9\n")
    found = lines.numbers(np.array([0, 3]), np.int64, keyword=1)
    assert found is not None
    assert (found.flat.tolist(), found.first.tolist()) == ([1, 2], [0, 2, 2])
    assert lines.numbers(np.array([0, 1]), np.int64, keyword=0) is None
    nothing = lines.numbers(np.array([], np.int64), np.int64)
    assert nothing is not None
    assert (len(nothing.flat), nothing.columns(3).shape) == (0, (0, 3))


def test_a_short_line_or_an_odd_one_is_named():
    lines = TextLines(b"1 2\n3 4 5\nx 1\n", first=11)
    for rows, least, said in (
        ([0, 1], 3, "11: expected at least 3 numbers"),
        ([1, 2], 1, "13: expected numbers, found 'x"),
    ):
        with pytest.raises(InputError) as caught:
            lines.needed(np.array(rows), least)
        assert said.startswith(f"{caught.value.line}: ")
        assert said.partition(": ")[2] in str(caught.value)


@given(st.lists(st.tuples(st.integers(0, 50), st.integers(0, 4)), max_size=6))
def test_spans_are_the_places_of_lists(lists: list[tuple[int, int]]):
    starts, lengths = np.array(lists, np.int64).reshape(-1, 2).T
    assert spans(starts, lengths).tolist() == [start + step for start, length in lists for step in range(length)]
