"""A long take in one process, with two, and on a Dask cluster that loses a worker: the same digests; and its seams.

The take is a small synthetic one, played to and fro. Its scans are links to a few files; every one is read and worked
through, for stages know a scan by its frame. With `--quick` a take of few frames is cut into short segments, and the
search for the first pose of each is spared by the poses that are known.

Limits this was built against: wall time with two processes 0.6 of that with one on an idle machine, joining adds 0.5 mm
to a frame's motion and 1 mm to the joints', memory does not grow with the frames.

Wall times mean something on an idle machine alone. `two_workers_efficiency` is the work of one process, CPU seconds,
over what two had time for; `machine_share` says how much of a core that one process was given: 1 if nobody else wants
any. With `--folder` all is kept, and a run that was interrupted goes on; the times of its parts are added up.
"""

from __future__ import annotations

import heapq
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
from rich.console import Console

from benchmarks.cached_takes import cached_take
from benchmarks.metric import Metric
from benchmarks.registered_work import QUICK_TAKE
from capture4d import pipeline
from capture4d.body.skinning import pose_frame, with_shape
from capture4d.captures.capture import Capture, read_capture, scan_path, write_capture_description
from capture4d.captures.segments import cut as cut_take
from capture4d.captures.work_folder import load_tracking
from capture4d.files.atomic import read_json, read_json_lines, write_json
from capture4d.files.records import load_poses, save_poses
from capture4d.runs.cluster.scheduler import use_scheduler
from capture4d.runs.processes.pool import kept_workers
from capture4d.tracking.config import TrackingConfig
from capture4d.types import PoseSequence
from registration.config import RegistrationConfig

STAGES = ("garment", "body", "registration")
CORES = 16
"""Of a machine, in the schedule."""
HOUR_FRAMES = 10_800


