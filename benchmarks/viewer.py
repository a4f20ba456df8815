"""`capture4d view` on a long take: how long it takes to open, to jump to any frame, and how much memory it holds.

The take is made up: its frames are links to a few scans, registrations and records. The page is served, and nobody
looks at it: what a browser takes is the browser's.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.memory import peak_rss_mb
from benchmarks.metric import Metric
from capture4d.app.viewer.page import ViewerPage
from capture4d.app.viewer.presenter import Presenter
from capture4d.app.viewer.scenery import open_server
from capture4d.app.viewer.take import LAYERS, open_take
from capture4d.captures.capture import Capture, write_capture_description, write_scan
from capture4d.captures.work_folder import REGISTER
from capture4d.files.atomic import write_json_lines, write_npz
from capture4d.files.records import save_garment
from capture4d.runs.stage import open_stage
from capture4d.types import Garment, Mesh, Scan

DIFFERENT = 4
JUMPS = 40


def run(*, quick: bool = False, frames: int = 10_000, vertices: int = 200_000, seed: int = 0) -> list[Metric]:
    """Jump about in a long take.

    Args:
        quick: a twentieth of the frames, of a tenth of the vertices.
        frames: of the take.
        vertices: of a scan.
        seed: of the frames that are jumped to.
    """
    count, size = (frames // 20, vertices // 10) if quick else (frames, vertices)
    with tempfile.TemporaryDirectory(prefix="capture4d-viewer-") as scratch:
        work = Path(scratch) / "work"
        write_long_work(work, count, size)
        script = f"from benchmarks.viewer import serve; serve({str(work)!r}, {seed})"
        done = subprocess.run([sys.executable, "-c", script], check=True, stdout=subprocess.PIPE, text=True)
    found = json.loads(done.stdout.splitlines()[-1])
    return [Metric("frames", count, "", "higher"), *(Metric(key, value, key.rpartition("_")[2]) for key, value in
            found.items())]  # fmt: skip


def serve(work: str, seed: int) -> None:
    """Serve a page, jump about, and print what that took as JSON."""
    rng = np.random.default_rng(seed)
    begun = time.monotonic()
    presenter = Presenter([open_take(Path(work))], 128)
    with contextlib.redirect_stdout(sys.stderr):  # viser says where it listens
        server = open_server("127.0.0.1", 8399, "benchmark")
    page = ViewerPage(server, presenter, look_every_s=1.0)
    page.wait_until_shown()
    opened_s = time.monotonic() - begun
    page.choose(layers=frozenset(LAYERS))
    page.wait_until_shown()
    jumps = rng.choice(presenter.frame_ids, JUMPS, replace=False).tolist()
    times: list[list[float]] = []
    cpu: list[float] = []
    for _ in range(2):  # previews are made; previews are there
        presenter.forget()
        seconds, before = [], time.process_time()
        for frame_id in jumps:
            asked = time.monotonic()
            page.go_to(frame_id)
            page.wait_until_shown()
            seconds.append(time.monotonic() - asked)
        times.append(seconds)
        cpu.append((time.process_time() - before) / len(jumps))
    begun = time.process_time()
    presenter.look()
    look_s = time.process_time() - begun
    page.close()
    server.stop()
    found = {
        "open_s": opened_s, "jump_first_max_s": max(times[0]), "jump_first_cpu_s": cpu[0],
        "jump_again_max_s": max(times[1]), "jump_again_cpu_s": cpu[1], "look_cpu_s": look_s, "peak_mb": peak_rss_mb(),
    }  # fmt: skip
    print(json.dumps(found))


def write_long_work(work: Path, frames: int, vertices: int) -> None:
    """A work folder with its capture inside, both of links."""
    scans = work / "capture" / "scans"
    along = max(int(np.sqrt(vertices / 2)), 4)
    around = vertices // along
    rng = np.random.default_rng(1)
    capture = Capture(work / "capture", "long", 60.0, tuple(range(1, frames + 1)), (47, 98, 201), {})
    stage = open_stage(work / "registration", name=REGISTER, schema=5, config={}, upstream={})
    template = _tube(50, 100)
    save_garment(stage.path / "garment.npz", Garment(template))
    for frame_id in range(1, min(frames, DIFFERENT) + 1):
        mesh = _tube(around, along)
        noisy = mesh.vertices + 0.0005 * rng.standard_normal(mesh.vertices.shape) + (0.02 * frame_id, 0, 0)
        colours = rng.integers(0, 256, noisy.shape).astype(np.uint8)
        scan = Scan(mesh.with_vertices(noisy.astype(np.float32)), colours, frame_id, 0.0)
        write_scan(scans / f"{frame_id:06d}.ply", scan)
        moved = (template.vertices + np.array([0.02 * frame_id, 0, 0])).astype(np.float32)
        residual = np.abs(rng.standard_normal(len(moved)) * 0.001).astype(np.float32)
        write_npz(stage.frame_path(frame_id), vertices=moved, residual_m=residual, verdict=np.uint8(0))
    for frame_id in range(DIFFERENT + 1, frames + 1):
        first = (frame_id - 1) % DIFFERENT + 1
        _link(scans / f"{first:06d}.ply", scans / f"{frame_id:06d}.ply")
        _link(stage.frame_path(first), stage.frame_path(frame_id))
    records = ({"frame_id": frame_id, "verdict": "good", "reasons": [], "fit_mean_mm": 0.1 * (frame_id % 7)}
               for frame_id in capture.frame_ids)  # fmt: skip
    write_json_lines(stage.path / "metrics.jsonl", records)
    write_capture_description(capture)
    stage.finish([stage.path / "metrics.jsonl"])


def _link(source: Path, place: Path) -> None:
    try:
        os.link(source, place)
    except OSError:  # a file has so many names, or the disk knows none but one
        shutil.copyfile(source, place)


def _tube(around: int, along: int) -> Mesh:
    angle = np.tile(2 * np.pi * np.arange(around) / around, along)
    height = np.repeat(np.linspace(0, 1.6, along), around)
    at = np.arange(around * (along - 1)).reshape(along - 1, around)
    beside = np.roll(at, -1, axis=1)
    lower = np.stack([at, beside, at + around], axis=-1).reshape(-1, 3)
    upper = np.stack([beside, beside + around, at + around], axis=-1).reshape(-1, 3)
    points = np.stack([0.25 * np.sin(angle), height, 0.25 * np.cos(angle)], axis=1)
    return Mesh(points.astype(np.float32), np.concatenate([lower, upper]).astype(np.int32))
