"""The stages in a row: what they read, and how often."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from capture4d import pipeline
from capture4d.captures.capture import read_capture
from capture4d.captures.work_folder import open_work
from capture4d.cli.main import COMMANDS
from capture4d.errors import InputError

COUNT = """
import json, os, sys
from collections import Counter

capture, work = map(os.path.realpath, sys.argv[1:])
seen = Counter()

def listen(event, arguments):
    if event in ("open", "os.listdir", "os.scandir") and isinstance(arguments[0], (str, os.PathLike)):
        seen[event, os.path.realpath(arguments[0])] += 1

from capture4d import pipeline
from capture4d.captures import capture as module
calls = Counter()
plain = module.read_capture
def counted(*arguments, **options):
    calls["read_capture"] += 1
    return plain(*arguments, **options)
for each in list(sys.modules.values()):
    if getattr(each, "read_capture", None) is plain:
        each.read_capture = counted
sys.addaudithook(listen)
pipeline.run(capture, work, workers=1)
print(json.dumps({
    "capture.json": seen["open", os.path.join(capture, "capture.json")],
    "scans": seen["os.listdir", os.path.join(capture, "scans")] + seen["os.scandir", os.path.join(capture, "scans")],
    "template": seen["open", os.path.join(capture, "template.npz")],
    "read_capture": calls["read_capture"],
}))
"""


def reads(capture: Path, work: Path) -> dict[str, int]:
    """What one `run` with one worker opens and lists."""
    done = subprocess.run(
        [sys.executable, "-c", COUNT, str(capture), str(work)], check=True, capture_output=True, text=True,
        cwd=Path(__file__).parents[3],
    )  # fmt: skip
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
def test_a_run_reads_what_it_is_given_once(tube_capture: Path, tmp_path: Path):
    once = {"capture.json": 1, "scans": 1, "template": 1, "read_capture": 1}
    assert reads(tube_capture, tmp_path / "work") == once, "from the start"
    assert reads(tube_capture, tmp_path / "work") == once, "with nothing left to do"


def test_stages_take_folders_open_or_by_path(tube_capture: Path, tmp_path: Path):
    by_path = pipeline.extract(str(tube_capture), str(tmp_path / "one"))
    opened = pipeline.extract(read_capture(tube_capture), open_work(tmp_path / "two"))
    assert by_path.digest == opened.digest
    assert (by_path.frames, by_path.failed, by_path.path) == (3, {}, tmp_path / "one" / "garment")
    registered = pipeline.register(tube_capture, tmp_path / "one")
    work = open_work(tmp_path / "one")
    assert work.registered_digest == registered.digest
    assert work.registered.frame_ids.tolist() == [5, 6, 7]
    assert not work.failed_frames
    assert not work.is_animated
    assert work.posed_body is None
    assert work.capture.path == tube_capture


def test_every_command_has_a_function():
    without = {
        "demo",
        "doctor",
        "cache",
        "convert-body",
        "convert-poses",
        "convert-rig",
    }  # files in, files out: no stages
    without |= {"view", "tryon"}  # pages, open until they are ended
    keywords = {"import": "import_meshes"}  # what Python keeps for itself
    wanted = {keywords.get(name, name.replace("-", "_").replace(" ", "_")) for name in COMMANDS if name not in without}
    assert wanted == set(pipeline.__all__)
    assert all(callable(getattr(pipeline, name)) for name in wanted)


def test_a_preset_that_is_not_there_is_one_line(tmp_path: Path):
    with pytest.raises(InputError, match=r"^config: expected one of demo, .*tshirt-train.*, found 'dem'$"):
        pipeline.synth(tmp_path, "dem")


def test_a_work_folder_that_was_opened_before_its_stages_ran_is_seen_as_it_is_now(tube_capture: Path, tmp_path: Path):
    early = open_work(tmp_path)
    pipeline.extract(tube_capture, early)
    pipeline.register(tube_capture, early)
    assert pipeline.report(early).path == tmp_path / "report" / "index.html"


def test_no_takes_are_one_line(tmp_path: Path):
    with pytest.raises(InputError, match="at least one work folder, found none"):
        pipeline.fit([], tmp_path)
