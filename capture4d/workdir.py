"""Output that survives a crash: atomic files, stages that resume, and a pool of local workers.

A stage is a folder with a `stage.json` and one file per frame. A file either exists whole or does not exist, so the
work that is left after a crash is the files that are missing, and the same command finishes it with the same result.
A stage remembers its settings and the digests of what it was made from, and refuses to continue with others.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import json
import multiprocessing
import os
import shutil
import signal
import tempfile
import threading
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from datetime import UTC, datetime
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from capture4d.errors import InputError

__all__ = [
    "Stage",
    "WorkerDied",
    "file_digest",
    "open_stage",
    "progress",
    "read_json",
    "require_complete",
    "run_jobs",
    "write_bytes",
    "write_chunks",
    "write_json",
    "write_npy",
    "write_npy_rows",
    "write_npz",
]

_TEMPORARY_SUFFIX = ".partial"

Job = TypeVar("Job")
Result = TypeVar("Result")


# --- files -------------------------------------------------------------------------------------------------------


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a file so that it is there whole or not at all, even if the process is killed.

    Raises:
        OSError: the disk is full or read-only; names the file. What stood at `path` before still stands.
    """
    write_chunks(path, [data])


def write_chunks(path: str | Path, chunks: Iterable[bytes | memoryview]) -> None:
    """`write_bytes` for more than memory should hold at once."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=_TEMPORARY_SUFFIX, dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                for chunk in chunks:
                    file.write(chunk)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(temporary, 0o666 & ~_UMASK)
            os.replace(temporary, path)
        except BaseException:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(temporary)
            raise
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


def _current_umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


_UMASK = _current_umask()


def write_json(path: str | Path, value: Any) -> None:
    """Write JSON for people to read, atomically. NaN is not JSON and raises ValueError."""
    write_bytes(path, (json.dumps(value, indent=2, allow_nan=False, default=_plain) + "\n").encode())


def write_npy(path: str | Path, array: np.ndarray) -> None:
    """Write one array, atomically."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    write_bytes(path, buffer.getvalue())


def write_npy_rows(path: str | Path, rows: Iterable[np.ndarray], *, count: int) -> None:
    """Write one array of `count` rows of equal shape and type, atomically, holding one row in memory at a time."""

    def chunks() -> Iterator[bytes | memoryview]:
        for index, row in enumerate(rows):
            if index == 0:
                header = io.BytesIO()
                described = np.lib.format.header_data_from_array_1_0(row)
                np.lib.format.write_array_header_1_0(
                    header, {**described, "fortran_order": False, "shape": (count, *row.shape)}
                )
                yield header.getvalue()
            yield np.ascontiguousarray(row).tobytes()

    write_chunks(path, chunks())


def write_npz(path: str | Path, **arrays: Any) -> None:
    """Write named arrays, uncompressed and atomically. Equal arrays give equal bytes."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    write_bytes(path, buffer.getvalue())


def read_json(path: str | Path) -> Any:
    """Read JSON; a missing or damaged file is an InputError that names it."""
    path = Path(path)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid JSON ({error})") from None


def file_digest(paths: Iterable[Path], *, root: Path) -> str:
    """SHA-256 over the names (relative to `root`) and contents of files, whatever order they come in."""
    total = hashlib.sha256()
    for name, path in sorted((path.relative_to(root).as_posix(), path) for path in paths):
        with path.open("rb") as file:
            total.update(f"{name}\0{hashlib.file_digest(file, 'sha256').hexdigest()}\n".encode())
    return total.hexdigest()


def _plain(value: Any) -> Any:
    """What json.dumps does not know: configs, numpy scalars and arrays, paths."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")