@dataclass(frozen=True, slots=True)
class Cut:
    """How a take is cut: frames of a segment, and those before it."""

    track: tuple[int, int]
    register: tuple[int, int]
    searches: bool


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a run has cost, and its digests."""

    digests: tuple[str, ...]
    wall_s: float
    cpu_s: float
    peak_mb: float


def run(*, quick: bool = False, frames: int = 2000, seed: int = 0, folder: Path | None = None) -> list[Metric]:
    """Track and register a long take three times.

    Args:
        quick: 40 frames, in three segments.
        frames: of the take; of fewer than 960 segments are shorter, so that there are four.
        seed: of the small take that it is made of.
        folder: where the runs are kept, and go on if they were interrupted; else they are made anew and removed.
    """
    count = 40 if quick else frames
    small = QUICK_TAKE if quick else replace(QUICK_TAKE, name="tiny-to-and-fro", frames=48, seed=seed)
    length = max(min(count // 4, 240), 32)
    cut = Cut((16, 8), (16, 8), False) if quick else Cut((length, 24), (length // 2, 24), True)
    take = read_capture(cached_take(small, workers=1))
    if folder is None:
        with tempfile.TemporaryDirectory(prefix="capture4d-long-") as scratch:
            return _measured(Path(scratch), take, count, cut)
    asked = {"frames": count, "seed": seed, "cut": json.loads(json.dumps(asdict(cut)))}
    if (folder / "asked.json").is_file() and read_json(folder / "asked.json") != asked:
        raise SystemExit(f"{folder}: expected the runs of {asked}, found those of {read_json(folder / 'asked.json')}")
    write_json(folder / "asked.json", asked)
    return _measured(folder, take, count, cut)


def _measured(folder: Path, take: Capture, count: int, cut: Cut) -> list[Metric]:
    console = Console(stderr=True)
    order = _to_and_fro(take, folder / "capture", count)
    one = _run(folder, "one", cut)
    console.print(f"one process: {one.wall_s:.0f} s, {one.cpu_s:.0f} CPU s")
    two = _run(folder, "two", cut, workers=2)
    console.print(f"two processes: {two.wall_s:.0f} s, {two.cpu_s:.0f} CPU s")
    lost, killed = _run_with_a_loss(folder, cut)
    console.print(f"cluster: {lost.wall_s:.0f} s, worker killed: {killed}")
    _to_and_fro(take, folder / "short" / "capture", count // 2)
    short = _run(folder / "short", "one", cut)
    same = [each.digests == one.digests for each in (two, lost)]
    return [
        Metric("frames", count, "", "higher"),
        Metric("same_digests", sum(same) / len(same), "", "higher"),
        Metric("workers_killed", killed, "", "higher"),
        Metric("two_workers_wall_ratio", two.wall_s / one.wall_s),
        Metric("two_workers_cpu_ratio", two.cpu_s / one.cpu_s),
        Metric("two_workers_efficiency", one.cpu_s / (2 * two.wall_s), "", "higher"),
        Metric("machine_share", one.cpu_s / one.wall_s, "", "higher"),
        Metric("one_process_cpu_s", one.cpu_s, "s"),
        *_seams(folder / "one", take, order),
        Metric("rss_growth_mb", one.peak_mb - short.peak_mb, "MB"),
        Metric("worked_through_share", _worked_through(folder / "one"), "", "higher"),
        *_schedule(_costs(folder / "one"), Cut((240, 24), (120, 24), True), console),
    ]


# --- the take ------------------------------------------------------------------------------------------------------


def _to_and_fro(take: Capture, folder: Path, count: int) -> np.ndarray:
    """Write a take that plays another to its end and back, again and again; row of the other for each frame."""
    ids = take.frame_ids
    there = np.arange(len(ids))
    order = np.resize(np.concatenate([there, there[-2:0:-1]]), count)
    if (folder / "capture.json").is_file():  # of a run that goes on
        return order
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "scans").mkdir(parents=True)
    for name in ("template.npz", "body.npz"):
        shutil.copyfile(take.path / name, folder / name)
    frame_ids = tuple(range(1, count + 1))
    for frame_id, row in zip(frame_ids, order, strict=True):
        source = scan_path(take, ids[row])
        _link(source, folder / "scans" / f"{frame_id:06d}{source.suffix}")
    assert take.poses is not None
    save_poses(folder / "poses.npz", _played(take.poses, order))
    write_capture_description(replace(take, path=folder, frame_ids=frame_ids))
    return order


def _played(poses: PoseSequence, order: np.ndarray) -> PoseSequence:
    frame_ids = np.arange(1, len(order) + 1, dtype=np.int32)
    return replace(poses, rotations=poses.rotations[order], translations=poses.translations[order], frame_ids=frame_ids)


def _link(source: Path, place: Path) -> None:
    try:
        os.link(source, place)
    except OSError:  # on another file system
        shutil.copyfile(source, place)


# --- runs ----------------------------------------------------------------------------------------------------------


def work_through(folder: Path, name: str, cut: Cut, workers: int, address: str | None) -> None:
    """Extract, track and register; what a child of the benchmark does."""
    capture, output = folder / "capture", folder / name
    tracking, registration = TrackingConfig(), RegistrationConfig()
    track = replace(tracking.sequence, segment=cut.track[0], overlap=cut.track[1])
    register = replace(registration.sequence, segment=cut.register[0], overlap=cut.register[1])
    start = "search" if cut.searches else str(capture / "poses.npz")
    threading.Thread(target=_end_with_parent, args=(os.getppid(),), daemon=True).start()
    took, begin = {}, time.process_time()
    with use_scheduler(address), kept_workers():
        pipeline.extract(capture, output, for_tracking=True, workers=workers)
        took["extract"] = time.process_time() - begin
        pipeline.track(capture, output, replace(tracking, sequence=track, start=start), workers=workers)
        config = replace(registration, sequence=register)
        pipeline.register(capture, output, config, tracked=True, workers=workers)
    if not (output / "took.json").is_file():
        write_json(output / "took.json", took)


def _end_with_parent(parent: int) -> None:
    """A run goes on where it was: with the next call of the benchmark, not beside it."""
    while os.getppid() == parent:
        time.sleep(1)
    os._exit(1)


def _start(folder: Path, name: str, cut: Cut, workers: int, address: str | None) -> subprocess.Popen[bytes]:
    call = (
        f"long.work_through({str(folder)!r} and Path({str(folder)!r}), {name!r}, long.{cut!r}, {workers}, {address!r})"
    )
    script = f"from pathlib import Path\nfrom benchmarks import long\nif __name__ == '__main__':\n    {call}\n"
    path = folder / f"{name}.py"
    path.write_text(script)
    environment = {**os.environ, "PYTHONPATH": _python_path(), **dict.fromkeys(THREADS, "1")}
    return subprocess.Popen([sys.executable, str(path)], stderr=(folder / f"{name}.log").open("wb"), env=environment)


THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def _python_path() -> str:
    return os.pathsep.join([str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")])


def _run(folder: Path, name: str, cut: Cut, *, workers: int = 1) -> Outcome:
    known = _known(folder, name)
    return known or _finished(_start(folder, name, cut, workers, None), folder / name)


def _known(folder: Path, name: str) -> Outcome | None:
    """What a run has come to that has ended in an earlier call."""
    path = folder / f"{name}-outcome.json"
    if not path.is_file():
        return None
    found = read_json(path)
    return Outcome(tuple(found.pop("digests")), **found)


def _finished(process: subprocess.Popen[bytes], output: Path) -> Outcome:
    """Wait for a run, and write down what it has taken: every few seconds, so that it may be interrupted."""
    parts, begin = output.with_name(f"{output.name}-parts.json"), time.perf_counter()
    before = read_json(parts) if parts.is_file() else {"wall_s": 0.0, "cpu_s": 0.0, "peak_mb": 0.0}
    noted = begin
    while not _has_ended(process):
        time.sleep(0.05)
        if time.perf_counter() > noted + 5:
            noted = time.perf_counter()
            so_far = {"wall_s": before["wall_s"] + noted - begin, "cpu_s": before["cpu_s"] + _cpu_of(process.pid)}
            write_json(parts, {**so_far, "peak_mb": before["peak_mb"]})
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{output.name}: {output.with_suffix('.log').read_text()[-2000:]}")
    outcome = Outcome(
        digests=tuple(read_json(output / stage / "stage.json")["digest"] for stage in STAGES),
        wall_s=before["wall_s"] + time.perf_counter() - begin,
        cpu_s=before["cpu_s"] + usage.ru_utime + usage.ru_stime,
        peak_mb=max(before["peak_mb"], usage.ru_maxrss / 1024),
    )
    write_json(output.with_name(f"{output.name}-outcome.json"), asdict(outcome))
    return outcome


def _cpu_of(process: int) -> float:
    """CPU seconds of a process and its children so far, those that have ended and those that run."""
    ticks, family = 0, {process}
    stats = {int(path.parent.name): path for path in Path("/proc").glob("[0-9]*/stat")}
    for number in sorted(stats):  # children have higher numbers, or else are missed until they end
        try:
            fields = stats[number].read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if number == process or int(fields[1]) in family:
            family.add(number)
            ticks += sum(int(each) for each in fields[11:15])
    return ticks / os.sysconf("SC_CLK_TCK")


def _run_with_a_loss(folder: Path, cut: Cut) -> tuple[Outcome, int]:
    """On a cluster, one of whose workers is killed once a third of the frames is registered."""
    from distributed import Client

    output, told = folder / "cluster", folder / "cluster-killed.json"
    known = _known(folder, "cluster")
    if known is not None:
        return known, int(told.is_file())
    with _cluster(folder) as address:
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(2)
            pids = cast(dict[str, int], client.run(os.getpid))
        process = _start(folder, "cluster", cut, 1, address)
        wanted = len(read_capture(folder / "capture").frame_ids) // 3

        def lose_one() -> None:
            while not told.is_file() and not _has_ended(process):
                if len(list((output / "registration").glob("*/*.npz"))) >= wanted:
                    write_json(told, {"killed": next(iter(pids.values()))})
                    os.kill(next(iter(pids.values())), signal.SIGKILL)
                time.sleep(0.05)

        watcher = threading.Thread(target=lose_one)
        watcher.start()
        try:
            outcome = _finished(process, output)
        finally:
            process.poll()
            watcher.join()
    return outcome, int(told.is_file())


def _has_ended(process: subprocess.Popen[bytes]) -> bool:
    return (
        process.returncode is not None
        or os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
    )


@contextmanager
def _cluster(folder: Path) -> Iterator[str]:
    """A scheduler and two workers, as a user would start them by hand."""
    told = folder / "scheduler.json"
    environment = {**os.environ, "PYTHONPATH": _python_path(), **dict.fromkeys(THREADS, "1")}
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--dashboard-address", ":0"]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--nthreads", "1", "--nworkers", "2"]
    with (folder / "dask.log").open("wb") as log:
        options = {"stdout": log, "stderr": log, "env": environment, "cwd": folder}
        processes = [subprocess.Popen([*command, "--scheduler-file", str(told)], **options)]
        try:
            while not told.is_file():
                time.sleep(0.1)
            options_of_workers = ["--scheduler-file", str(told), "--dashboard-address", ":0", "--memory-limit", "0"]
            processes.append(subprocess.Popen([*worker, *options_of_workers], **options))
            yield json.loads(told.read_text())["address"]
        finally:
            for process in reversed(processes):
                process.terminate()
                process.wait()


# --- what came out -------------------------------------------------------------------------------------------------


def _seams(work: Path, take: Capture, order: np.ndarray) -> list[Metric]:
    """What joining adds to the motion of cloth and joints, where it adds most."""
    vertices = np.load(work / "registration" / "vertices.npy", mmap_mode="r")
    jumps = [0.0]
    seams = sorted((work / "registration" / "seams").glob("*.json"))
    for at in (int(path.stem) - 1 for path in seams):
        tails, leads = (_strand(work / "registration" / folder, at, len(vertices)) for folder in ("tails", "leads"))
        for row in sorted(tails)[1:]:
            usual = [_moved(each[row], each[row - 1]) for each in (tails, leads) if row - 1 in each]
            jumps.append(_moved(vertices[row], vertices[row - 1]) - max(usual))
        if at - 1 in leads:
            usual = _moved(vertices[at], leads[at - 1])
            jumps.append(_moved(vertices[at], vertices[at - 1]) - usual)
    continued = [read_json(path)["continues"] for path in seams]
    return [
        Metric("seams", len(seams), "", "higher"),
        Metric("seams_continued", sum(continued)),
        Metric("seam_jump_mm", max(jumps), "mm"),
        Metric("seam_pose_mm", _pose_jump_mm(work, take, order), "mm"),
    ]


def _strand(folder: Path, before: int, count: int) -> dict[int, np.ndarray]:
    """A segment's version of the frames before a seam, by row."""
    found: dict[int, np.ndarray] = {}
    for row in range(max(before - count, 0), before):
        path = folder / f"{row + 1:06d}.npz"
        if path.is_file():
            with np.load(path) as arrays:
                found[row] = arrays["vertices"]
    return {row: each for row, each in found.items() if all(later in found for later in range(row, before))}


