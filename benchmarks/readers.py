"""Files that are damaged, lie, or hold nonsense, through every reader: a value or one line, and nothing else."""

from __future__ import annotations

import itertools
import shlex
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

from rich.console import Console

from benchmarks.metric import Metric
from benchmarks.reader_worker import Outcome, Reading, read_apart
from benchmarks.reader_worker import replay as read_again

FULL, QUICK = 20_000, 1_000
FAULTS = ("traceback", "hang", "memory", "crash", "nonsense")
"""What may be found of a mutant; anything else is as it should be."""


def run(
    *,
    quick: bool = False,
    mutants: int | None = None,
    kind: str | None = None,
    seed: int = 0,
    endless: bool = False,
    failures: Path = Path("out/readers"),
    replay: Path | None = None,
) -> list[Metric]:
    """Damage files of every kind that is read, and read them in a process that may die of it.

    Args:
        quick: a thousand mutants instead of twenty thousand.
        mutants: so many.
        kind: files of this kind alone, such as mesh.ply.
        seed: of the damage, printed; with the same one come the same mutants.
        endless: go on until it is interrupted, seed after seed.
        failures: folder for mutants that were not read as they should be; each says how it is read again.
        replay: a folder of that kind, to be read once more, in this process.
    """
    console = Console(stderr=True)
    if replay is not None:
        return [Metric(f"{fault}s", 1.0) for fault in read_again(replay, console)]
    count = mutants or (QUICK if quick else FULL)
    outcomes: Counter[str] = Counter()
    began = time.perf_counter()
    for now in itertools.count(seed) if endless else (seed,):
        console.print(f"seed {now}: python -m benchmarks readers --seed {now} --mutants {count}")
        try:
            for outcome in read_apart(Reading(now, count, kind)):
                outcomes[outcome.found] += 1
                if outcome.found in FAULTS:
                    keep(failures / f"{outcome.mutant.name.replace('/', '-')}-{now}-{outcome.mutant.number}", outcome,
                          console)  # fmt: skip
        except KeyboardInterrupt:
            break
    console.print(f"{outcomes.total()} mutants in {time.perf_counter() - began:.0f} s: {dict(outcomes)}")
    return [
        Metric("mutants", outcomes.total(), "files", "higher"),
        Metric("tracebacks", outcomes["traceback"], "files"),
        Metric("hangs", outcomes["hang"], "files"),
        Metric("memory_over_limit", outcomes["memory"], "files"),
        Metric("crashes", outcomes["crash"], "files"),
        Metric("nonsense_accepted", outcomes["nonsense"], "files"),
        *([] if endless or kind else _speed()),
    ]


def keep(folder: Path, outcome: Outcome, console: Console) -> None:
    """Write a mutant down, with what it did and how it is read again."""
    for name, data in outcome.mutant.files().items():
        (folder / "files" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "files" / name).write_bytes(data)
    command = f"python -m benchmarks readers --replay {shlex.quote(str(folder))}"
    said = f"{outcome.mutant.name}\n{outcome.mutant.rule}\n{outcome.found}: {outcome.said}\n{command}\n"
    (folder / "mutant.txt").write_text(said)
    console.print(f"{outcome.found}: {outcome.mutant.name}, {outcome.mutant.said}: {outcome.said.strip()[-300:]}\n"
                  f"  {command}", markup=False, soft_wrap=True)  # fmt: skip


# --- speed -----------------------------------------------------------------------------------------------------------


SPEED_RUNS = 5
"""Of each reader; the least counts, for others may be at work."""


def _speed() -> Iterator[Metric]:
    """CPU time of our readers as a multiple of trimesh's, for a scan of 200,000 vertices and 400,000 faces."""
    import tempfile

    import numpy as np
    import trimesh

    from capture4d.mesh_files.meshes import read_mesh, write_mesh
    from capture4d.types import Mesh

    columns, rows = 400, 500
    across, down = np.meshgrid(np.arange(columns, dtype=np.float32), np.arange(rows, dtype=np.float32))
    height = np.random.default_rng(0).random(columns * rows, np.float32)
    corner = (np.arange(rows)[:, None] * columns + np.arange(columns)).astype(np.int32)
    right, below = np.roll(corner, -1, axis=1), np.roll(corner, -1, axis=0)
    opposite = np.roll(below, -1, axis=1)
    faces = np.stack([np.stack([corner, right, opposite], -1), np.stack([corner, opposite, below], -1)])
    mesh = Mesh(np.column_stack([across.ravel(), down.ravel(), height]) / 1000, faces.reshape(-1, 3).astype(np.int32))
    with tempfile.TemporaryDirectory() as folder:
        for ending in ("obj", "ply"):
            path = Path(folder) / f"scan.{ending}"
            write_mesh(path, mesh)
            ours = _cpu_s(lambda path=path: read_mesh(path))
            theirs = _cpu_s(lambda path=path: trimesh.load(path, process=False))
            yield Metric(f"{ending}_to_trimesh_cpu", ours / theirs, "x")


def _cpu_s(work: Callable[[], object]) -> float:
    """Least CPU time of some runs; the first one imports what it needs."""
    times = []
    for _ in range(SPEED_RUNS):
        began = time.process_time()
        work()
        times.append(time.process_time() - began)
    return min(times)
