"""What this installation is and whether it works: versions, machine, cache, and the parts it is made of.

Nothing of it is loaded here: versions are read from what pip has written, and the parts are loaded in a process of
their own, so that one which crashes is a line of the answer.
"""

from __future__ import annotations

import importlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any, Literal

from packaging.requirements import Requirement

from capture4d.cache import cache_path, can_write, kernel_cache
from capture4d.cli.options import all_cores

__all__ = ["Cache", "Diagnosis", "Machine", "Part", "as_json", "as_text", "diagnose", "load_apart", "load_one_by_one",
           "module_of"]  # fmt: skip

State = Literal["found", "missing", "broken", "other version"]
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
OPTIONAL = {
    "alembic3d": "`export --format abc`",
    "onnx": "`export-onnx`",
    "onnxruntime": "`export-onnx`",
    "meshmonk": "a peer of `python -m benchmarks registration`",
    "OpenEXR": "`offsets draw --format exr`",
    "usd-core": "`export --format usd`",
    "viser": "`view` and `tryon`",
}
"""Distributions that something is better with, and what."""
CUDA = "`--device cuda` of fit and animate"
_MODULES = {
    "dracopy": "DracoPy",
    "libusb-package": "libusb_package",
    "opencv-contrib-python-headless": "cv2",
    "pillow": "PIL",
    "usd-core": "pxr",
    "warp-lang": "warp",
}
"""What is imported, where it is not called as the distribution."""
_MARK = "capture4d doctor: "
_LOAD_S = 300
"""Longer than any part takes to load on a slow disk."""


@dataclass(frozen=True, slots=True)
class Part:
    """A distribution, or a device, that capture4d uses."""

    name: str
    required: bool
    state: State
    version: str | None = None
    detail: str = ""
    """What is wrong with it, or what it is good for."""

    @property
    def is_fatal(self) -> bool:
        return self.required and self.state in ("missing", "broken")


@dataclass(frozen=True, slots=True)
class Machine:
    """What there is to compute with."""

    system: str
    python: str
    executable: str
    cores: int
    """That this process may use."""
    memory_gb: float | None
    free_memory_gb: float | None
    threads: dict[str, str | None]
    """Variables that numerical libraries read; the command sets to 1 what is not set."""


@dataclass(frozen=True, slots=True)
class Cache:
    """Where the built-in body and training sets are kept."""

    folder: str
    mb: float
    free_disk_gb: float | None
    fault: str
    """Why nothing can be written there; empty if it can."""
    kernels: str
    """Where compiled kernels are kept."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Everything that a report of a fault should bring along."""

    version: str | None
    """Of capture4d; None if it is not installed."""
    folder: str
    """Where its code lies."""
    machine: Machine
    cache: Cache
    parts: tuple[Part, ...]

    @property
    def faults(self) -> list[str]:
        """One line for each thing without which commands fail."""
        faults = [] if self.version else ["capture4d is not installed, so what it needs is not known; pip install ."]
        faults += [
            f"{part.name}: {part.state}{part.detail and f', {part.detail}'}" for part in self.parts if part.is_fatal
        ]
        return faults + ([f"cache folder {self.cache.folder}: {self.cache.fault}"] if self.cache.fault else [])


def diagnose(*, load: bool = True) -> Diagnosis:
    """Look at this installation.

    Args:
        load: load every part as well, in some seconds; without it a part that is there counts as found.
    """
    own, needed = _requirements()
    parts = [_part(requirement, required=True) for requirement in needed]
    parts += [_part(Requirement(name), required=False) for name in OPTIONAL]
    if load:
        there = [part.name for part in parts if part.state != "missing"]
        faults, cuda = load_apart(sorted(there, key=_order))
        parts = [_judged(part, faults.get(part.name, "")) for part in parts]
        parts.append(
            Part(
                "CUDA", False, "found" if cuda else "missing", None, cuda or "fit --device cuda, animate --device cuda"
            )
        )
    folder = str(Path(__file__).parents[1])
    return Diagnosis(own, folder, _machine(), _cache(cache_path()), tuple(parts))


