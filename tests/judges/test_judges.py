"""Exports opened in real clients: Blender, three.js in Chromium, Khronos' validator. Skipped where these are absent.

CAPTURE4D_BLENDER=/path/to/python-with-bpy NODE_MODULES=/path/to/node_modules pytest tests/judges -m slow
"""

import os
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture4d.body.skinning import pose_frame, with_shape
from capture4d.captures.capture import Capture, write_capture_description, write_scan
from capture4d.cli.exit_codes import GOOD
from capture4d.files.atomic import read_json, write_json
from capture4d.files.records import load_body, load_poses
from capture4d.types import Mesh, Scan
from tests.command_line import run
from tests.moving_garment import cloth, write_moving_work

HERE = Path(__file__).parent
BLENDER, MODULES = os.environ.get("CAPTURE4D_BLENDER"), os.environ.get("NODE_MODULES")
CHROMIUM = os.environ.get("CHROMIUM", "/usr/bin/chromium")
CANNOT_READ = 2

pytestmark = pytest.mark.slow
needs_blender = pytest.mark.skipif(
    BLENDER is None, reason="CAPTURE4D_BLENDER names no Python with bpy: Blender is not asked"
)
needs_browser = pytest.mark.skipif(
    MODULES is None or shutil.which("node") is None or not Path(CHROMIUM).exists(),
    reason="NODE_MODULES names no three, gltf-validator and playwright-core, or there is no Chromium: it is not asked",
)


@pytest.fixture(scope="module", params=[(25.0, 1), (59.94, 4801)], ids=["25fps", "59.94fps"])
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float, int]:
    fps, first = request.param
    folder = tmp_path_factory.mktemp("judged")
    vertices = write_moving_work(folder / "work", 36, seed=first, fps=fps, first=first, maps=8)
    np.save(folder / "vertices.npy", vertices)
    assert run("export", folder / "work", "--all", "--quiet") == GOOD
    return folder, fps, first


def judged(*arguments: object) -> None:
    done = subprocess.run([str(each) for each in arguments], capture_output=True, text=True, check=False)
    if done.returncode == CANNOT_READ:
        pytest.skip(done.stdout.strip().splitlines()[-1])
    assert done.returncode == 0, (
        "\n".join(line for line in done.stdout.splitlines() if "MISMATCH" in line) or done.stderr
    )


@needs_blender
@pytest.mark.parametrize("kind", ["usdc", "abc", "pc2", "mdd", "glb"])
def test_blender_shows_what_was_exported(kind: str, exported: tuple[Path, float, int]):
    folder, fps, first = exported
    exports = folder / "work" / "exports"
    file, tolerance, more = exports / f"garment.{kind}", 0.001, []
    if not file.is_file():
        pytest.skip(f"no {kind}: its package is not installed")
    match kind:
        case "usdc":
            more = ["--normals-p99-deg", 0.1, "--normal-map", "static"]
            more += ["--normal-file", exports / "normals" / f"{first:06d}.png"]
        case "abc":
            more = ["--normals-p99-deg", 0.1]
        case "glb":
            if fps != int(fps):
                pytest.skip("Blender puts keys of a GLB elsewhere at such a rate, but for the script")
            first, more = 0, ["--normal-map", "static"]
            tolerance = read_json(exports / "export.json")["files"]["glb"]["error_mm"] + 0.002
        case _:
            more = ["--base", exports / "garment.obj"]
    template = folder / "work" / "registration" / "garment.npz"
    judged(
        BLENDER, HERE / "check_in_blender.py", file, folder / "vertices.npy", "--fps", fps, "--first-frame", first,
        "--template", template, "--tolerance-mm", tolerance, *more,
    )  # fmt: skip


