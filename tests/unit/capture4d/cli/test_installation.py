"""`capture4d doctor` says what is there, what is missing, and what breaks as it is loaded."""

import json
import os
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, files, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from capture4d.cli import installation
from capture4d.cli.installation import Part, as_text, diagnose, load_apart, module_of
from tests.command_line import run as command


def run(*arguments: str) -> int:
    return command("doctor", *arguments)


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CAPTURE4D_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def needs(monkeypatch: pytest.MonkeyPatch):
    """Say what capture4d needs."""

    def say(*entries: str) -> None:
        monkeypatch.setattr(installation, "requires", lambda _: list(entries))

    return say


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Write a module that processes of ours find."""
    folder = tmp_path / "modules"
    folder.mkdir()
    monkeypatch.setenv("PYTHONPATH", str(folder))

    def write(name: str, source: str) -> None:
        (folder / f"{name}.py").write_text(source)

    return write


def test_a_sound_installation_is_exit_0_and_names_its_parts(needs, capsys: pytest.CaptureFixture[str]):
    needs("numpy>=2", "pillow>=1", "pytest; extra == 'dev'", "nothing-here; sys_platform == 'amiga'")
    assert run() == 0
    said = capsys.readouterr()
    assert "numpy" in said.out
    assert "pillow" in said.out
    assert "nothing-here" not in said.out  # for another system
    assert "\n  pytest" not in said.out  # for development
    assert said.err == ""


NEEDED = [need for need in map(Requirement, requires("capture4d") or []) if "extra" not in str(need.marker)]


@pytest.mark.parametrize("need", NEEDED, ids=lambda need: need.name)
def test_every_part_is_imported_by_the_name_that_its_files_have(need: Requirement):
    if need.marker is None or need.marker.evaluate():
        modules = {path.parts[0].split(".")[0] for path in files(need.name) or []}
        assert module_of(need.name) in modules


@pytest.mark.slow
def test_anny_is_loaded_by_a_user_without_a_home(tmp_path: Path):
    script = """
import os, pwd
os.environ.pop("HOME", None)
def nobody(number): raise KeyError(number)
pwd.getpwuid = nobody
from capture4d.heavy_imports import import_anny
print(import_anny().__name__, os.environ.get("HOME"))
"""
    environment = {**os.environ, "CAPTURE4D_CACHE": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == "anny None\n"


def test_a_missing_part_is_exit_3_and_one_line(needs, capsys: pytest.CaptureFixture[str]):
    needs("numpy>=2", "no-such-distribution>=1")
    assert run("--no-load") == 3
    assert capsys.readouterr().err == "capture4d: no-such-distribution: missing\n"


def test_another_version_than_wanted_is_said_and_does_not_fail(needs, capsys: pytest.CaptureFixture[str]):
    needs("numpy<1")
    assert run("--no-load") == 0
    assert "other version (wanted <1)" in capsys.readouterr().out


def test_an_optional_part_may_be_missing(needs, monkeypatch: pytest.MonkeyPatch):
    needs()
    monkeypatch.setattr(installation, "OPTIONAL", {"no-such-distribution": "dreams"})
    diagnosis = diagnose(load=False)
    assert diagnosis.parts == (Part("no-such-distribution", False, "missing", None, "dreams"),)
    assert diagnosis.faults == []


def test_what_is_not_installed_says_so(monkeypatch: pytest.MonkeyPatch):
    def none(_: str) -> None:
        raise PackageNotFoundError

    monkeypatch.setattr(installation, "requires", none)
    assert "not installed" in diagnose(load=False).faults[0]


def test_a_part_that_kills_its_process_is_named_and_the_rest_is_loaded(module):
    module("crashes", "import os; os._exit(11)")
    module("raises", "raise OSError('libGL.so: no such file,\\n really')")
    module("sound", "print('hello')")
    faults, _ = load_apart(["raises", "crashes", "sound"])
    assert faults == {
        "raises": "OSError: libGL.so: no such file, really",
        "crashes": "its process ended with 11 while it was loaded",
        "sound": "",
    }


def test_files_of_the_current_folder_are_not_taken_for_parts(module, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    module("sound", "")
    (tmp_path / "sound.py").write_text("raise ImportError('the wrong one')")
    monkeypatch.chdir(tmp_path)
    assert load_apart(["sound"])[0] == {"sound": ""}


def test_a_cache_folder_that_cannot_be_written_is_exit_3(needs, own_cache: Path, capsys: pytest.CaptureFixture[str]):
    needs()
    own_cache.write_text("a file")
    assert run("--no-load") == 3
    assert f"cache folder {own_cache}: " in capsys.readouterr().err


def test_the_size_of_the_cache_is_that_of_its_files(needs, own_cache: Path):
    needs()
    (own_cache / "deep").mkdir(parents=True)
    (own_cache / "deep" / "body.npz").write_bytes(bytes(3_000_000))
    diagnosis = diagnose(load=False)
    assert diagnosis.cache.mb == 3.0
    assert f"{own_cache}: 3 MB" in as_text(diagnosis)
    assert "capture4d cache names what it keeps" in as_text(diagnosis)


def test_json_says_the_same(needs, capsys: pytest.CaptureFixture[str]):
    needs("numpy>=2")
    assert run("--no-load", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["faults"] == []
    assert {part["name"] for part in told["parts"]} == {"numpy", *installation.OPTIONAL}
    assert told["machine"]["cores"] == len(os.sched_getaffinity(0))
