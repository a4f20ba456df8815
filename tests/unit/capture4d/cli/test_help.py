"""Help: everything that can be typed is told of, in lines that fit, and what it says to type works."""

import contextlib
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import tyro

from capture4d.cli import parsing
from capture4d.cli.help_text import EXAMPLES
from capture4d.cli.main import _PRESETS, COMMANDS
from capture4d.cli.option_tree import options_of
from capture4d.cli.parsing import parse
from capture4d.cli.topics import TOPICS
from tests.command_line import fails, run

ROOT = Path(__file__).parents[4]


def shown(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    capsys.readouterr()
    assert run(*words) == 0
    return capsys.readouterr().out


def listed(text: str) -> set[str]:
    """Options that a help text has a row for."""
    return set(re.findall(r"^  (--[\w.-]+)", text, re.MULTILINE))


@pytest.mark.parametrize("columns", ["60", "100", "220"])
@pytest.mark.parametrize("name", COMMANDS)
def test_a_commands_help_fits_and_is_in_the_users_words(
    name: str, columns: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("COLUMNS", columns)
    for option in ("--help", "--help-all"):
        text = shown(capsys, *name.split(), option)
        lines = text.partition("\nexamples:")[0].splitlines()  # which are not broken
        assert max(map(len, lines)) <= min(int(columns), 100), max(lines, key=len)
        assert max(map(len, text.splitlines())) <= 100
        assert not re.search(r"\{None|None\}|\bNone\b|<|MISSING|\bSTR\b|\bINT\b|\bFLOAT\b|╭", text)
        assert text.count("\nexamples:\n") == 1
        assert f"usage: capture4d {name} [OPTIONS]" in text


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_told_of_and_no_other(name: str, capsys: pytest.CaptureFixture[str]):
    options = options_of(COMMANDS[name])
    assert [option.spelling for option in options if not option.text] == []
    every = {each for option in options if not option.is_positional for each in (option.spelling, option.negation)}
    first, all_ = listed(shown(capsys, *name.split(), "--help")), listed(shown(capsys, *name.split(), "--help-all"))
    assert first <= all_ <= every | {"--help"}
    told = [option for option in options if not option.is_positional and not {option.spelling, option.negation} & all_]
    assert told == []
    assert all(each.count(".") <= 1 for each in first), "settings inside settings are for experts"


@pytest.mark.parametrize("name", COMMANDS)
def test_tyro_parses_what_is_told_of(name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "150")
    with contextlib.suppress(SystemExit):
        tyro.cli(COMMANDS[name], args=["--help"], config=(tyro.conf.AvoidSubcommands,))
    said, spelt = capsys.readouterr().out, re.compile(r"--[a-z][\w.-]+")
    found = {word.rstrip(".") for word in spelt.findall(said)} - {"--help"}
    ours = [option for option in options_of(COMMANDS[name]) if not option.is_positional]
    switches = {option.negation for option in ours if option.kind is bool}
    every = {option.spelling for option in ours} | switches
    assert every <= found
    assert found - every <= {*spelt.findall(COMMANDS[name].__doc__)}, "which may speak of other commands"


@pytest.mark.parametrize("name", COMMANDS)
def test_examples_are_understood(name: str):
    assert EXAMPLES[name]
    for line in EXAMPLES[name]:
        words = shlex.split(line)
        rest = words[len(name.split()) :]
        assert " ".join(words[: -len(rest) or None]) == name
        parse(name, COMMANDS[name], rest, _PRESETS.get(COMMANDS[name]))


QUICK = {
    "fit-style",
    "tryon",  # a page, which says itself what it does
    "offsets draw",
    "offsets edit",
    "offsets apply",
    "template",
    "register-mesh",
    "convert-body",
    "convert-rig",
    "convert-poses",
    "doctor",
    "cache",
    "status",
    "diff",
}
"""Commands that show no progress."""


@pytest.mark.parametrize("name", sorted({*COMMANDS} - QUICK))
def test_whatever_shows_progress_can_be_quiet_or_speak_json(name: str):
    assert {"--quiet", "--json-progress"} <= {option.spelling for option in options_of(COMMANDS[name])}


def test_defaults_are_those_of_the_preset(capsys: pytest.CaptureFixture[str]):
    nodes = re.compile(r"--registration.graph.nodes N\s.*?\(default:\s+(\d+)\)", re.DOTALL)
    found = {
        preset: nodes.findall(shown(capsys, "run", "--preset", preset, "--help-all"))[0]
        for preset in ("default", "paper")
    }
    assert found == {"default": "300", "paper": "800"}


# --- topics


@pytest.mark.parametrize("name", TOPICS)
def test_a_topic_is_short_its_page_is_there_and_its_lines_are_understood(name: str, capsys: pytest.CaptureFixture[str]):
    text = shown(capsys, "help", *name.split())
    lines = text.splitlines()
    assert max(map(len, lines)) <= 100
    assert len(lines) <= 24, "a topic fits a terminal"
    page, _, section = TOPICS[name].page.partition("#")
    headings = re.findall(r"^#+ (.*)", (ROOT / "docs" / page).read_text(), re.MULTILINE)
    assert not section or section in [heading.lower().replace(" ", "-") for heading in headings]
    for line in lines:
        words = shlex.split(line, comments=True) if line.startswith("capture4d ") else []
        size = 2 if words[1:2] == ["wrinkles"] else 1
        if words:
            command = " ".join(words[1 : 1 + size])
            parse(command, COMMANDS[command], words[1 + size :], _PRESETS.get(COMMANDS[command]))


def test_help_alone_lists_the_topics_and_help_of_a_command_is_its_help(capsys: pytest.CaptureFixture[str]):
    assert set(re.findall(r"^  ([\w-]+)  ", shown(capsys, "help"), re.MULTILINE)) == set(TOPICS)
    assert shown(capsys, "help", "run") == shown(capsys, "run", "--help")
    assert shown(capsys, "help", "wrinkles", "train") == shown(capsys, "wrinkles", "train", "--help")
    assert shown(capsys, "help", "wrinkles").startswith(TOPICS["wrinkles"].title)
    assert "Options: capture4d check --help" in shown(capsys, "help", "check")
    assert "no help on 'exit-code'; did you mean 'exit-codes'?" in fails(capsys, "help", "exit-code", code=2)


def test_a_commands_help_loads_nothing_heavy():
    script = (
        "import sys; from capture4d.cli.main import main\n"
        "for words in (['run', '--help-all'], ['help'], ['help', 'units'], ['run', 'x', '--wrong']):\n"
        "    try: main(words)\n"
        "    except SystemExit: pass\n"
        "heavy = {'numpy', 'scipy', 'torch', 'open3d', 'numba', 'warp', 'newton', 'rich'} & set(sys.modules)\n"
        "sys.exit(f'loaded {heavy}' if heavy else 0)"
    )
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)


# --- what is wrong with a command line


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("register x --output y --graph.nodes 3", "--graph.nodes: no such option; it is called --registration.graph"),
        ("track x --output y --start rest", "--start: no such option; it is called --tracking.start"),
        ("wrinkles maps x --map.size 3", "--map.size: no such option; it is called --pairs.map.size"),
        ("run x --output y --track", "--track: no such option; it is called --tracked"),
        ("check x --frames a_{frame}.ply", "--frames: no such option; it is called --pattern"),
        ("compare x --model y --gap 3", "--gap: no such option; it is called --held-out-gap"),
        ("register-mesh a b --output c --boundary-colour ffd200", "it is called --border-colour"),
        ("run x --output y --wrokers 3", "--wrokers: no such option; did you mean --workers?"),
        ("run x", "--output PATH: expected, and missing: Work folder (see capture4d run --help)"),
        ("run --output y", "CAPTURE: expected, and missing: Capture folder (see capture4d run --help)"),
        ("run x y --output z", "'y': expected an option, or nothing more (see capture4d run --help)"),
        ("run x --output", "--output: expected a value (PATH), found none"),
        ("run x --output y --workers two", "--workers: expected a whole number, found 'two'"),
        ("run x --output y --workers=2.5", "--workers: expected a whole number, found '2.5'"),
        ("run x --output y --max-failed few", "--max-failed: expected a number, found 'few'"),
        ("run x --output y --wait=yes", "--wait: expected no value, found 'yes'"),
        ("run x --output y --preset papr", "expected one of default, paper, found 'papr'; did you mean paper?"),
        ("register x --output y --registration.coarse.cold.gate 1", "expected 2 values (X X), found 1"),
        ("template a.obj --output b --frame None", "--frame: expected a whole number, found 'None'"),
        ("run x --output y --quiet --json-progress", "--json-progress: expected to be without --quiet, found both"),
    ],
)
def test_a_wrong_command_line_is_one_line(line: str, said: str, capsys: pytest.CaptureFixture[str]):
    assert said in fails(capsys, *line.split(), code=2)


