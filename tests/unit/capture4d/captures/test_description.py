"""capture.json: what is wrong in it is one line, the same from `read_capture` and from the check."""

import json
from pathlib import Path

import pytest

from capture4d.captures.capture import read_capture
from capture4d.captures.description import parse_description
from capture4d.captures.names import require_plain_names
from capture4d.errors import InputError
from capture4d.preflight.take_folder import Claims, open_take

GOOD = {"format": 1, "name": "take", "fps": 60, "garment_colour": "#2f62c9", "boundary_colours": {"hem": "ffd200"}}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "scans").mkdir()
    for number in (1, 2, 3):
        (tmp_path / "scans" / f"{number}.ply").write_bytes(b"x")
    return tmp_path


WRONG = [
    ('{"format": true}', "format 1, found True"),
    ('{"format": "1"}', "format 1, found '1'"),
    ('{"fps": true}', "fps: expected a number, found True"),
    ('{"fps": "60"}', "fps: expected a number, found '60'"),
    ('{"fps": [60]}', "fps: expected a number"),
    ('{"fps": NaN}', "expected finite numbers, found NaN"),
    ('{"fps": Infinity}', "expected finite numbers, found Infinity"),
    ('{"fps": -Infinity}', "expected finite numbers, found -Infinity"),
    ('{"fps": 0}', "fps: expected a positive frame rate"),
    ('{"fps": 60, "fps": 30}', "expected every name once, found 'fps' again"),
    ('{"fps": 1e300}', "fps: expected a frame rate from 0.01 to 100000"),
    ('{"fps": 1e-9}', "fps: expected a frame rate from"),
    ('{"fps": %s}' % ("9" * 400), "fps: expected a frame rate from"),
    ('{"fps": %s}' % ("9" * 9000), "not valid JSON"),
    ('{"frames": []}', "frames: expected ascending frame numbers, each once, found none"),
    ('{"frames": [1, 1, 2]}', "frames: expected ascending frame numbers"),
    ('{"frames": [2, 1]}', "frames: expected ascending frame numbers"),
    ('{"frames": [-1, 1]}', "frames: expected whole numbers from 0 to 2147483647, found -1"),
    ('{"frames": [true, 2]}', "frames: expected whole numbers from 0 to 2147483647, found True"),
    ('{"frames": ["1", 2]}', "found '1'"),
    ('{"frames": [1.5]}', "found 1.5"),
    ('{"frames": [1, Infinity]}', "found Infinity"),
    ('{"frames": [NaN]}', "found NaN"),
    ('{"frames": [1, null]}', "found None"),
    ('{"frames": [2147483648]}', "found 2147483648"),
    ('{"frames": [%s]}' % ("9" * 300), "a number of more than 40 digits"),
    ('{"frames": 3}', "frames: expected a list of frame numbers, found 3"),
    ('{"frames": "123"}', "frames: expected a list of frame numbers, found '123'"),
    ('{"frames": {"1": 2}}', "frames: expected a list"),
    ('{"dropped_frames": [false]}', "dropped_frames: expected whole numbers"),
    ('{"dropped_frames": 5}', "dropped_frames: expected a list"),
    ('{"units": 1}', "expected units m, cm, mm, in, found 1"),
    ('{"units": ["m"]}', "expected units"),
    ('{"units": "M"}', "expected units"),
    ('{"garment_colour": 255}', "garment_colour: expected a colour such as #2f62c9, found 255"),
    ('{"garment_colour": "#2f62c9\\n"}', "garment_colour: expected a colour"),
    ('{"boundary_colours": []}', "boundary_colours: expected an object"),
    ('{"boundary_colours": {"hem": 7}}', "boundary_colours, hem: expected a colour"),
    ('{"boundary_colours": {"hem": ["ffd200"]}}', "boundary_colours, hem: expected a colour"),
    ('{"name": 7}', "name: expected text, found 7"),
    ('{"name": ""}', "name: expected 1 to 100 characters, found 0"),
    ('{"name": "%s"}' % ("x" * 5000), "found 5000"),
    ('{"name": "a\\u001b[31mb"}', "name: expected text without control characters"),
    ('{"name": "a\\nb"}', "name: expected text without control characters"),
    ('{"name": "\\ud800"}', "name: expected text without control characters"),
    ("[1]", "expected a JSON object, found list"),
    ("", "not valid JSON"),
    ('{"fps": 60', "not valid JSON"),
    ('{"a": %s}' % ("[" * 100_000), "not valid JSON"),
    ("\ufeffnull", "expected a JSON object"),
]  # fmt: skip
LEADING = ("../x", "a/b", "/etc/x", "C:\\x", "a\\b", "x\0y", "nul", "CON", "com1.txt", "a:b", "..", ".", ".hidden",
           "x.", " x", "x ", "", "a\nb", "a\x1bb", "?", "*", "\u2028", "x" * 300)  # fmt: skip


@pytest.mark.parametrize(("text", "said"), WRONG)
def test_what_is_wrong_is_one_line(text: str, said: str, folder: Path):
    if text.startswith("{") and text.endswith("}"):
        changed = text[1:].partition(":")[0].strip('" ')
        rest = {name: value for name, value in GOOD.items() if name != changed}
        text = json.dumps(rest)[:-1] + ", " + text[1:]
    (folder / "capture.json").write_text(text, encoding="utf-8")
    for opened in (read_capture, open_take):
        with pytest.raises(InputError) as caught:
            opened(folder)
        assert str(caught.value).startswith(f"{folder / 'capture.json'}: ")
        assert said in str(caught.value)
        assert "\n" not in str(caught.value)
        assert len(caught.value.reason) < 600


@pytest.mark.parametrize("name", LEADING)
def test_a_name_that_leads_elsewhere_is_refused(name: str):
    with pytest.raises(InputError, match="name of a border: expected"):
        parse_description({**GOOD, "boundary_colours": {name: "ffd200"}})


@pytest.mark.parametrize(
    "name", ["hem", "cuff_left", "Saum links", "裾", "тело", "hem.2", "hem-2", "console", "o'neil & co"]
)
def test_other_names_are_names(name: str):
    require_plain_names([name], "border")
    assert parse_description({**GOOD, "boundary_colours": {name: "ffd200"}}).boundary_colours == {name: (255, 210, 0)}


@pytest.mark.parametrize(
    ("more", "frames"),
    [
        ({}, (1, 2, 3)),
        ({"frames": None, "garment_colour": None, "boundary_colours": None, "dropped_frames": None}, (1, 2, 3)),
        ({"frames": [1.0, 3.0]}, (1, 3)),
        ({"camera": {"iso": [1, {}]}, "_comment": "x" * 10_000, "fps": 59.94}, (1, 2, 3)),
        ({"name": None}, (1, 2, 3)),
        ({"name": "../../etc <b>"}, (1, 2, 3)),
    ],
)
def test_what_is_not_known_or_null_is_left_alone(more: dict, frames: tuple[int, ...], folder: Path):
    (folder / "capture.json").write_text(json.dumps({**GOOD, **more}))
    assert read_capture(folder).frame_ids == frames
    assert open_take(folder).facts.fps == more.get("fps", 60)


def test_what_the_command_line_says_stands_over_what_is_wrong(folder: Path):
    (folder / "capture.json").write_text(json.dumps({**GOOD, "fps": "fast", "units": "ells"}))
    facts = open_take(folder, Claims(fps=30.0, units="mm")).facts
    assert (facts.fps, facts.declared) == (30.0, 0.001)
