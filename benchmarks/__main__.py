"""Measure: `python -m benchmarks NAME [--quick] [--json FILE] [--gate] [options of the benchmark]`.
`--list` prints the names.

--quick measures the same keys on a smaller case; --json also writes the metrics to FILE; --gate exits with 1 if one
is worse than benchmarks/baseline.json allows: its entry NAME, NAME-quick, or with --data NAME-DATA and NAME-DATA-quick.

A benchmark is a module of this package with a function `run(*, quick: bool = False, ...) -> list[Metric]`; its other
keyword arguments become its options.
"""

from __future__ import annotations

import importlib
import inspect
import os
import pkgutil
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.table import Table

import benchmarks
from benchmarks.metric import Metric, broken_limits, write_metrics


@dataclass(frozen=True)
class Outlet:
    json: Path | None = None
    gate: bool = False


def main(arguments: list[str]) -> int:
    # One thread for linear algebra, as in the command: on small matrices several wait for each other, and their waiting
    # counts as CPU time. numpy reads this as it loads, which is later.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    names = _names()
    if arguments == ["--list"]:
        print("\n".join(names))
        return 0
    if not arguments or arguments[0] not in names:
        print(f"{__doc__}\nNAME is one of: {', '.join(names)}")
        return 0 if arguments in (["--help"], ["-h"]) else 2

    name, *rest = arguments
    run = importlib.import_module(f"benchmarks.{name}").run
    outlet, rest = tyro.cli(Outlet, args=rest, return_unknown_args=True, add_help=False)
    started = time.perf_counter()
    metrics: list[Metric] = tyro.cli(run, prog=f"python -m benchmarks {name}", args=rest)
    _print_table(name, metrics, time.perf_counter() - started)

    if outlet.json:
        write_metrics(outlet.json, metrics)
    if not outlet.gate:
        return 0
    broken = broken_limits(baseline_name(name, run, rest), metrics)
    for line in broken:
        print(f"gate: {line}", file=sys.stderr)
    return 1 if broken else 0


def baseline_name(name: str, run: Callable[..., list[Metric]], options: Sequence[str]) -> str:
    """The entry of the baseline that a run is held to: NAME, NAME-DATA for other data than usual, and -quick."""
    usual = inspect.signature(run).parameters.get("data")
    given = [option.split("=", 1) for option in options]
    for index, option in enumerate(given):
        if usual is None or option[0] != "--data":
            continue
        data = option[1] if len(option) > 1 else options[index + 1]
        if data != usual.default:
            name = f"{name}-{data}"
    return f"{name}-quick" if "--quick" in options else name


def _names() -> list[str]:
    """Modules with a `run`, found without importing them."""
    sources = {
        module.name: Path(benchmarks.__path__[0], f"{module.name}.py")
        for module in pkgutil.iter_modules(benchmarks.__path__)
    }
    return [name for name, source in sources.items() if "\ndef run(" in source.read_text()]


def _print_table(name: str, metrics: list[Metric], seconds: float) -> None:
    table = Table("metric", title=f"{name} ({seconds:.0f} s)", title_justify="left")
    table.add_column("value", justify="right")
    table.add_column("unit")
    table.add_column("better")
    for metric in metrics:
        table.add_row(metric.key, f"{metric.value:.4g}", metric.unit, metric.better)
    Console().print(table)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
