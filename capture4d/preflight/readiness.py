"""What can be known before the first frame of a run: whether template, body, paints, settings and disk will do.

A night of tracking is not worth an hour that a look at a few small files would have saved. Nothing here reads a scan;
`capture4d check` does.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from capture4d.body.anny import load_anny
from capture4d.body.binding import with_body_shape
from capture4d.body.sewing_pattern import fit_pattern, with_known_pattern
from capture4d.captures.capture import Capture, scan_path, template_path
from capture4d.captures.names import telling_names, unknown_borders
from capture4d.errors import InputError
from capture4d.runs.stage import SCHEMAS, read_record, settings_of, unchanged_settings
from capture4d.types import Garment

__all__ = ["pattern_told", "require_ready"]

GARMENT_SHARE = 0.15
"""Least size of a garment cut out of a scan, as a share of the scan's file: 0.6 where both are of the same kind, less
where the scan is text or has a textured body around it."""
BYTES_PER_VERTEX = 30
"""Of a registered frame, beside its place in the stack of all."""
GIGABYTE = 1e9


def require_ready(capture: Capture, work: Path, registration: Any, tracking: Any, *, anew: bool = False) -> None:
    """See that nothing that is known now will stop a run later.

    Args:
        registration: settings of that stage.
        tracking: settings of that stage; None where the capture brings the poses.
        anew: what was made with other settings is made again.
    Raises:
        InputError: something will; names it.
        StaleError: a stage was finished or begun with other settings.
    """
    template = capture.template
    _require_surface(capture, template)
    _require_borders(capture, template)
    _require_body(capture, template, tracked=tracking is not None)
    if work.exists() and not work.is_dir():
        raise InputError("expected a work folder, or none yet, found a file", where=work)
    if not anew:
        _require_settings(work / "registration", "register", registration)
        if tracking is not None:
            _require_settings(work / "body", "track", tracking)
    _require_room(capture, work, len(template.template.vertices))


def pattern_told(capture: Capture) -> str:
    """Where the lengths of the cloth come from, in a line for people."""
    template, name = with_known_pattern(capture.template), template_path(capture).name
    if template.pattern_metres:
        scale = "in metres" if template.pattern_metres == 1 else f"with {template.pattern_metres:.4g} m in a unit"
        return f"{name}: its UVs are a sewing pattern {scale}, from which the cloth has its lengths"
    if template.template.uv is None:
        why = "it has no UVs"
    elif capture.template.pattern_metres == 0:
        why = "its UVs are said to be no sewing pattern"
    else:
        fit = fit_pattern(template.template)
        why = f"its UVs are no sewing pattern ({', '.join(fit.faults()) if fit else 'no area'})"
    return f"{name}: {why}; the cloth has the lengths of the mesh"


def _require_surface(capture: Capture, template: Garment) -> None:
    if not len(template.template.faces):
        raise InputError("expected a template with faces, found none", where=template_path(capture))


def _require_borders(capture: Capture, template: Garment) -> None:
    painted, path = capture.boundary_colours, capture.path / "capture.json"
    if painted and not template.loops:
        expected = "expected a template with open borders, as its scans have"
        raise InputError(f"{expected}; found none", where=template_path(capture))
    unknown = unknown_borders(telling_names(painted), template.loops)
    if unknown:
        raise InputError(
            f"boundary_colours: expected paints named as the template's borders ({', '.join(template.loops)}), "
            f"found {', '.join(unknown)}",
            where=path,
        )


def _require_body(capture: Capture, template: Garment, *, tracked: bool) -> None:
    """See that the template is bound to the body that will move it."""
    if template.skin_weights is None:
        return
    moving = None if tracked else capture.posed_body
    body = moving[0] if moving else capture.body or load_anny()
    joints = template.skin_weights.shape[1]
    if joints != len(body.joint_names):
        raise InputError(
            f"expected skin weights for the body's {len(body.joint_names)} joints, found {joints}; "
            "it was bound to another body",
            where=template_path(capture),
        )
    with_body_shape(template, body, moving[1].shape if moving else np.zeros(0, np.float32))


def _require_settings(folder: Path, stage: str, config: Any) -> None:
    path = folder / "stage.json"
    record = read_record(path) if path.is_file() else {}
    if record.get("stage") == stage and record.get("status") != "discarded":
        unchanged_settings(settings_of(stage, SCHEMAS[stage], config), record, folder)


def _require_room(capture: Capture, work: Path, vertices: int) -> None:
    """Raise InputError where the disk will be full before the last frame, by the least that a run writes."""
    needed = sum(_bytes(capture, work, vertices))
    above = next(each for each in (work, *work.resolve().parents) if each.exists())
    free = shutil.disk_usage(above).free
    if needed > free:
        raise InputError(
            f"expected at least {needed / GIGABYTE:.3g} GB free for {len(capture.frame_ids)} frames, "
            f"found {free / GIGABYTE:.3g} GB",
            where=above,
        )


def _bytes(capture: Capture, work: Path, vertices: int) -> Iterator[float]:
    """What each frame that is not there yet will take at least."""
    garments, registered = ({*_names(work / stage / "frames")} for stage in ("garment", "registration"))
    for frame_id in capture.frame_ids:
        name = f"{frame_id:06d}.npz"
        if name not in garments:
            yield GARMENT_SHARE * scan_path(capture, frame_id).stat().st_size
        if name not in registered:
            yield (12 + BYTES_PER_VERTEX) * vertices


def _names(folder: Path) -> list[str]:
    return os.listdir(folder) if folder.is_dir() else []