def test_former_spellings_are_gone_and_what_they_are_called_is_there():
    for (name, former), now in parsing.FORMER_SPELLINGS.items():
        spellings = {option.spelling for option in options_of(COMMANDS[name])}
        assert former not in spellings
        assert now in spellings


@pytest.mark.parametrize(
    ("line", "values"),
    [
        ("animate m --poses p --output o --beta 1.5 -2", {"beta": (1.5, -2.0)}),
        ("animate m --beta --poses p --output o", {"beta": ()}),
        ("report w --fail-above a=1 --fail-above b=2", {"fail_above": ("a=1", "b=2")}),
        ("fit a b --output=o --no-kernel.tuning.enabled", None),
        ("doctor --no-load", {"load": False}),
        ("fit a b c", {"works": (Path("a"), Path("b"), Path("c"))}),
        ("run --output o x --max_failed 3", {"capture": Path("x"), "max_failed": 3.0}),
    ],
)
def test_lines_are_read_as_they_are_meant(line: str, values: dict[str, Any] | None, capsys: pytest.CaptureFixture[str]):
    name, *rest = line.split()
    if values is None:
        assert "did you mean --kernel.tuning." in fails(capsys, *line.split(), code=2)
        return
    command = parse(name, COMMANDS[name], rest, _PRESETS.get(COMMANDS[name]))
    assert {key: getattr(command, key) for key in values} == values
