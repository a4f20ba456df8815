"""Commands run in this process, as a user types them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from capture4d.cli.main import main

PROGRESS = re.compile(
    r"[\w ,-]+: (begins|(stopped|ends) after [\d:]+|\d+ of \d+(, | in ).*)"
    r"|capture4d: registration: the cloth is plain .*"
)
"""A line about how far the work is, where stderr is not a terminal, or what was decided on the way."""


def run(*arguments: str | Path) -> int:
    """The exit code of a command."""
    with pytest.raises(SystemExit) as exit_:
        main([str(argument) for argument in arguments])
    return int(exit_.value.code or 0)


def fails(capsys: pytest.CaptureFixture[str], *arguments: str | Path, code: int = 1) -> str:
    """Run a command that must fail, on its input if the code is 1; what the one line it ends with says of the fault."""
    capsys.readouterr()
    given = run(*arguments)
    said = capsys.readouterr().err.strip()
    assert given == code, said
    assert "Traceback" not in said
    *progress, line = said.splitlines()
    assert all(PROGRESS.fullmatch(each) for each in progress), said
    assert line.startswith("capture4d: ")
    return line.removeprefix("capture4d: ")
