"""Mutants are read in a process of their own, which may crash, hang, or ask for all memory: that is an outcome.

A mutant is decided by its seed, kind and number, so that only these travel, and one whose process died can be made
again.
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import random
import re
import signal
import time
import traceback
import tracemalloc
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

__all__ = ["CPU_S", "MEMORY", "Mutant", "Outcome", "Reading", "judged", "read_apart", "replay"]

MEMORY = 100_000_000
"""Bytes that a reader may take for a file of some kilobytes."""
CPU_S, WALL_S = 5.0, 60.0
"""Longer than that is a hang: of computing, or of waiting on a busy machine."""
ADDRESSES = 8 << 30
"""Bytes of address space that a reader may take besides what it begins with: none takes the machine with it."""
LONGEST = 2000
"""Characters of a line."""


@dataclass(frozen=True, slots=True)
class Reading:
    """Which mutants are read."""

    seed: int
    count: int
    kind: str | None = None

    def mutants(self) -> list[Mutant]:
        """Those of the rules first, then as many as are left, kind by kind in turn."""
        from benchmarks.reader_kinds import KINDS
        from benchmarks.reader_rules import RULES

        kinds = [kind.name for kind in KINDS if self.kind in (None, kind.name)]
        ruled = [
            Mutant(self.seed, name, number, rule.name)
            for rule in RULES
            for number, name in enumerate(rule.kinds)
            if name in kinds
        ]
        left = max(self.count - len(ruled), 0)
        free = [Mutant(self.seed, kinds[number % len(kinds)], number // len(kinds)) for number in range(left)]
        return ruled + free


@dataclass(frozen=True, slots=True)
class Mutant:
    """One damaged file."""

    seed: int
    name: str
    """Of its kind."""
    number: int
    rule: str = ""
    """What it breaks; it must not be accepted."""

    def make(self) -> tuple[str, dict[str, bytes]]:
        """What was done to it, and the files."""
        from benchmarks.reader_damage import mutant
        from benchmarks.reader_kinds import whole
        from benchmarks.reader_rules import RULES

        chance = random.Random(f"{self.seed} {self.name} {self.number} {self.rule}")
        if self.rule:
            rule = next(rule for rule in RULES if rule.name == self.rule)
            return self.rule, rule.broken(chance, self.number)
        return mutant(chance, self.name, whole(self.name))

    def files(self) -> dict[str, bytes]:
        return self.make()[1]

    @property
    def said(self) -> str:
        return self.make()[0]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a mutant: a value, a line, or a fault of the reader's."""

    mutant: Mutant
    found: str
    said: str = ""


# --- the process -----------------------------------------------------------------------------------------------------


def read_apart(reading: Reading) -> Iterator[Outcome]:
    """Read mutants in processes that come one after the other, whenever one dies."""
    waiting = reading.mutants()
    while waiting:
        done = 0
        for outcome in _read_until_death(waiting):
            done += 1
            yield outcome
        assert done, "a process died before its first mutant"
        waiting = waiting[done:]


def _read_until_death(mutants: list[Mutant]) -> Iterator[Outcome]:
    """The outcomes of one process; the last is its death, if it dies."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(theirs, mutants), daemon=True)
    process.start()
    theirs.close()
    try:
        if not ours.poll(10 * WALL_S):
            raise RuntimeError("the process that reads mutants did not begin")
        if begun := ours.recv():  # nothing, when it has loaded what readers need
            raise RuntimeError(f"the process that reads mutants did not begin:\n{begun}")
        for mutant in mutants:
            if not ours.poll(WALL_S):
                process.kill()
                yield Outcome(mutant, "hang", f"waited {WALL_S:.0f} s")
                return
            try:
                found, said = ours.recv()
            except (EOFError, ConnectionResetError):
                process.join()
                hung = process.exitcode == -signal.SIGPROF
                yield Outcome(mutant, "hang" if hung else "crash", f"exit code {process.exitcode}")
                return
            yield Outcome(mutant, found, said)
    finally:
        process.kill()
        process.join()


def _serve(connection: multiprocessing.connection.Connection, mutants: list[Mutant]) -> None:
    """Read one mutant after the other; the system ends the process if one takes too long."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 2)  # what native decoders print
    try:
        _warm_up()
        _limit_addresses()
    except BaseException:  # of a kind that is out of step with its reader, say
        connection.send(traceback.format_exc())
        return
    connection.send(None)
    for mutant in mutants:
        files = mutant.files()
        signal.setitimer(signal.ITIMER_PROF, CPU_S)
        answer = judged(mutant.name, files, refused=bool(mutant.rule))
        signal.setitimer(signal.ITIMER_PROF, 0)
        connection.send(answer)


