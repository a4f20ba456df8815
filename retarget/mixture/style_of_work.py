"""The style of a garment that was registered or scanned: a model and WORK in, style.json out.

{
  "style": {"length": 0.71, ...},   numbers of the pattern, as `animate --style @style.json` takes them
  "beta": [0.4, -0.2],              the person, standard deviations
  "at_limit": ["length"],           what has run into the end of what was learned
  "residual_mm": 7.9,               mean distance over the frames
  "frames": {"12": 7.6, ...},       and of each
  "turned_deg": 1.4,                by how much joints were turned from the tracked pose, mean
  "source": "registration",         what it was fitted to
  "verdict": "good"                 or "check", with `reasons`
}
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from capture4d.captures.garment_scans import load_garment_scan
from capture4d.captures.work_folder import WorkFolder, open_work
from capture4d.errors import InputError
from capture4d.files.atomic import write_json
from capture4d.files.outputs import new_files
from capture4d.runs.frame_lists import chosen_frames, frame_file
from capture4d.runs.stage import require_complete
from capture4d.types import Body, PoseSequence, RegisteredSequence
from retarget.mixture.config import StyleFitConfig
from retarget.mixture.model_files import MODEL_FILES, load_styled_garment
from retarget.mixture.style_fit import SeenFrame, StyleFit, fit_style
from retarget.mixture.styled_garment import StyledGarment

__all__ = ["StyleFound", "run"]

FAR_MM = 25.0
"""Mean residual from which the garment is none that the model knows: on garments that it does know, in unseen styles
and poses, a model of a few prototypes is off by 10 to 18 mm itself."""


@dataclass(frozen=True, slots=True, eq=False)
class StyleFound:
    """What style.json says."""

    path: Path
    fit: StyleFit
    frame_ids: tuple[int, ...]
    reasons: tuple[str, ...]
    """Why it is to be checked; none if it is good."""


def run(
    model: Path, work: Path | WorkFolder, output: Path, config: StyleFitConfig, *, overwrite: bool = False
) -> StyleFound:
    """Fit a garment with styles to frames of a take, and write what was found.

    Args:
        model: what `fit-styles` wrote.
        work: of a take with registered frames, or with the scans' garments and a body.
        output: style.json to write.
        overwrite: also over a file that holds something else.
    Raises:
        InputError: there are no such frames, the body is another than the model's, or the file is not ours.
    """
    garment, opened = load_styled_garment(model), open_work(work) if isinstance(work, Path) else work
    registered = _source(opened, config) == "registration"
    body, poses = opened.require_posed_body()
    _require_body(garment, body, opened)
    if registered:
        sequence = opened.registered
        seen = [int(each) for each in sequence.frame_ids if int(each) not in opened.failed_frames]
        chosen = _chosen(seen, poses, config, opened)
        frames = [_of_registration(garment, sequence, poses, frame_id) for frame_id in chosen]
    else:
        folder = opened.path / "garment"
        require_complete(folder, "extract", f"capture4d extract CAPTURE --output {opened.path}")
        seen = sorted(int(path.stem) for path in (folder / "frames").glob("*.npz"))
        chosen = _chosen(seen, poses, config, opened)
        frames = [_of_scan(folder, poses, frame_id) for frame_id in chosen]
    fit = fit_style(garment, frames, shape=poses.shape, fit_pose=config.pose)
    reasons = _reasons(fit)
    inputs = [model / name for name in MODEL_FILES]
    with new_files([output], inputs=inputs, overwrite=overwrite) as workshop:
        write_json(workshop / output.name, _told(fit, chosen, frames, reasons, registered=registered))
    return StyleFound(output, fit, tuple(chosen), reasons)


def _source(work: WorkFolder, config: StyleFitConfig) -> Literal["registration", "scans"]:
    if config.source != "auto":
        return config.source
    return "registration" if "registration" in work.stages else "scans"


def _require_body(garment: StyledGarment, body: Body, work: WorkFolder) -> None:
    known = garment.body
    same = body.joint_names == known.joint_names and np.array_equal(body.template.faces, known.template.faces)
    if not same:
        raise InputError(
            f"expected poses of the model's body ({len(known.joint_names)} joints, {len(known.template.faces)} faces), "
            f"found another ({len(body.joint_names)}, {len(body.template.faces)})",
            where=work.path,
        )


def _chosen(seen: Sequence[int], poses: PoseSequence, config: StyleFitConfig, work: WorkFolder) -> list[int]:
    """The frames to fit to: those that are asked for, or as many as the settings say, evenly over the take."""
    known = [frame_id for frame_id in seen if frame_id in {int(each) for each in poses.frame_ids}]
    if not known:
        raise InputError("expected frames of a garment with a pose, found none", where=work.path)
    if config.frames is not None:
        return list(chosen_frames(config.frames, known))
    rows = np.unique(np.linspace(0, len(known) - 1, min(config.count, len(known))).round().astype(int))
    return [known[row] for row in rows]


def _pose_of(poses: PoseSequence, frame_id: int) -> tuple[np.ndarray, np.ndarray]:
    row = int(np.flatnonzero(poses.frame_ids == frame_id)[0])
    return poses.rotations[row], poses.translations[row]


def _of_registration(
    garment: StyledGarment, sequence: RegisteredSequence, poses: PoseSequence, frame_id: int
) -> SeenFrame:
    """A registered frame: vertex by vertex if the template is the model's, else as a surface with borders."""
    template, own = sequence.garment, garment.garment.template
    row = int(np.flatnonzero(sequence.frame_ids == frame_id)[0])
    vertices = np.array(sequence.vertices[row])
    same = np.array_equal(template.template.faces, own.faces)
    loops = {name: loop for name, loop in template.loops.items() if len(loop)}
    return SeenFrame(
        *_pose_of(poses, frame_id),
        template.template.with_vertices(vertices),
        same,
        np.concatenate([np.zeros((0, 3), np.float32), *(vertices[loop] for loop in loops.values())]),
        tuple(name for name, loop in loops.items() for _ in loop),
    )


