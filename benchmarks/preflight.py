"""Does `capture4d check` name every fault, and nothing on a sound take?

Plain takes (several bodies, clips, headings; walking; without painted borders; sampled sparsely; from head to toe) are
damaged in one way each. A fault is named if its finding is among the findings; a false alarm is any finding on a sound
take, and any finding on a damaged one that neither names nor follows from its fault. The margins are the weakest score
of a fault's own finding and the strongest score of any check on a sound take; a finding is a score above 1.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks import damaged_takes as damage
from benchmarks.metric import Metric
from benchmarks.plain_takes import COARSE_SCANNER, PlainTake, PlainTakeConfig, plain_take
from capture4d.body.anny import load_anny
from capture4d.mesh_files.meshes import write_mesh
from capture4d.preflight.check import check_take
from capture4d.preflight.findings import Code
from capture4d.preflight.repair.fix import write_fixed
from data_synth.config import MotionConfig
from data_synth.scanner.config import RigConfig

BODY_SCANNER = replace(COARSE_SCANNER, rig=RigConfig(cameras=40, image_size=512))
SUIT, YELLOW = (150, 152, 156), (255, 196, 0)

BASES: dict[str, PlainTakeConfig] = {
    "reach": PlainTakeConfig(),
    "twist": PlainTakeConfig(seed=1, body_shape=(1.5, -1.0), motion=MotionConfig(clip="twist", skip_frames=10)),
    "side-bend": PlainTakeConfig(seed=9, body_shape=(-0.5, 0.5), motion=MotionConfig(clip="side-bend"), step=8),
    "range-of-motion": PlainTakeConfig(
        seed=2, body_shape=(-1.5, 1.5), motion=MotionConfig(clip="range-of-motion", skip_frames=10), step=6
    ),
    "sampled": PlainTakeConfig(
        seed=3, body_shape=(0.5, 2.0), motion=MotionConfig(clip="sampled", skip_frames=30), step=5, heading_deg=70
    ),
    "walking": PlainTakeConfig(
        seed=4,
        motion=MotionConfig(clip="side-bend", skip_frames=20),
        walk_m=(0.5, 0.7),
        turn_deg=60,
        heading_deg=-150,
        step=8,
        whole_body=True,
        scanner=BODY_SCANNER,
    ),
    "no-borders": PlainTakeConfig(
        seed=5, border_colour=None, body_shape=(-1, -1), motion=MotionConfig(clip="twist", skip_frames=40)
    ),
    "sparse": PlainTakeConfig(
        seed=6,
        motion=MotionConfig(clip="side-bend"),
        frames=10,
        step=15,
        number_step=15,
        garment_colour=(190, 60, 50),
        border_colour=(40, 190, 90),
    ),
    "whole-body": PlainTakeConfig(
        seed=7,
        body_shape=(2, 0),
        motion=MotionConfig(clip="reach", skip_frames=10),
        garment_colour=(60, 120, 70),
        border_colour=(230, 60, 160),
        whole_body=True,
        scanner=BODY_SCANNER,
    ),
}
WALKS_OUT = PlainTakeConfig(seed=8, walk_m=(1.1, 0.1), rig_follows_walk=False, step=5)
QUICK = ("reach", "range-of-motion", "whole-body")

FOLLOWS: dict[Code, set[Code]] = {
    "frame-empty": {"frames-missing"},
}
"""What may be reported beside a fault because it follows from it."""


@dataclass(frozen=True, slots=True)
class _Fault:
    name: str
    code: Code
    damage: Callable[[PlainTake], PlainTake]
    bases: tuple[str, ...] = ("reach", "twist")
    """The quick benchmark takes the first one that it has."""


def _move(factor: float) -> np.ndarray:
    return factor * np.eye(3)


def _bare(take: PlainTake) -> PlainTake:
    return damage.without_companions(take)


def _mid(take: PlainTake) -> int:
    numbers = list(take.scans)
    return numbers[len(numbers) // 2]


MIRROR, X_UP = np.diag([-1.0, 1, 1]), np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
PALE_BLUE, SKIN_LIKE = (90, 130, 215), (216, 160, 128)

FAULTS = (
    _Fault("millimetres", "units", lambda t: damage.move_scans(t, _move(1000.0))),
    _Fault("centimetres, no companions", "units", lambda t: damage.move_scans(_bare(t), _move(100.0))),
    _Fault(
        "inches said to be centimetres",
        "units",
        lambda t: replace(damage.move_scans(_bare(t), _move(1 / 0.0254)), units="cm"),
        ("range-of-motion", "twist", "whole-body"),
    ),
    _Fault("metres said to be millimetres", "units", lambda t: replace(t, units="mm")),
    _Fault("Z up", "axes", damage.turned),
    _Fault(
        "Z up, no companions", "axes", lambda t: _bare(damage.turned(t)), ("range-of-motion", "sampled", "whole-body")
    ),
    _Fault("X up", "axes", lambda t: damage.move_scans(t, X_UP)),
    _Fault("upside down, no companions", "axes", lambda t: damage.move_scans(_bare(t), np.diag([1.0, -1, -1]))),
    _Fault("mirrored", "mirrored", lambda t: damage.move_scans(t, MIRROR), ("reach", "side-bend", "sampled")),
    _Fault(
        "mirrored, faces too",
        "mirrored",
        lambda t: damage.flip_faces(damage.move_scans(t, MIRROR)),
        ("reach", "side-bend", "walking"),
    ),
    _Fault("inside out", "winding", damage.flip_faces, ("reach", "range-of-motion")),
    _Fault("inside out, no companions", "winding", lambda t: damage.flip_faces(_bare(t)), ("whole-body", "sampled")),
    _Fault("floor 0.3 m up", "floor", lambda t: damage.move_scans(t, np.eye(3), (0, 0.3, 0))),
    _Fault(
        "floor 0.25 m down, no companions",
        "floor",
        lambda t: damage.move_scans(_bare(t), np.eye(3), (0, -0.25, 0)),
        ("whole-body", "walking"),
    ),
    _Fault(
        "origin in the middle, no companions", "floor", lambda t: damage.move_scans(_bare(t), np.eye(3), (0, -1.2, 0))
    ),
    _Fault("empty frame", "frame-empty", lambda t: damage.empty_frame(t, _mid(t))),
    _Fault("empty file", "frame-empty", lambda t: replace(t, files={f"scans/{_mid(t):06d}.ply": b""})),
    _Fault("truncated frame", "frame-unreadable", lambda t: damage.truncated_frame(t, _mid(t))),
    _Fault("NaN", "frame-nan", lambda t: damage.nan_frame(t, _mid(t))),
    _Fault("half a frame", "frame-partial", lambda t: damage.partial_frame(t, _mid(t))),
    _Fault("repeated frame", "frame-repeated", lambda t: damage.repeat_frame(t, _mid(t))),
    _Fault("missing frames", "frames-missing", lambda t: damage.drop_frames(t, {_mid(t)}), ("reach", "sparse")),
    _Fault("number used twice", "frames-duplicated", lambda t: damage.duplicate_number(t, _mid(t), list(t.scans)[-1])),
    _Fault("frame 10 % larger", "scale-jump", lambda t: damage.scaled_frame(t, _mid(t), 1.1)),
    _Fault("frame 8 % smaller", "scale-jump", lambda t: damage.scaled_frame(_bare(t), _mid(t), 0.92)),
    _Fault(
        "rate 8 times too high",
        "fps",
        lambda t: damage.with_rate(t, 8.0, poses=True),
        ("range-of-motion", "walking", "sparse"),
    ),
    _Fault(
        "rate 20 times too low",
        "fps",
        lambda t: damage.with_rate(_bare(t), 0.05, poses=True),
        ("range-of-motion", "walking", "sampled"),
    ),
    _Fault("half the rate of the motion capture", "fps", lambda t: damage.with_rate(t, 0.5, poses=False)),
    _Fault("no colours", "colours-missing", damage.colourless),
    _Fault("one grey", "colours-missing", lambda t: damage.bad_colours(t, share=0.0)),
    _Fault("pale", "colours-washed-out", lambda t: damage.bad_colours(t, share=0.3), ("whole-body", "reach")),
    _Fault("overexposed", "colours-washed-out", lambda t: damage.bad_colours(t, share=0.25, level=300.0)),
    _Fault("another garment colour", "garment-absent", lambda t: damage.garment_paint(t, garment=(40, 160, 60))),
    _Fault("unpainted border", "border-absent", lambda t: damage.garment_paint(t, border=(230, 40, 200))),
    _Fault(
        "border nearly the garment's colour",
        "border-not-separable",
        lambda t: damage.garment_paint(damage.recoloured(t, YELLOW, PALE_BLUE, 60), border=PALE_BLUE),
    ),
    _Fault("suit of the border's colour", "border-on-body", lambda t: damage.recoloured(t, SUIT, (214, 165, 12))),
    _Fault(
        "border of the skin's colour",
        "border-on-body",
        lambda t: damage.garment_paint(damage.recoloured(t, YELLOW, SKIN_LIKE, 60), border=SKIN_LIKE),
    ),
    _Fault("walks out", "outside-volume", lambda t: t, ("walks-out",)),
    _Fault("walks out, no companions", "outside-volume", _bare, ("walks-out",)),
    _Fault(
        "beside the rig",
        "outside-volume",
        lambda t: damage.other_poses(damage.move_scans(t, np.eye(3), (2.5, 0, 0)), shift=(2.5, 0, 0)),
    ),
    _Fault(
        "a metre beside the rig, no poses",
        "outside-volume",
        lambda t: replace(damage.move_scans(t, np.eye(3), (-0.6, 0, 0.8)), poses=None, body=None),
        ("range-of-motion", "side-bend"),
    ),
    _Fault("noise of 0.4 spacings", "noise", lambda t: damage.noisy(t, 0.4)),
    _Fault("riddled with holes", "holes", lambda t: damage.punctured(t, 220, 0.025), ("reach", "whole-body")),
    _Fault(
        "poses late by three frames", "poses-mismatch", lambda t: damage.other_poses(t, late=3), ("range-of-motion",)
    ),
    _Fault("poses 0.1 m beside", "poses-mismatch", lambda t: damage.other_poses(t, shift=(0.07, 0, 0.07))),
    _Fault("poses of somebody else", "poses-mismatch", lambda t: damage.other_poses(t, shape=(-2.0, 2.0))),
    _Fault(
        "poses of somebody taller",
        "poses-mismatch",
        lambda t: damage.other_poses(t, shape=(1.5, -1.0, 1.0)),
        ("range-of-motion", "sampled", "no-borders"),
    ),
    _Fault(
        "poses of some frames",
        "poses-missing",
        lambda t: replace(t, poses=_first_poses(t, len(t.scans) - 2)),
    ),
)


def _first_poses(take: PlainTake, count: int):
    assert take.poses is not None
    poses = take.poses
    return replace(
        poses,
        rotations=poses.rotations[:count],
        translations=poses.translations[:count],
        frame_ids=poses.frame_ids[:count],
    )


@dataclass(frozen=True, slots=True)
class _Row:
    take: str
    expected: Code | None
    found: tuple[str, ...]
    own_score: float
    """Of the finding that names the fault; of the strongest check on a sound take."""
    strongest: str = ""


def run(*, quick: bool = False, memory_frames: int = 80) -> list[Metric]:
    """Check sound and damaged takes.

    Args:
        quick: fewer and shorter base takes, each fault once.
        memory_frames: length of the long stream whose memory is compared with that of a stream a tenth as long.
    """
    console = Console(stderr=True)
    rows: list[_Row] = []
    fixed = repaired = 0
    bases = _bases(quick)
    with tempfile.TemporaryDirectory(prefix="capture4d-preflight-") as scratch:
        for name, expected, take in _takes(bases, quick):
            folder = damage.write_take(take, Path(scratch) / f"take{len(rows)}")
            checked = check_take(folder)
            verdict = checked.verdict
            found = tuple(dict.fromkeys(finding.code for finding in verdict.findings))
            strongest = max(verdict.scores, key=lambda code: verdict.scores[code])
            score = verdict.scores.get(expected, 0.0) if expected else verdict.scores[strongest]
            rows.append(_Row(name, expected, found, score, strongest))
            console.print(f"{name}: {', '.join(found) or 'clean'} ({score:.2g})", highlight=False)
            if expected in REPAIRED and expected in found:
                fixed += 1
                repaired += not check_take(write_fixed(checked).path, all_frames=True).verdict.findings
        growth = _memory_growth(Path(scratch), next(iter(bases.values())), 24 if quick else memory_frames)
    _print_rows(rows)
    damaged = [row for row in rows if row.expected]
    sound = [row for row in rows if not row.expected]
    named = [row.expected in row.found for row in damaged]
    measured = [row.own_score for row in damaged if row.own_score < 10]
    extra = [set(row.found) - {row.expected} - FOLLOWS.get(row.expected, set()) for row in damaged if row.expected]
    return [
        Metric("takes", float(len(rows)), "", "higher"),
        Metric("damaged_takes", float(len(damaged)), "", "higher"),
        Metric("faults_named_percent", 100 * float(np.mean(named)), "%", "higher"),
        Metric("false_alarms", float(sum(len(row.found) for row in sound))),
        Metric("side_findings", float(sum(map(len, extra)))),
        Metric("weakest_fault_score", min(measured), "", "higher"),
        Metric("strongest_sound_score", max(row.own_score for row in sound)),
        Metric("fixed_and_clean_percent", 100 * repaired / max(fixed, 1), "%", "higher"),
        Metric("constant_memory_mb", growth, "MB"),
    ]


REPAIRED: set[Code | None] = {"units", "axes", "mirrored", "winding", "frame-nan", "scale-jump", "frames-missing"}
"""Faults after whose repair a take has to be clean."""


def _bases(quick: bool) -> dict[str, PlainTake]:
    body = load_anny()
    chosen = {**BASES, "walks-out": WALKS_OUT}
    if quick:
        chosen = {name: replace(chosen[name], frames=8) for name in (*QUICK, "walks-out")}
        chosen["walks-out"] = replace(WALKS_OUT, frames=8, step=8)
    return {name: plain_take(replace(config, name=name), body) for name, config in chosen.items()}


def _takes(bases: dict[str, PlainTake], quick: bool) -> Iterator[tuple[str, Code | None, PlainTake]]:
    for name, take in bases.items():
        if name != "walks-out":
            yield f"sound: {name}", None, take
            yield f"sound: {name}, no companions", None, _bare(take)
    for fault in FAULTS:
        here = [name for name in fault.bases if name in bases]
        for name in here[:1] if quick else here:
            yield f"{fault.name}: {name}", fault.code, fault.damage(bases[name])


def _print_rows(rows: list[_Row]) -> None:
    table = Table("take", "expected", "found", title="preflight", title_justify="left")
    table.add_column("score", justify="right")
    for row in rows:
        score = f"{row.own_score:.2f}" + ("" if row.expected else f" ({row.strongest})")
        good = row.expected in row.found if row.expected else not row.found
        found = ", ".join(row.found) or "-"
        table.add_row(row.take, row.expected or "-", found if good else f"[red]{found}", score)
    Console().print(table)


PEAK_SCRIPT = """
import sys
from pathlib import Path
from benchmarks.memory import peak_rss_mb
from capture4d.preflight.check import check_take
check_take(Path(sys.argv[1]), all_frames=True)
print(peak_rss_mb())
"""


def _memory_growth(scratch: Path, take: PlainTake, frames: int) -> float:
    """Peak memory of checking all of a long stream of dense scans over that of a stream a tenth as long, MB."""
    import trimesh

    scans = list(take.scans.values())[:4]
    dense = []
    for scan in scans:
        vertices, faces = trimesh.remesh.subdivide(scan.mesh.vertices, scan.mesh.faces)[:2]
        mesh = type(scan.mesh)(np.asarray(vertices, np.float32), np.asarray(faces, np.int32))
        colours = np.zeros((len(mesh.vertices), 3), np.uint8)
        colours[: len(scan.colours)] = scan.colours
        dense.append((mesh, colours))
    peaks = []
    for count in (max(frames // 10, 4), frames):
        folder = scratch / f"stream{count}"
        for number in range(count):
            mesh, colours = dense[number % len(dense)]
            write_mesh(folder / f"{number:06d}.ply", mesh, colours=colours)
        done = subprocess.run(
            [sys.executable, "-c", PEAK_SCRIPT, str(folder)], check=True, capture_output=True, text=True
        )
        peaks.append(float(done.stdout.split()[-1]))
    return peaks[1] - peaks[0]