# --- stages ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """An open output folder. Made by `open_stage`, closed by `finish`."""

    path: Path
    _record: dict[str, Any]
    _earlier: dict[str, Any] | None = None
    """Record of the run before, if that was complete."""

    @property
    def was_complete(self) -> bool:
        """An earlier run with these settings and inputs has finished."""
        return self._earlier is not None

    @property
    def frames_folder(self) -> Path:
        return self.path / "frames"

    def frame_path(self, frame_id: int, suffix: str = ".npz", *, folder: str = "frames") -> Path:
        """Where a frame's file goes: `<stage>/<folder>/000123<suffix>`."""
        return self.path / folder / f"{frame_id:06d}{suffix}"

    def pending(self, frame_ids: Iterable[int], suffix: str = ".npz", *, folder: str = "frames") -> list[int]:
        """The frames that have no valid file yet, in the order given."""
        return [frame_id for frame_id in frame_ids if not _is_whole(self.frame_path(frame_id, suffix, folder=folder))]

    def count(self, suffix: str = ".npz", *, folder: str = "frames") -> int:
        """How many frames have a file, whole or not: cheap enough to be asked every second."""
        try:
            with os.scandir(self.path / folder) as entries:
                return sum(entry.name.endswith(suffix) and not entry.name.startswith(".") for entry in entries)
        except FileNotFoundError:
            return 0

    def finish(self, paths: Iterable[Path], *, changed: bool = True) -> str:
        """Mark the stage complete and return its digest, over the names and contents of `paths`.

        Leave out of `paths` what differs between equal runs, such as times.

        Args:
            changed: False if nothing was written since the stage was opened: if it was complete then, its digest is
                not computed again.
        """
        paths = list(paths)
        if self._earlier is not None and not changed and all(path.is_file() for path in paths):
            write_json(self.path / "stage.json", {**self._earlier, "sources": self._record["sources"]})
            return self._earlier["digest"]
        for leftover in self.path.rglob(f".*{_TEMPORARY_SUFFIX}"):
            leftover.unlink(missing_ok=True)
        digest = file_digest(paths, root=self.path)
        finished = {**self._record, "status": "complete", "digest": digest, "finished": _now()}
        write_json(self.path / "stage.json", finished)
        return digest


def open_stage(
    folder: str | Path,
    *,
    name: str,
    schema: int,
    config: Any,
    upstream: Mapping[str, str],
    sources: Mapping[str, Path] | None = None,
    formerly: Mapping[str, str] | None = None,
    overwrite: bool = False,
) -> Stage:
    """Open an output folder, new or to be continued.

    Args:
        name: of the stage, as in "registration".
        schema: number of the output's format; a change makes old output unusable.
        config: frozen dataclass of everything that decides the result (so not the number of workers).
        upstream: digest of each input, by name.
        sources: where the inputs lie, for later stages and for people. Inputs may be moved, so this decides nothing.
        formerly: an earlier `upstream` whose results still hold; a folder that was made from it is taken over.
        overwrite: start clean; deletes everything in the folder, if it is this stage's.
    Raises:
        InputError: the folder holds something else, or this stage made with other settings or from other inputs.
    """
    folder = Path(folder)
    record_path = folder / "stage.json"
    settings = {
        "stage": name,
        "schema": schema,
        "config": json.loads(json.dumps(config, default=_plain)),
        "upstream": dict(upstream),
    }
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: expected a folder to write to, found a file")
    existing = read_json(record_path) if record_path.exists() else None
    if existing is None and folder.is_dir() and not _is_blank(folder):
        raise InputError(f"{folder}: expected an empty folder or an earlier run of '{name}', found other files")
    if existing is not None and existing.get("stage") != name:
        raise InputError(f"{folder}: expected output of '{name}', found output of '{existing.get('stage')}'")

    if existing is not None and (overwrite or existing.get("status") == "discarded"):
        _discard(folder, existing)
        existing = None
    if existing is not None and formerly not in (None, upstream) and existing.get("upstream") == formerly:
        existing = {**existing, "upstream": settings["upstream"], "status": "taken over"}
    if existing is not None:
        changed = list(_differences(settings, existing))
        if changed:
            raise InputError(f"{folder}: was made with other settings ({'; '.join(changed[:3])}); use --overwrite")
        started = existing.get("started", _now())
    else:
        started = _now()
    places = {name: str(path.resolve()) for name, path in (sources or {}).items()}
    record = {**settings, "sources": places, "status": "running", "started": started}
    if existing is None or existing.get("status") != "running":
        write_json(record_path, record)
    return Stage(folder, record, existing if existing and existing.get("status") == "complete" else None)


def require_complete(folder: str | Path, name: str, command: str, *, made_from: Mapping[str, str] | None = None) -> str:
    """The digest of a finished stage.

    Args:
        made_from: digests of inputs that it has to have been made from, by name.
    Raises:
        InputError: it is missing, unfinished, or made from something else; the message names `command`, which repairs
            that.
    """
    folder = Path(folder)
    if not (folder / "stage.json").is_file():
        raise InputError(f"{folder}: expected the output of '{name}', found none; run: {command}")
    record = read_json(folder / "stage.json")
    if record.get("stage") != name:
        raise InputError(f"{folder}: expected the output of '{name}', found output of '{record.get('stage')}'")
    if record.get("status") != "complete":
        raise InputError(f"{folder}: '{name}' is not finished; run: {command}")
    for key, digest in (made_from or {}).items():
        if record.get("upstream", {}).get(key) != digest:
            raise InputError(
                f"{folder}: expected the output of '{name}' from this {key} as it is now, found that of another or of "
                f"an earlier state; run: {command} --overwrite"
            )
    return record["digest"]