def as_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """The same for machines."""
    return {"format": 1, **asdict(diagnosis), "faults": diagnosis.faults}


def as_text(diagnosis: Diagnosis) -> str:
    """The same for people, as it is pasted into a report of a fault."""
    machine, cache = diagnosis.machine, diagnosis.cache
    threads = ", ".join(f"{name}={value or '(not set)'}" for name, value in machine.threads.items())
    memory = "unknown" if machine.memory_gb is None else f"{machine.memory_gb:.1f} GB"
    free = "unknown" if machine.free_memory_gb is None else f"{machine.free_memory_gb:.1f} GB"
    disk = "unknown" if cache.free_disk_gb is None else f"{cache.free_disk_gb:.1f} GB"
    told = "writable; capture4d cache names what it keeps"
    rows = [
        ("capture4d", f"{diagnosis.version or 'not installed'} in {diagnosis.folder}"),
        ("Python", f"{machine.python}, {machine.executable}"),
        ("system", machine.system),
        ("machine", f"{machine.cores} cores, {memory} of memory, {free} of it free"),
        ("threads", threads),
        ("cache", f"{cache.folder}: {cache.mb:.0f} MB, {disk} free, {cache.fault or told}"),
        ("kernels", cache.kernels),
    ]
    blocks = [_table(rows)]
    for title, required in (("required", True), ("optional", False)):
        chosen = [part for part in diagnosis.parts if part.required == required]
        blocks.append(f"{title}:\n" + _table([(f"  {part.name}", _told(part)) for part in chosen]))
    return "\n\n".join(blocks)


def load_one_by_one(names: Sequence[str]) -> None:
    """Import distributions in this process and print what came of each; `diagnose` calls it in a process of its own."""
    from capture4d import heavy_imports

    special = {
        "anny": heavy_imports.import_anny,
        "open3d": heavy_imports.import_open3d,
        "pycolmap": heavy_imports.import_pycolmap,
        "warp-lang": heavy_imports.import_warp,
    }
    for name in names:
        _say({"name": name})
        try:
            if name in special:
                special[name]()
            else:
                importlib.import_module(module_of(name))
            cuda = _cuda_name() if name == "torch" else ""
            _say({"name": name, "fault": "", "cuda": cuda})
        except BaseException as error:  # whatever a broken library raises is the answer
            _say({"name": name, "fault": " ".join(f"{type(error).__name__}: {error}".split())})


def module_of(name: str) -> str:
    """What is imported of a distribution."""
    return _MODULES.get(name.lower(), name.replace("-", "_"))


def _say(answer: dict[str, str]) -> None:
    print(_MARK + json.dumps(answer), flush=True)


def _cuda_name() -> str:
    import torch

    return torch.cuda.get_device_name(0) if torch.cuda.is_available() else ""


def _requirements() -> tuple[str | None, list[Requirement]]:
    """Our version, and what it needs on this machine; None and nothing if it is not installed."""
    try:
        entries = [Requirement(text) for text in requires("capture4d") or []]
        here = [entry for entry in entries if entry.marker is None or entry.marker.evaluate({"extra": ""})]
        return version("capture4d"), sorted(here, key=lambda entry: entry.name)
    except PackageNotFoundError:
        return None, []


def _order(name: str) -> tuple[bool, str]:
    """By name, but warp first: loaded by newton or anny, it would speak."""
    return name != "warp-lang", name


def _part(wanted: Requirement, *, required: bool) -> Part:
    purpose = OPTIONAL.get(wanted.name, "")
    try:
        found = version(wanted.name)
    except PackageNotFoundError:
        return Part(wanted.name, required, "missing", None, purpose)
    if not wanted.specifier.contains(found, prereleases=True):
        return Part(wanted.name, required, "other version", found, f"wanted {wanted.specifier}")
    return Part(wanted.name, required, "found", found, purpose)


def _judged(part: Part, fault: str) -> Part:
    return Part(part.name, part.required, "broken", part.version, fault) if fault else part