def _moved(now: np.ndarray, before: np.ndarray) -> float:
    return 1e3 * float(np.linalg.norm(now.astype(float) - before, axis=1).mean())


def _pose_jump_mm(work: Path, take: Capture, order: np.ndarray) -> float:
    """Error of the joints' motion from the frame before a seam to the one behind it, over what is usual elsewhere."""
    body, found = load_tracking(work / "body")
    truth = _played(load_poses(take.path / "truth" / "poses.npz"), order)
    here, there = with_shape(body, found.shape), with_shape(body, truth.shape)
    apart = np.stack(
        [
            pose_frame(here, found, row).joint_centres() - pose_frame(there, truth, row).joint_centres()
            for row in range(len(order))
        ]
    )
    errors = 1e3 * np.linalg.norm(np.diff(apart, axis=0), axis=2).mean(axis=1)
    seams = [int(path.stem) - 2 for path in (work / "body" / "seams").glob("*.json")]
    return float(max((errors[row] for row in seams), default=0.0) - np.median(errors))


def _costs(work: Path) -> Mapping[str, float]:
    """CPU seconds: of a frame in each step, and of the first frame of a segment.

    Extraction that was interrupted is counted as if the last part had been all of it.
    """
    tracked = read_json_lines(work / "body" / "metrics.jsonl")
    registered = read_json_lines(work / "registration" / "metrics.jsonl")
    times = [read_json(path)["cpu_s"] for path in sorted((work / "body" / "times").glob("*.json"))]
    both = [record["cpu_s"] for record in tracked]
    cut = [record["cpu_s"] for record in registered if "seam_mm" in record]
    whole = [record["cpu_s"] for record in registered if "seam_mm" not in record]
    return {
        "extract": read_json(work / "took.json")["extract"] / len(tracked),
        "follow": float(np.median(times)),
        "search": max(times),
        "refine": float(np.median(both) - np.median(times)),
        "register": float(np.median(whole)),
        "join": float(np.median(cut) - 2 * np.median(whole)) if cut else 0.0,
    }