def _warm_up() -> None:
    """Read a whole file of every kind, so that nothing is loaded or compiled while mutants are measured."""
    from benchmarks.reader_kinds import KINDS, fault_of, laid_out, whole

    for kind in KINDS:
        with laid_out(whole(kind.name), kind.name) as path:
            fault_of(kind, path)


def _limit_addresses() -> None:
    import resource

    status = Path("/proc/self/status")
    if status.is_file():
        found = re.search(r"VmSize:\s*(\d+) kB", status.read_text())
        taken = int(found[1]) * 1024 if found else 0
        resource.setrlimit(resource.RLIMIT_AS, (taken + ADDRESSES, resource.RLIM_INFINITY))


def judged(name: str, files: dict[str, bytes], *, refused: bool) -> tuple[str, str]:
    """Read a file; "value" or "line", or the fault, and what is said of it.

    Args:
        refused: it breaks a rule and must have no value.
    """
    from benchmarks.reader_judge import nonsense_in
    from benchmarks.reader_kinds import BY_NAME, fault_of, laid_out

    kind = BY_NAME[name]
    with laid_out(files, name) as path:
        tracemalloc.start()
        resident = _peak_from_now()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                value, error = fault_of(kind, path)
        except BaseException:  # whatever it is, a reader must not raise it
            return "traceback", traceback.format_exc(limit=-6)
        finally:
            peak = max(tracemalloc.get_traced_memory()[1], _peak_rss() - resident)
            tracemalloc.stop()
        if peak > MEMORY:
            return "memory", f"{peak} bytes"
        if error is None:
            found = "it breaks this rule" if refused else nonsense_in(value)
            return ("nonsense", found) if found else ("value", "")
        wrong = _wrong_with(str(error), error.reason, error.where, path.parents[name.count("/")])
        return ("traceback", f"{wrong}: {error}") if wrong else ("line", str(error))


def _wrong_with(line: str, reason: str, where: Any, folder: Path) -> str:
    """What is not as it should be about a line, empty if nothing."""
    if where is None or not Path(where).is_relative_to(folder):
        return "names no file"
    if "\n" in line or "\r" in line:
        return "more than a line"
    if "too large for the memory" in line:
        return "asked for all memory"
    return "longer than a line" if len(reason) > LONGEST else ""


_CLEAR = Path("/proc/self/clear_refs")


def _peak_from_now() -> int:
    """Begin to measure the largest resident set; what it is now."""
    try:
        _CLEAR.write_text("5")
    except OSError:  # another system
        return 0
    return _peak_rss()


def _peak_rss() -> int:
    from benchmarks.memory import peak_rss_mb

    return int(peak_rss_mb() * (1 << 20)) if _CLEAR.exists() else 0


# --- once more -------------------------------------------------------------------------------------------------------


def replay(folder: Path, console: Console) -> list[str]:
    """Read a mutant that was kept; the faults found, at most one."""
    name, rule = (folder / "mutant.txt").read_text().splitlines()[:2]
    files = {
        path.relative_to(folder / "files").as_posix(): path.read_bytes()
        for path in (folder / "files").rglob("*")
        if path.is_file()
    }
    began = time.perf_counter()
    found, said = judged(name, files, refused=bool(rule))
    console.print(f"{name}: {found} in {time.perf_counter() - began:.2f} s\n{said}", markup=False, soft_wrap=True)
    return [] if found in ("value", "line") else [found]
