"""Settings that no take or scan can be made with are named before anything is made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from capture4d.cli.main import main
from capture4d.errors import InputError
from data_synth.config import PRESETS, TRAINING_SETS
from data_synth.setting_checks import check_synth


def test_every_preset_passes() -> None:
    for config in PRESETS.values():
        check_synth(config)
    for training_set in TRAINING_SETS.values():
        for config in training_set.takes.values():
            check_synth(config)


def test_the_sensor_decides_which_cameras_count() -> None:
    tiny = PRESETS["tiny"]
    few = replace(tiny.scanner, rig=replace(tiny.scanner.rig, cameras=2))
    check_synth(replace(tiny, scanner=replace(few, sensor="stereo")))
    with pytest.raises(InputError, match="cameras: expected at least 4, found 2"):
        check_synth(replace(tiny, scanner=few))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("synth", "--frames", "0"), "--frames: expected at least 1, found 0"),
        (("synth", "--capture-every", "0"), "--capture-every: expected at least 1, found 0"),
        (("synth", "--simulation.calm-frames", "0"), "--simulation.calm-frames: expected at least 1, found 0"),
        (("synth", "--scanner.rig.cameras", "3"), "--scanner.rig.cameras: expected at least 4, found 3"),
        (("synth", "--scanner", "stereo", "--scanner.stereo.pods", "2"), "--scanner.stereo.pods: expected at least 4"),
        (("synth", "--motion.bvh", "none.bvh"), "none.bvh: no such BVH file"),
        (("scan", "--step", "0"), "--step: expected at least 1, found 0"),
        (("scan", "--fps", "0"), "--fps: expected a positive number, found 0"),
        (("scan", "--frames", "0"), "--frames: expected at least 1, found 0"),
        (("scan", "--scanner.rig.cameras", "3"), "--scanner.rig.cameras: expected at least 4, found 3"),
        (("register-mesh",), "out.stl: expected a mesh file (.obj, .ply, .glb), found '.stl'"),
    ],
)
def test_one_line_and_nothing_is_written(
    options: tuple[str, ...],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    command, *settings = options
    inputs = {"synth": ["out"], "scan": ["meshes", "out"], "register-mesh": ["a.ply", "b.ply", "--output", "out.stl"]}
    with pytest.raises(SystemExit) as exit_:
        main([command, *inputs[command], *settings])
    error = capsys.readouterr().err.splitlines()
    assert exit_.value.code == 1
    assert len(error) == 1
    assert said in error[0]
    assert not list(tmp_path.iterdir())
