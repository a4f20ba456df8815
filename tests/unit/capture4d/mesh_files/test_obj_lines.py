"""The quick way through the lines of an obj gives what the slow one gives, or steps aside."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from capture4d.errors import InputError
from capture4d.files.text_lines import plain_text
from capture4d.mesh_files.obj_lines import Tables, at_once, line_by_line

GOOD = ["0", "1", ".5", "-1.5", "1e-3", "+2", "3.", "1.0003", "nan", "255"]
ODD = [
    "-nan",
    "1.#QNAN",
    "-1.#IND",
    "inf",
    "1e400",
    "x",
    "1_0",
    "0x10",
    "1,5",
    "1.5-2",
    "nan(ind)",
    "\u0663",
    "1e",
    "--1",
]
ODD += ["1.2.3", "1\0", "1\x1a"]
INDICES = ["1", "2", "3", "-1", "-2", "-3"]
ODD_INDICES = ["4", "0", "99", "+1", "1.0", "x", "9" * 30, "1_0", "1#", "-4", "2147483648"]
CORNERS = ["{}", "{}/{}", "{}//{}", "{}/{}/{}"]
ODD_CORNERS = ["{}/", "/{}", "{}//", "//{}", "{}/{}/{}/{}", "{}/x", "{}//x", "/"]
LINES = [
    "# a comment",
    "#",
    "vn 0 0 1",
    "usemtl a",
    "usemtl b c",
    "usemtl",
    "mtllib x.mtl",
    "mtllib a#b.mtl",
    "g",
    "o x",
]
LINES += ["s off", "l 1 2", "p 1", "", "   ", "# back \\", "V 1 2 3", "F 1 2 3", "VT 0 0", "v", "f", "vt", "usemtl a\\"]
LINES += ["\\", "#v 1 2 3", "vp 1"]
BLANKS = ["\t", "  ", " \t", "\f", "\v"]
BEHIND = [" # hi", "# hi", " # v 1 2 3", " # back \\", " \\", "\\", "  ", "\t"]


@st.composite
def rarely(draw: st.DrawFn, usual: list[str], odd: list[str], one_in: int = 40) -> str:
    return draw(st.sampled_from(odd if draw(st.integers(1, one_in)) == 1 else usual))


@st.composite
def drawn_line(draw: st.DrawFn, corner: str, columns: int) -> str:
    kind = draw(st.integers(0, 9))
    if kind < 3:
        count = columns if draw(st.integers(0, 9)) else draw(st.integers(0, 8))
        words = ["v", *(draw(rarely(GOOD, ODD)) for _ in range(count))]
    elif kind < 5:
        count = 2 if draw(st.integers(0, 5)) else draw(st.integers(0, 4))
        words = ["vt", *(draw(rarely(GOOD, ODD)) for _ in range(count))]
    elif kind < 8:
        count = 3 if draw(st.integers(0, 3)) else draw(st.integers(0, 6))
        shapes = [draw(rarely([corner], CORNERS + ODD_CORNERS, 20)) for _ in range(count)]
        words = ["f", *(shape.format(*(draw(rarely(INDICES, ODD_INDICES)) for _ in range(4))) for shape in shapes)]
    else:
        words = [draw(st.sampled_from(LINES))]
    line = draw(rarely([" "], BLANKS, 10)).join(words)
    if " " in line and draw(st.integers(0, 15)) == 0:
        place = line.index(" ")
        line = f"{line[:place]} \\{draw(st.sampled_from(['', ' ']))}\n{line[place:]}"
    return draw(rarely([""], BLANKS, 20)) + line + draw(rarely([""], BEHIND, 12))


@st.composite
def texts(draw: st.DrawFn) -> bytes:
    columns = draw(st.sampled_from([3, 3, 4, 5, 6, 7, 8]))
    corner = draw(st.sampled_from(CORNERS))
    start = ["v 1 2 3", "v 4 5 6" + " 0" * (columns - 3), "v 7 8 9", "vt 0 0", "vt 1 0.5", "vt 0 1"]
    lines = start + draw(st.lists(drawn_line(corner, columns), min_size=1, max_size=7))
    return draw(rarely(["\n"], ["\r\n", "\r"], 8)).join(lines).encode() + draw(st.sampled_from([b"", b"\n"]))


def arrays(tables: Tables) -> list[np.ndarray]:
    vertices, texture = tables.vertices, tables.texture
    return [vertices.flat, vertices.first, texture.flat, texture.first, tables.sizes, tables.corners,
            tables.corner_texture, tables.material]  # fmt: skip


@given(texts())
@settings(max_examples=300, deadline=None)
def test_quick_and_slow_are_the_same(data: bytes):
    text = plain_text(data)
    quick = at_once(text)
    if quick is None:
        return
    slow = line_by_line(text)  # which must not refuse it
    for ours, theirs in zip(arrays(quick), arrays(slow), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert (quick.names.materials, quick.names.libraries) == (slow.names.materials, slow.names.libraries)


@given(texts())
@settings(max_examples=100, deadline=None)
def test_the_slow_way_names_a_line_that_is_there(data: bytes):
    text = plain_text(data)
    line = 1
    try:
        line_by_line(text)
    except InputError as error:
        line = error.line or 0
    assert 1 <= line <= text.count(b"\n")


def test_usual_files_are_read_at_once():
    """Else the quick way could step aside from everything."""
    for corner in CORNERS:
        face = " ".join(corner.format(*index * 4) for index in INDICES[:3])
        lines = ["mtllib x", "v 1 2 3", "v 4 5 6 1 0 0", "\tv 7 8 9 # x", "vt 0 0", "vt nan 1 0", "vt 1 1", "usemtl a"]
        lines += [f"f {face}", f"f \\\n{face}", ""]
        assert at_once("\n".join(lines).encode()) is not None