def _worked_through(work: Path) -> float:
    """Share of the frames that have cost CPU time of their own in both stages: no link is answered from another."""
    records = [read_json_lines(work / stage / "metrics.jsonl") for stage in ("body", "registration")]
    return float(np.mean([record["cpu_s"] > 0.001 for stage in records for record in stage]))


def _schedule(costs: Mapping[str, float], cut: Cut, console: Console) -> list[Metric]:
    """Minutes for three minutes of footage at 60 Hz, from these costs: a step's jobs go in turn to the core that is
    free first; steps come one after the other."""
    segments = {
        name: cut_take(HOUR_FRAMES, *lengths) for name, lengths in (("track", cut.track), ("register", cut.register))
    }
    steps = {
        "extract": [costs["extract"]] * HOUR_FRAMES,
        "follow": [costs["search"] + (each.stop - each.lead) * costs["follow"] for each in segments["track"]],
        "refine": [costs["refine"]] * HOUR_FRAMES,
        "register": [(each.stop - each.lead) * costs["register"] for each in segments["register"]],
        "join": [16 * max(costs["join"], 0.0)] * (len(segments["register"]) - 1),
    }
    found = []
    for machines in (1, 4, 32):
        seconds = {name: makespan(jobs, machines * CORES) for name, jobs in steps.items()}
        told = ", ".join(f"{name} {each:.0f} s" for name, each in seconds.items())
        minutes = sum(seconds.values()) / 60
        console.print(f"{HOUR_FRAMES} frames on {machines} machines of {CORES} cores: {minutes:.1f} min ({told})")
        found.append(Metric(f"minutes_on_{machines}_machines", minutes, "min"))
    return found


def makespan(jobs: Iterable[float], cores: int) -> float:
    """When the last of some jobs is done, each begun, in their order, by the core that is free first (Graham 1966)."""
    free = [0.0] * cores
    for cost in jobs:
        heapq.heappush(free, heapq.heappop(free) + cost)
    return max(free)
