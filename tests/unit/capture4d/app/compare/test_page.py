"""The comparison on a sleeve with a body inside: one row a surface, one page, and it is said what had been learned."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture4d.app.compare.garment import model_take
from capture4d.captures.capture import write_scan
from capture4d.captures.work_folder import open_work
from capture4d.cli.main import main
from capture4d.errors import InputError
from capture4d.types import Scan
from retarget.animation.garment_model import load_garment_model
from tests.unit.wrinkles.conftest import some_scan
from tests.unit.wrinkles.normal_maps.test_stages import SMALL
from tests.unit.wrinkles.offset_images.test_stage import bound_work

FRAMES = 8
OFFSETS = [
    "--held-out", "0.2", "--texels", "32", "--training.epochs", "2", "--patched", "--patch.count", "2",
    "--patch.texels", "32", "--patch.channels", "16", "--workers", "1",
]  # fmt: skip
NETWORKS = ["offset images", "offset images, patches", "fully connected", "fully connected, PCA"]


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A work folder with its comparison."""
    folder = tmp_path_factory.mktemp("compared")
    work = bound_work(folder, FRAMES)
    for frame_id in range(1, FRAMES + 1):
        scan = some_scan(phase=0.3 * (frame_id - 1))
        colours = np.full((len(scan.vertices), 3), 120, np.uint8)
        write_scan(folder / "capture" / "scans" / f"{frame_id:06d}.ply", Scan(scan, colours, frame_id, 0.0))
    for arguments in (
        ["fit", work, "--regressor", "linear", "--shape.components", "3"],
        ["wrinkles", "train", work, "--output", folder / "model", *SMALL],
        ["wrinkles", "offsets", work, *OFFSETS],
        ["compare", work, "--model", folder / "model", "--workers", "1"],
    ):
        with pytest.raises(SystemExit) as exit_:
            main([str(argument) for argument in arguments])
        assert not exit_.value.code
    return work / "compare"


def test_every_surface_has_a_row(compared: Path):
    result = json.loads((compared / "compare.json").read_text())
    rows = {row["name"]: row for row in result["methods"]}
    assert list(rows) == [
        "registration", "blendshapes", "regression, linear", "network", *NETWORKS,
    ]  # fmt: skip
    # a fifth of eight frames was held out of the training, and those are compared
    assert result["frames"] == [7, 8]
    assert 4 < rows["registration"]["normal_deg"] < 12
    assert rows["registration"]["vertex_mm"] is None
    assert rows["network"]["model_mb"] > 0
    # the garment model was fitted to all eight frames
    assert [name for name, row in rows.items() if row["learned"]] == ["blendshapes", "regression, linear"]
    # the wobble is one direction, and no pose tells of it
    assert rows["blendshapes"]["vertex_mm"] < 1e-3
    assert 0.2 < rows["regression, linear"]["vertex_mm"] < 2
    # the sleeve does not move, so the mean of the offsets, which PCA starts from, is the sleeve
    assert rows["fully connected, PCA"]["vertex_mm"] < 5
    assert all(row["ms_per_frame"] > 0 for row in rows.values())


def test_the_page_stands_alone_and_shows_all(compared: Path):
    page = (compared / "index.html").read_text()
    assert page.count("regression, linear *") == 1
    assert "learned from these very frames" in page
    assert "http" not in page.replace("https://www.w3.org", "")
    assert page.count("<figure>") == 2 * (11 + 6 + 8) + 5  # the other six surfaces have a picture with the map too
    for name in ("scan", "network", "offset images", "blendshapes, network&#39;s map", "map of the scan"):
        assert f"<figcaption>{name}</figcaption>" in page


def again(compared: Path, model: Path, *more: str) -> int:
    command = ["compare", compared.parent, "--model", model, "--workers", "1"]
    with pytest.raises(SystemExit) as exit_:
        main([str(argument) for argument in (*command, *more)])
    return int(exit_.value.code or 0)