def load_apart(names: Sequence[str]) -> tuple[dict[str, str], str]:
    """What is wrong with each part once it is loaded, empty where nothing is; and the name of a CUDA device, if any.

    A part that takes its process with it is named, and the rest is loaded in another one.
    """
    faults: dict[str, str] = {}
    cuda, left = "", list(names)
    while left:
        script = f"from capture4d.cli.installation import load_one_by_one; load_one_by_one({left!r})"
        command = [sys.executable, "-P", "-c", script]  # -P: files of the current folder are not looked at
        try:
            done = subprocess.run(command, capture_output=True, text=True, env=_environment(), timeout=_LOAD_S)
            output, end = done.stdout, f"its process ended with {done.returncode} while it was loaded"
        except subprocess.TimeoutExpired as error:
            output, end = _text(error.stdout), f"not loaded after {_LOAD_S} s"
        told = [json.loads(line[len(_MARK) :]) for line in output.splitlines() if line.startswith(_MARK)]
        for answer in told:
            faults[answer["name"]] = answer.get("fault", end)
            cuda = answer.get("cuda", cuda)
        if not told:  # not even the first was begun
            return faults | dict.fromkeys(left, end), cuda
        left = [name for name in left if name not in faults]
    return faults, cuda


def _text(output: bytes | str | None) -> str:
    return output.decode(errors="replace") if isinstance(output, bytes) else output or ""


def _environment() -> dict[str, str]:
    """Of a process that finds the code that is running now."""
    own = str(Path(__file__).parents[2])
    given = os.environ.get("PYTHONPATH")
    return {**os.environ, "PYTHONPATH": os.pathsep.join([own, given] if given else [own])}


def _machine() -> Machine:
    page = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 0
    return Machine(
        system=_system(),
        python=platform.python_version(),
        executable=sys.executable,
        cores=all_cores(),
        memory_gb=page * os.sysconf("SC_PHYS_PAGES") / 1e9 if page else None,
        free_memory_gb=_free_memory_gb(),
        threads={name: os.environ.get(name) for name in THREADS},
    )


def _system() -> str:
    try:
        name = platform.freedesktop_os_release()["PRETTY_NAME"]
    except (OSError, KeyError):
        name = platform.system()
    return f"{name}, {platform.system()} {platform.release()}, {platform.machine()}"


def _free_memory_gb() -> float | None:
    """What new processes may take without swapping, as Linux reckons it."""
    try:
        found = re.search(r"^MemAvailable:\s+(\d+) kB", Path("/proc/meminfo").read_text(), re.MULTILINE)
    except OSError:
        return None
    return int(found[1]) * 1024 / 1e9 if found else None


def _cache(folder: Path) -> Cache:
    """Look at the cache folder; it is made, as by any command that uses it."""
    fault = ""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        fault = error.strerror or str(error)
    there = next((path for path in (folder, *folder.parents) if path.exists()), None)
    return Cache(
        folder=str(folder),
        mb=sum(path.lstat().st_size for path in _files(folder)) / 1e6,
        free_disk_gb=shutil.disk_usage(there).free / 1e9 if there else None,
        fault=fault,
        kernels=_kernels(),
    )


def _kernels() -> str:
    folder = os.environ.get("NUMBA_CACHE_DIR") or kernel_cache()
    if folder is None:
        return "beside the code"
    return str(folder) if can_write(Path(folder)) else "nowhere; every command compiles them anew"


def _files(folder: Path) -> list[Path]:
    return [Path(parent, name) for parent, _, names in os.walk(folder) for name in names]


def _told(part: Part) -> str:
    words = [part.version or "", "" if part.state == "found" else part.state, part.detail and f"({part.detail})"]
    return " ".join(word for word in words if word)


def _table(rows: Sequence[tuple[str, str]]) -> str:
    width = max((len(name) for name, _ in rows), default=0)
    return "\n".join(f"{name:<{width}}  {text}" for name, text in rows)
