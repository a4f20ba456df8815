"""A folder with a user's own `registration.py` in it: ours are found, and theirs is theirs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from capture4d.cli.main import COMMANDS
from capture4d.own_packages import OWN

ROOT = Path(__file__).parents[3]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in OWN:
        (tmp_path / f"{name}.py").write_text(f"WHOSE = 'the user, {name}'\n")
    return tmp_path


def python(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


def test_every_command_answers_beside_files_of_those_names(folder: Path):
    script = (
        "import sys\n"
        "from capture4d.cli.main import COMMANDS, main\n"
        "for name in COMMANDS:\n"
        "    try: main([*name.split(), '--help'])\n"
        "    except SystemExit as end: assert not end.code, name\n"
        "    print('answered', name)\n"
    )
    (folder / "every.py").write_text(script)
    done = python(folder, "every.py")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("answered ") == len(COMMANDS)
    assert python(folder, "-m", "capture4d", "register", "--help").returncode == 0


def test_a_script_beside_them_registers_in_several_processes(folder: Path, tube_capture: Path):
    (folder / "night.py").write_text(
        "from capture4d import pipeline\n"
        "if __name__ == '__main__':\n"
        f"    pipeline.extract({str(tube_capture)!r}, 'work', workers=2)\n"
        f"    print(pipeline.register({str(tube_capture)!r}, 'work', workers=2).frames)\n"
    )
    done = python(folder, "night.py")
    assert done.stdout.strip() == "3", done.stderr


def test_what_was_loaded_before_stays_with_who_loaded_it(folder: Path):
    (folder / "both.py").write_text(
        "import registration\nimport capture4d\n_ = capture4d.register_mesh\nprint(registration.WHOSE)\n"
    )
    assert python(folder, "both.py").stdout.strip() == "the user, registration"


def test_whoever_asks_for_theirs_afterwards_is_told(folder: Path):
    (folder / "late.py").write_text("import capture4d\nimport registration\n")
    done = python(folder, "late.py")
    assert done.returncode == 1
    said = done.stderr.splitlines()[-1]
    assert "registration.py: expected another name, for capture4d has a package 'registration'" in said
