"""What README and docs tell a reader to type works: Python is run, command lines are parsed."""

import importlib
import json
import pkgutil
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

import capture4d.cli
from tests.command_line import run

ROOT = Path(__file__).parents[3]
PAGES = {str(path.relative_to(ROOT)): path for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))}


def blocks(page: str, language: str) -> list[tuple[int, str]]:
    """Snippets of a page and the lines they begin in."""
    tokens = MarkdownIt().parse(PAGES[page].read_text())
    found = [token for token in tokens if token.type == "fence" and (token.info.split() or [""])[0] == language]
    return [(token.map[0] + 2, token.content) for token in found if token.map]


def commands(page: str) -> list[tuple[int, list[str]]]:
    """Lines that run capture4d, without comments, redirections and what they are piped into."""
    found = []
    for first, block in blocks(page, "sh"):
        for number, line in enumerate(block.splitlines(), first):
            words = shlex.split(line, comments=True)
            end = next((index for index, word in enumerate(words) if word in ("|", ">", "&&", ";")), len(words))
            if words[:1] == ["capture4d"]:
                found.append((number, words[1:end]))
    return found


LINES = [pytest.param(words, id=f"{page}:{line}") for page in PAGES for line, words in commands(page)]
WITH_PYTHON = [page for page in PAGES if blocks(page, "python")]


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_PYTHON)
def test_python_runs(page: str, shop: Path, monkeypatch: pytest.MonkeyPatch):
    """The snippets of a page run one after the other, in a folder with what they name; what one page has made, another
    finds done."""
    monkeypatch.chdir(shop)
    names: dict[str, object] = {"__name__": "snippet"}
    for line, source in blocks(page, "python"):
        padded = "\n" * (line - 1) + source  # a traceback names the line of the page
        exec(compile(padded, page, "exec"), names)


@pytest.mark.slow
@pytest.mark.parametrize("example", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.stem)
def test_examples_find_what_they_import(
    example: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("sys.argv", [example.name, "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(example), run_name="__main__")
    assert not end.value.code
    assert f"python examples/{example.name}" in capsys.readouterr().out


@pytest.fixture
def parse_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands are told what to do, and do not do it."""
    for info in pkgutil.iter_modules(capture4d.cli.__path__):
        for value in vars(importlib.import_module(f"capture4d.cli.{info.name}")).values():
            if isinstance(value, type) and "__call__" in vars(value):
                monkeypatch.setattr(value, "__call__", lambda _: 0)


def names_of_commands(capsys: pytest.CaptureFixture[str]) -> list[str]:
    run("--help")
    return re.findall(r"^  ([a-z-]+(?: [a-z]+)?)  ", capsys.readouterr().out, re.MULTILINE)


@pytest.mark.parametrize("words", LINES)
def test_a_command_line_is_understood(words: list[str], parse_only: None, capsys: pytest.CaptureFixture[str]):
    """The command exists and takes these options and values; it is not run."""
    assert run(*words) == 0, capsys.readouterr().err


def test_a_wrong_line_is_found(parse_only: None):
    assert run("register", "capture", "--output", "work", "--no-such-option", "3") == 2
    assert run("synth", "take", "--preset", "no-such-preset") == 2
    assert run("no-such-command") == 2


def test_command_lines_are_said_to_be_some():
    """A block without a language would not be looked at."""
    assert [page for page in PAGES if any("capture4d " in text for _, text in blocks(page, ""))] == []


def test_there_is_something_to_test():
    assert len(LINES) > 50
    assert {"README.md", "docs/tutorial/python.md"} <= set(WITH_PYTHON)


def test_the_readme_is_one_page_and_its_snippet_at_most_15_lines():
    assert len(PAGES["README.md"].read_text().splitlines()) <= 90
    assert [len(source.splitlines()) <= 15 for _, source in blocks("README.md", "python")] == [True]


@pytest.mark.slow
def test_type_checkers_follow_the_snippet_of_the_readme(tmp_path: Path):
    """Names that are loaded late keep their types."""
    ((_, source),) = blocks("README.md", "python")
    names = ("template", "registered.frame_ids", "fitted", "garment", "vertices")
    (tmp_path / "snippet.py").write_text(source + "".join(f"reveal_type({name})\n" for name in names))
    (tmp_path / "pyrightconfig.json").write_text(json.dumps({"extraPaths": [str(ROOT)]}))
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "--project", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert 'Type of "template" is "Mesh"' in done.stdout
    assert 'Type of "registered.frame_ids" is "ndarray[' in done.stdout
    assert done.stdout.count("Type of ") == len(names)
    assert not re.search(r'is "(Any|Unknown)"', done.stdout), done.stdout


def test_the_table_of_commands_is_whole(capsys: pytest.CaptureFixture[str]):
    table = PAGES["docs/reference/commands.md"].read_text()
    assert sorted(re.findall(r"^\| `([a-z -]+)` \|", table, re.MULTILINE)) == sorted(names_of_commands(capsys))


def test_the_reference_has_every_name_of_the_face():
    listed = re.findall(r"^::: capture4d\.(\w+)$", PAGES["docs/reference/python.md"].read_text(), re.MULTILINE)
    assert sorted(listed) == sorted({*capture4d.__all__} - {"__version__"})
