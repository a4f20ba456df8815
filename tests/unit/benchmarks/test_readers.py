"""The benchmark of readers notices what it is there to notice, and gives the same mutants again."""

import json
import random
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from benchmarks import reader_kinds
from benchmarks.reader_damage import mutant
from benchmarks.reader_kinds import KINDS, Kind, whole
from benchmarks.reader_rules import RULES
from benchmarks.reader_worker import Mutant, Outcome, Reading, judged, replay
from benchmarks.readers import keep
from capture4d.errors import InputError

SCRIPT = """
import os, signal, sys
import benchmarks.reader_kinds as kinds
import benchmarks.reader_worker as worker

WHOLE = b'{"a": 1}'

def crash(path):
    if path.read_bytes() != WHOLE:
        os.kill(os.getpid(), signal.SIGSEGV)

def hang(path):
    while path.read_bytes() != WHOLE:
        pass

def greedy(path):
    if path.read_bytes() != WHOLE:
        bytearray(120_000_000)

def careless(path):
    if path.read_bytes() != WHOLE:
        raise ZeroDivisionError

READERS = {"crash": crash, "hang": hang, "greedy": greedy, "careless": careless, "good": bytes}
kinds.KINDS[:] = [kinds.Kind(f"{name}.json", lambda path: path.write_bytes(WHOLE), read)
                  for name, read in READERS.items()]
kinds.BY_NAME.clear()
kinds.BY_NAME.update({kind.name: kind for kind in kinds.KINDS})
worker.CPU_S = 3.0

if __name__ == "__main__":
    for outcome in worker.read_apart(worker.Reading(0, 5)):
        print(outcome.mutant.name, outcome.found)
"""


@pytest.mark.slow
def test_readers_that_crash_hang_or_take_too_much_are_told_apart(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT)
    done = subprocess.run([sys.executable, str(tmp_path / "script.py")], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = [tuple(line.split()) for line in done.stdout.splitlines()]
    assert len(found) == 5  # every mutant has an outcome, also those after a death
    assert set(found) == {
        ("crash.json", "crash"), ("hang.json", "hang"), ("greedy.json", "memory"), ("careless.json", "traceback"),
        ("good.json", "value"),
    }  # fmt: skip


@pytest.fixture
def kind(monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    """A kind of file whose reader answers, or raises, what stands under "answer"."""
    said: dict[str, object] = {}

    def read(path: Path) -> object:
        answer = said["answer"]
        if isinstance(answer, InputError):
            raise answer if answer.where is None else answer.at(path)
        return answer

    monkeypatch.setitem(reader_kinds.BY_NAME, "x.json", Kind("x.json", lambda path: path.write_text("{}"), read))
    return said


@pytest.mark.parametrize(("answer", "refused", "found"), [
    ([1.0], False, "value"),
    ([1.0], True, "nonsense"),
    ([float("nan")], False, "nonsense"),
    (InputError("expected this", where="x"), False, "line"),
    (InputError("expected this"), False, "traceback"),
    (InputError("x" * 3000, where="x"), False, "traceback"),
    (InputError("too large for the memory there is", where="x"), False, "traceback"),
])  # fmt: skip
def test_an_answer_is_judged(kind: dict[str, object], answer: object, refused: bool, found: str) -> None:
    kind["answer"] = answer
    assert judged("x.json", {"x.json": b"{}"}, refused=refused)[0] == found


def test_a_seed_gives_its_mutants_again() -> None:
    for each in KINDS[::7]:
        first, again = (mutant(random.Random(5), each.name, whole(each.name)) for _ in range(2))
        assert first == again
        assert first[1].keys() == whole(each.name).keys()
    assert Reading(3, 500).mutants() == Reading(3, 500).mutants()
    assert len(Reading(3, 500).mutants()) == 500


def test_every_breaker_changes_its_file() -> None:
    for rule in RULES:
        for number, name in enumerate(rule.kinds):
            assert rule.broken(random.Random(number), number)[name] != whole(name)[name], (rule.name, number, name)


def test_a_mutant_that_was_kept_is_read_again(tmp_path: Path) -> None:
    made = Mutant(0, "any.json", 3)
    keep(tmp_path / "kept", Outcome(made, "traceback", "ValueError"), Console(quiet=True))
    said = (tmp_path / "kept" / "mutant.txt").read_text()
    assert f"python -m benchmarks readers --replay {tmp_path / 'kept'}" in said
    assert (tmp_path / "kept" / "files" / "any.json").read_bytes() == made.files()["any.json"]
    assert replay(tmp_path / "kept", Console(quiet=True)) == []


def test_the_gate_holds_every_count_at_zero() -> None:
    baseline = json.loads((Path(__file__).parents[3] / "benchmarks" / "baseline.json").read_text())
    for name, count in (("readers", 20_000), ("readers-quick", 1000)):
        assert baseline[name]["mutants"]["value"] >= count
        for key in ("tracebacks", "hangs", "memory_over_limit", "crashes", "nonsense_accepted"):
            assert baseline[name][key] == {"value": 0, "tolerance": 0.0}
