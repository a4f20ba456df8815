"""A setting out of range is one line that names the option as it was typed, before anything is read or made."""

from __future__ import annotations

from pathlib import Path

import pytest

from capture4d.cli.main import main
from tests.command_line import fails

INPUTS = {
    "register": ("no-capture", "--output", "out"),
    "run": ("no-capture", "--output", "out"),
    "synth": ("out",),
    "scan": ("no-meshes", "out"),
    "fit": ("no-work",),
    "animate": ("no-model", "--poses", "no-poses.npz", "--output", "out"),
    "check": ("no-capture",),
    "compare": ("no-work", "--model", "no-model"),
    "wrinkles offsets": ("no-work",),
    "offsets train": ("no-drapes", "--output", "out"),
    "convert-poses": ("no.bvh", "out.npz"),
    "register-mesh": ("no.ply", "no.ply", "--output", "out.ply"),
}
SAME = "--registration.coarse.compression 2 --registration.dense.compression"  # two classes, one field name each


@pytest.mark.parametrize(
    ("command", "options", "said"),
    [
        ("register", "--registration.graph.nodes -3", "--registration.graph.nodes: expected at least 1, found -3"),
        ("register", "--registration.graph.nodes=-3", "--registration.graph.nodes: expected at least 1, found -3"),
        (
            "register",
            "--registration.dense.cold.steps -2",
            "--registration.dense.cold.steps: expected at least 0, found -2",
        ),
        (
            "register",
            "--registration.sequence.segment -5",
            "--registration.sequence.segment: expected at least 1, found -5",
        ),
        (
            "register",
            "--registration.data.robust-scale 0",
            "--registration.data.robust-scale: expected a positive number, found 0",
        ),
        (
            "register",
            "--registration.graph.nodes-per-vertex 0",
            "--registration.graph.nodes-per-vertex: expected at least 1, found 0",
        ),
        (
            "register",
            "--registration.graph.nodes_per_vertex 0",
            "--registration.graph.nodes_per_vertex: expected at least 1, found 0",
        ),
        (
            "register",
            "--preset paper --registration.coarse.warm.steps -1",
            "--registration.coarse.warm.steps: expected at least 0, found -1",
        ),
        (
            "register",
            "--registration.coarse.cold.gate 0.1 -0.1",
            "--registration.coarse.cold.gate: expected a positive number, found -0.1",
        ),
        (
            "register",
            "--registration.coarse.cold.gate 0.1 nan",
            "--registration.coarse.cold.gate: expected a finite number, found nan",
        ),
        ("register", f"{SAME} -1", "--registration.dense.compression: expected at least 0, found -1"),
        ("register", "--workers 0", "--workers: expected at least 1, found 0"),
        ("run", "--registration.graph.nodes 0", "--registration.graph.nodes: expected at least 1, found 0"),
        ("run", "--tracking.fit.normal-cosine 2", "--tracking.fit.normal-cosine: expected from -1 to 1, found 2"),
        ("synth", "--frames 0", "--frames: expected at least 1, found 0"),
        ("synth", "--capture-every 0", "--capture-every: expected at least 1, found 0"),
        ("synth", "--simulation.calm-frames 0", "--simulation.calm-frames: expected at least 1, found 0"),
        ("synth", "--scanner.rig.cameras 3", "--scanner.rig.cameras: expected at least 4, found 3"),
        ("synth", "--scanner stereo --scanner.stereo.pods 2", "--scanner.stereo.pods: expected at least 4, found 2"),
        ("synth", "--motion.bvh none.bvh", "none.bvh: no such BVH file"),
        ("scan", "--step 0", "--step: expected at least 1, found 0"),
        ("scan", "--fps 0", "--fps: expected a positive number, found 0"),
        ("scan", "--frames 0", "--frames: expected at least 1, found 0"),
        ("scan", "--scanner.rig.cameras 3", "--scanner.rig.cameras: expected at least 4, found 3"),
        ("fit", "--kernel.ridges", "--kernel.ridges: expected at least one value, found none"),
        ("fit", "--kernel.ridges 1 0", "--kernel.ridges: expected a positive number, found 0"),
        ("fit", "--kernel.control.history 2", "--kernel.control.history: expected 0, for kernels carry nothing on"),
        ("animate", "--beta nan", "--beta: expected a finite number, found nan"),
        ("wrinkles offsets", "--texels 48", "--texels: expected a power of two, found 48"),
        ("offsets train", "--patch.texels 81", "--patch.texels: expected a multiple of 8, found 81"),
        ("offsets train", "--residual --partner", "--partner: expected one of residual and partner, found True"),
        ("check", "--workers 0", "--workers: expected at least 1, found 0"),
        ("check", "--fps -1", "--fps: expected a positive number, found -1"),
        ("convert-poses", "--fps 0", "--fps: expected a positive number, found 0"),
        ("register-mesh", "--registration.graph.nodes 0", "--registration.graph.nodes: expected at least 1, found 0"),
    ],
)
def test_one_line_and_nothing_is_written(
    command: str,
    options: str,
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.chdir(tmp_path)
    assert fails(capsys, *command.split(), *INPUTS[command], *options.split()).startswith(said)
    assert not list(tmp_path.iterdir())


def test_a_mesh_file_that_cannot_be_written_is_named_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_:
        main(["register-mesh", "a.ply", "b.ply", "--output", "out.stl"])
    assert exit_.value.code == 1
    assert "out.stl: expected a mesh file (.obj, .ply, .glb, .off), found '.stl'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