@needs_blender
@pytest.mark.parametrize("kind", ["usdc", "abc", "pc2", "glb"])
def test_the_script_sets_rate_range_and_maps(kind: str, exported: tuple[Path, float, int]):
    folder, fps, _ = exported
    exports = folder / "work" / "exports"
    if not (exports / f"garment.{kind}").is_file():
        pytest.skip(f"no {kind}: its package is not installed")
    script, vertices = exports / "open_in_blender.py", folder / "vertices.npy"
    judged(BLENDER, HERE / "check_opened.py", script, vertices, fps, f"garment.{kind}")


@pytest.fixture(scope="module")
def gathered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every fifth frame of a take, with a picture of its colours, maps, body and scans. A scan has the garment's
    vertices, and the row of its frame as red."""
    folder = tmp_path_factory.mktemp("gathered")
    work, frames = folder / "work", range(3, 43, 5)
    vertices, faces = write_moving_work(work, len(frames), first=3, step=5, maps=8), cloth().faces
    np.save(folder / "vertices.npy", vertices)
    body, poses = load_body(work / "body" / "body.npz"), load_poses(work / "body" / "poses.npz")
    person = with_shape(body, poses.shape)
    np.save(folder / "body.npy", [pose_frame(person, poses, row).vertices() for row in range(len(frames))])
    capture = Capture(folder / "capture", "limb", 25.0, tuple(frames), None, {})
    for row, frame_id in enumerate(frames):
        colours = np.full((vertices.shape[1], 3), row, np.uint8)
        scan = Scan(Mesh(vertices[row], faces), colours, frame_id, capture.time_s(frame_id))
        write_scan(capture.path / "scans" / f"{frame_id:06d}.ply", scan)
    write_capture_description(capture)
    for name in ("body.npz", "poses.npz"):
        shutil.copy(work / "body" / name, capture.path / name)
    record = read_json(work / "registration" / "stage.json")
    write_json(work / "registration" / "stage.json", record | {"stage": "register"})
    made = {"stage": "extract", "schema": 1, "sources": {"capture": str(capture.path)}}
    write_json(work / "garment" / "stage.json", made)
    cv2.imwrite(str(folder / "print.png"), np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8))
    along = ("--with", "scans,body", "--albedo", folder / "print.png")
    assert run("export", work, "--all", *along, "--quiet") == GOOD
    return folder


@needs_blender
@pytest.mark.parametrize("kind", ["usdc", "abc", "pc2", "mdd", "glb"])
def test_the_script_shows_colours_body_and_scans_of_a_take_with_gaps(kind: str, gathered: Path):
    exports = gathered / "work" / "exports"
    if not (exports / f"garment.{kind}").is_file():
        pytest.skip(f"no {kind}: its package is not installed")
    script, vertices = exports / "open_in_blender.py", gathered / "vertices.npy"
    judged(BLENDER, HERE / "check_opened.py", script, vertices, 25, f"garment.{kind}")


@needs_blender
def test_the_script_finds_the_first_file_by_itself_in_blender(gathered: Path):
    exports = gathered / "work" / "exports"
    first = next(f"garment.{kind}" for kind in ("usdc", "abc", "glb") if (exports / f"garment.{kind}").is_file())
    script, vertices = exports / "open_in_blender.py", gathered / "vertices.npy"
    judged(BLENDER, HERE / "check_opened.py", script, vertices, 25, first, "--as-blender")


@needs_browser
def test_three_js_shows_what_was_exported_and_the_validator_finds_no_error(exported: tuple[Path, float, int]):
    folder, fps, _ = exported
    exports = folder / "work" / "exports"
    tolerance = read_json(exports / "export.json")["files"]["glb"]["error_mm"] + 0.002
    judged(
        "node", HERE / "check_in_browser.mjs", exports / "garment.glb", folder / "vertices.npy", "--fps", fps,
        "--normal-map", "--tolerance-mm", tolerance,
    )  # fmt: skip


@needs_browser
def test_the_page_works_from_disk_and_asks_for_nothing(exported: tuple[Path, float, int]):
    judged("node", HERE / "check_page.mjs", exported[0] / "work" / "exports" / "garment.html", 36)
