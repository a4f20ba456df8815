"""Work folders as stages leave them, finished or not, with the measures that a test wants."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture4d.files.atomic import write_bytes, write_json, write_npy, write_npz
from capture4d.files.records import save_garment
from capture4d.runs.stage import open_stage
from capture4d.types import Garment
from tests.shapes import tube

MESH = tube(12, 5, 0.2, 0.6)


def record(frame_id: int, **changes: Any) -> dict[str, Any]:
    return {"frame_id": frame_id, "verdict": "good", "reasons": [], "fit_mean_mm": 0.5, "fit_p95_mm": 1.0,
            "covered_percent": 90.0, "cpu_s": 0.2, **changes}  # fmt: skip


@pytest.fixture
def write_work() -> Callable[..., Path]:
    def write(
        path: Path,
        frames: Sequence[Mapping[str, Any]] = (),
        *,
        config: Mapping[str, Any] | None = None,
        upstream: Mapping[str, str] | None = None,
        name: str = "register",
        finished: bool = True,
        moved_m: float = 0.0,
    ) -> Path:
        """A registration of the given frames; of an unfinished one the last has measures, but no arrays yet."""
        capture = (upstream or {}).get("capture", "scans")
        extracted = open_stage(path / "garment", name="extract", schema=1, config={}, upstream={"capture": capture})
        extracted.finish([])
        stage = open_stage(
            path / "registration", name=name, schema=1, config=config or {"nodes": 300}, upstream=upstream or {}
        )
        for each in frames:
            write_json(stage.frame_path(each["frame_id"], ".json", folder="metrics"), each)
            if finished or each is not frames[-1]:
                residual = np.zeros(len(MESH.vertices), np.float32)
                write_npz(stage.frame_path(each["frame_id"]), vertices=MESH.vertices, residual_m=residual)
        save_garment(stage.path / "garment.npz", Garment(MESH, {}))
        if finished:
            moved = MESH.vertices + np.array([moved_m, 0, 0], np.float32)
            write_npy(stage.path / "vertices.npy", np.stack([moved] * len(frames)))
            write_bytes(stage.path / "metrics.jsonl", "\n".join(map(json.dumps, frames)).encode())
            stage.finish([stage.path / "vertices.npy"])
        return path

    return write


@pytest.fixture
def write_report() -> Callable[..., None]:
    def write(work: Path, values: Mapping[str, float | None], frames: Sequence[Mapping[str, Any]] = ()) -> None:
        digest = json.loads((work / "registration" / "stage.json").read_text())["digest"]
        stage = open_stage(work / "report", name="report", schema=1, config={}, upstream={"registration": digest})
        metrics = [{"key": key, "value": value, "unit": "mm", "better": "lower"} for key, value in values.items()]
        write_json(stage.path / "metrics.json", {"metrics": metrics, "capture": "walk"})
        if frames:
            write_bytes(stage.path / "frames.jsonl", "\n".join(map(json.dumps, frames)).encode())
        stage.finish([])

    return write