def test_a_comparison_is_made_once(compared: Path):
    before = (compared / "index.html").stat().st_mtime_ns
    assert again(compared, compared.parents[1] / "model") == 0
    assert (compared / "index.html").stat().st_mtime_ns == before


def test_a_network_s_file_stands_for_its_folder(compared: Path):
    """Its split is found beside the file."""
    before = (compared / "index.html").stat().st_mtime_ns
    assert again(compared, compared.parents[1] / "model" / "generator.safetensors") == 0
    assert (compared / "index.html").stat().st_mtime_ns == before


def test_a_network_that_has_seen_everything_is_refused(
    compared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    model = tmp_path / "model"
    shutil.copytree(compared.parents[1] / "model", model)
    record = json.loads((model / "stage.json").read_text())
    record["config"]["held_out"] = 0.0
    (model / "stage.json").write_text(json.dumps(record))
    work = tmp_path / "work"
    shutil.copytree(compared.parent, work, ignore=shutil.ignore_patterns("compare"))
    assert again(work / "compare", model) == 1
    assert "learned from it without held-out frames" in capsys.readouterr().err
    assert not (work / "compare").exists()
    shutil.rmtree(work / "wrinkles" / "pairs")  # other pairs of the same registration hide nothing
    with pytest.raises(SystemExit):
        main(
            [
                "wrinkles",
                "maps",
                str(work),
                "--pairs.map.size",
                "64",
                "--pairs.projection.blur-texels",
                "0.3",
                "--workers",
                "1",
            ]
        )
    assert again(work / "compare", model) == 1
    assert "learned from it without held-out frames" in capsys.readouterr().err


def test_maps_laid_out_otherwise_than_the_network_s_are_refused(
    compared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    work = tmp_path / "work"
    shutil.copytree(compared.parent, work, ignore=shutil.ignore_patterns("compare", "pairs"))
    with pytest.raises(SystemExit):
        main(["wrinkles", "maps", str(work), "--pairs.map.size", "64", "--pairs.map.padding", "6", "--workers", "1"])
    assert again(work / "compare", compared.parents[1] / "model") == 1
    assert "expected maps laid out as" in capsys.readouterr().err


def test_a_scan_that_cannot_be_read_is_left_out(compared: Path, tmp_path: Path):
    """It was flagged before; the comparison goes on."""
    shutil.copytree(compared.parents[1] / "capture", tmp_path / "capture")
    shutil.copytree(compared.parent, tmp_path / "work", ignore=shutil.ignore_patterns("compare"))
    work = tmp_path / "work"
    for stage in ("garment", "registration"):
        record = json.loads((work / stage / "stage.json").read_text())
        record["sources"] = {"capture": str(tmp_path / "capture")}
        (work / stage / "stage.json").write_text(json.dumps(record))
    scan = tmp_path / "capture" / "scans" / f"{FRAMES:06d}.ply"
    scan.write_bytes(scan.read_bytes()[:1000])
    lines = (work / "registration" / "metrics.jsonl").read_text().splitlines()
    failed = json.dumps({"frame_id": FRAMES, "verdict": "failed"})
    (work / "registration" / "metrics.jsonl").write_text("\n".join([*lines[:-1], failed]) + "\n")
    assert again(work / "compare", compared.parents[1] / "model") == 0
    assert json.loads((work / "compare" / "compare.json").read_text())["frames"] == [FRAMES - 1]


def test_a_garment_model_learned_again_makes_the_page_stale(
    compared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    work = tmp_path / "work"
    shutil.copytree(compared.parent, work)
    model = compared.parents[1] / "model"
    linear = work / "retarget" / "linear.safetensors"
    with pytest.raises(SystemExit):
        main(["fit", str(work), "--regressor", "linear", "--shape.components", "3", "--linear.ridges", "7",
              "--overwrite"])  # fmt: skip
    assert linear.read_bytes() != (compared.parent / "retarget" / "linear.safetensors").read_bytes()
    assert again(work / "compare", model) == 1
    assert "regressors" in capsys.readouterr().err


def test_offset_images_that_nobody_learned_are_left_out_with_a_word(compared: Path, tmp_path: Path):
    work = tmp_path / "work"
    shutil.copytree(compared.parent, work, ignore=shutil.ignore_patterns("compare", "offsets"))
    assert again(work / "compare", compared.parents[1] / "model") == 0
    assert f"Offset images: capture4d wrinkles offsets {work}." in (work / "compare" / "index.html").read_text()
    rows = json.loads((work / "compare" / "compare.json").read_text())["methods"]
    assert [row["name"] for row in rows] == ["registration", "blendshapes", "regression, linear", "network"]
    assert "Left out" not in (compared / "index.html").read_text()


def test_offset_images_that_have_seen_the_frames_bear_an_asterisk(compared: Path, tmp_path: Path):
    work = tmp_path / "work"
    shutil.copytree(compared.parent, work, ignore=shutil.ignore_patterns("compare", "offsets"))
    with pytest.raises(SystemExit):
        main(["wrinkles", "offsets", str(work), *OFFSETS, "--held-out", "0"])
    assert again(work / "compare", compared.parents[1] / "model") == 0
    rows = json.loads((work / "compare" / "compare.json").read_text())["methods"]
    assert [row["name"] for row in rows[-4:] if row["learned"]] == NETWORKS


def test_offset_images_that_are_not_finished_or_not_of_this_take(
    compared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    work = tmp_path / "work"
    shutil.copytree(compared.parent, work, ignore=shutil.ignore_patterns("compare"))
    path = work / "wrinkles" / "offsets" / "stage.json"
    record = json.loads(path.read_text())
    for change, said in (
        ({"status": "running"}, "is not finished"),
        ({"upstream": {"registration": "another"}}, "from this registration as it is now"),
    ):
        path.write_text(json.dumps(record | change))
        assert again(work / "compare", compared.parents[1] / "model") == 1
        line = capsys.readouterr().err.splitlines()[-1]
        assert said in line
        assert f"run: capture4d wrinkles offsets {work}" in line
        assert not (work / "compare").exists()


def test_a_network_of_other_takes_leaves_the_split_to_the_offset_images(compared: Path, tmp_path: Path):
    """What was learned from the take decides which frames are held out; --held-out only if nothing was."""
    model, work = tmp_path / "model", tmp_path / "work"
    shutil.copytree(compared.parents[1] / "model", model)
    record = json.loads((model / "stage.json").read_text())
    (model / "stage.json").write_text(json.dumps(record | {"upstream": {"elsewhere": "0"}}))
    (model / "takes.json").write_text(json.dumps({"elsewhere": "0"}))
    shutil.copytree(compared.parent, work, ignore=shutil.ignore_patterns("compare"))
    assert again(work / "compare", model, "--held-out", "0.4") == 0
    assert json.loads((work / "compare" / "compare.json").read_text())["frames"] == [7, 8]
    shutil.rmtree(work / "wrinkles" / "offsets")
    assert again(work / "compare", model, "--held-out", "0.4", "--overwrite") == 0
    assert json.loads((work / "compare" / "compare.json").read_text())["frames"] == [6, 7, 8]


def test_a_model_of_another_template_is_refused(compared: Path):
    work = compared.parent
    known, taken = load_garment_model(work), open_work(work)
    garment = known.model.garment
    turned = replace(garment.template, faces=garment.template.faces[::-1].copy(), uv=None)
    other = replace(known, model=replace(known.model, garment=replace(garment, template=turned)))
    with pytest.raises(InputError, match="expected a model of the template that was registered"):
        model_take(other, taken.registered, *taken.require_posed_body(), [0])


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("--pictures", "0", "at least 1"),
        ("--held-out-gap", "-1", "at least 0"),
        ("--held-out", "0", "above 0, below 1"),
    ],
)
def test_settings_out_of_range(compared: Path, capsys: pytest.CaptureFixture[str], option: str, value: str, said: str):
    assert again(compared, compared.parents[1] / "model", option, value) == 1
    assert said in capsys.readouterr().err