def _differences(now: Any, before: Any, prefix: str = "") -> Iterator[str]:
    for key in now:
        label = f"{prefix}{key}"
        new, old = now[key], before.get(key) if isinstance(before, dict) else None
        if isinstance(new, dict) and isinstance(old, dict):
            yield from _differences({**dict.fromkeys(old), **new}, old, f"{label}.")
        elif new != old:
            yield f"{label}: was {_short(old)}, now {_short(new)}"


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:36]}..."


def _is_blank(folder: Path) -> bool:
    """Nothing in it but folders and the temporary files of a run that was killed before its first file."""
    return not any(path.is_file() and path.suffix != _TEMPORARY_SUFFIX for path in folder.rglob("*"))


def _discard(folder: Path, record: dict[str, Any]) -> None:
    """Empty a stage folder; if that is interrupted, the record left behind says to go on."""
    write_json(folder / "stage.json", {**record, "status": "discarded"})
    for path in folder.iterdir():
        if path.name == "stage.json":
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def _is_whole(path: Path) -> bool:
    """Atomic writes make existing files whole; this also catches what a lost disk or a careless copy cut off."""
    try:
        return zipfile.is_zipfile(path) if path.suffix == ".npz" else path.stat().st_size > 0
    except OSError:
        return False


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


# --- workers -----------------------------------------------------------------------------------------------------


class WorkerDied(RuntimeError):
    """A worker process ended without an answer: killed, or out of memory. Finished frames are on disk."""


def run_jobs(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    *,
    workers: int,
    label: str,
    units: Callable[[Job], int] | None = None,
    finished: Callable[[], int] | None = None,
) -> Iterator[Result]:
    """Run `function` on every job and yield the results as they come, with a progress bar on stderr.

    Args:
        function: importable by name, as are its jobs and results, for they travel to new processes.
        workers: processes; 1 runs the jobs here, in order. Each worker computes on one thread, so that results do not
            depend on how many there are.
        units: how much of the progress a job is worth, 1 each if None.
        finished: units done so far, read from disk once a second; for jobs that are worth many.
    Raises:
        WorkerDied: a worker was killed.
    """
    if not jobs:
        return
    total = sum(units(job) if units else 1 for job in jobs)
    with progress(label, total, finished) as advance:
        if workers <= 1 or len(jobs) <= 1:
            for job in jobs:
                result = function(job)
                advance(units(job) if units else 1)
                yield result
            return
        before = set(multiprocessing.active_children())
        pool = ProcessPoolExecutor(
            min(workers, len(jobs)), multiprocessing.get_context("spawn"), initializer=_start_worker
        )
        try:
            with _worker_environment():
                futures: dict[Future[Result], Job] = {pool.submit(function, job): job for job in jobs}
            for future in as_completed(futures):
                result = future.result()
                advance(units(futures[future]) if units else 1)
                yield result
        except BaseException as error:
            for worker in set(multiprocessing.active_children()) - before:
                worker.kill()  # files are whole or absent, so there is nothing to wait for
            if isinstance(error, BrokenProcessPool):
                raise WorkerDied(
                    f"{label}: a worker process was killed, perhaps for want of memory; finished frames are kept, "
                    "the same command goes on (with fewer --workers if memory is short)"
                ) from None
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


@contextlib.contextmanager
def _worker_environment() -> Iterator[None]:
    """Processes started meanwhile leave Ctrl-C to this one, and compute on one thread.

    Numerical libraries read these variables as they load; an ignored signal is inherited.
    """
    variables = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(dict.fromkeys(variables, "1"))
    on_main_thread = threading.current_thread() is threading.main_thread()
    answer = signal.signal(signal.SIGINT, signal.SIG_IGN) if on_main_thread else None
    try:
        yield
    finally:
        if on_main_thread:
            signal.signal(signal.SIGINT, answer)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _start_worker() -> None:
    """End with the parent, however it ends."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


@contextlib.contextmanager
def progress(
    label: str, total: int, finished: Callable[[], int] | None = None, *, completed: int = 0
) -> Iterator[Callable[[int], None]]:
    """A progress bar with the time left, on stderr; call what it yields with the units just done.

    Args:
        finished: units done so far, read from disk once a second, instead of calls.
        completed: units that were done before.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description:<24}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    stop = threading.Event()
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(label, total=total, completed=completed)
        before = finished() if finished else 0

        def poll() -> None:
            while finished and not stop.wait(1.0):
                bar.update(task, completed=min(finished() - before, total))

        poller = threading.Thread(target=poll, daemon=True)
        poller.start()
        try:
            yield lambda count: None if finished else bar.advance(task, count)
            bar.update(task, completed=total)
        finally:
            stop.set()
            poller.join()