def _of_scan(folder: Path, poses: PoseSequence, frame_id: int) -> SeenFrame:
    """The garment of a scan."""
    scan = load_garment_scan(frame_file(folder, frame_id), frame_id)
    names = ("", *scan.loop_names)
    return SeenFrame(
        *_pose_of(poses, frame_id), scan.mesh, False, scan.boundary_points,
        tuple(names[loop + 1] for loop in scan.boundary_loops.tolist()),
    )  # fmt: skip


def _reasons(fit: StyleFit) -> tuple[str, ...]:
    found = []
    residual = float(fit.residual_mm.mean())
    if residual > FAR_MM:
        found.append(f"the garment is {residual:.0f} mm from any that the model knows; expected at most {FAR_MM:.0f}")
    if fit.at_limit:
        found.append(f"{', '.join(fit.at_limit)} ran into the end of what was learned")
    return tuple(found)


def _told(
    fit: StyleFit, chosen: Sequence[int], frames: Sequence[SeenFrame], reasons: Sequence[str], *, registered: bool
) -> dict[str, Any]:
    tracked = np.stack([frame.rotations for frame in frames]).astype(np.float64)
    cosines = (np.einsum("fjab,fjab->fj", tracked, fit.rotations) - 1) / 2
    turned = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    moved = turned[turned > 1e-3]
    return {
        "style": {name: round(value, 6) for name, value in fit.style.items()},
        "beta": [round(value, 6) for value in fit.beta],
        "at_limit": list(fit.at_limit),
        "residual_mm": round(float(fit.residual_mm.mean()), 4),
        "frames": {str(each): round(float(off), 4) for each, off in zip(chosen, fit.residual_mm, strict=True)},
        "turned_deg": round(float(moved.mean()) if len(moved) else 0.0, 4),
        "source": "registration" if registered else "scans",
        "verdict": "check" if reasons else "good",
        "reasons": list(reasons),
    }
