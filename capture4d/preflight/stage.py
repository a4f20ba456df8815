"""`capture4d check` as a function: a take in, what is wrong with it out, and the take without it if asked for.

Looking writes nothing, so there is no record to resume from, and a second look is a new one.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from capture4d.preflight.check import Checked, check_take
from capture4d.preflight.repair.fix import require_place, write_fixed
from capture4d.preflight.take_folder import Claims

__all__ = ["run"]


def run(
    capture: Path,
    output: Path | None = None,
    claims: Claims | None = None,
    *,
    all_frames: bool = False,
    workers: int = 1,
) -> Checked:
    """Look through a take, and correct it.

    Args:
        capture: folder of a take, or just of scans.
        output: folder for the corrected take, if anything has to be; then every frame is looked at. None corrects
            nothing.
        claims: what is said of the take, over what its folder says.
        all_frames: look at every frame instead of a sample.
    Raises:
        InputError: there is nothing to look at, or a description, rig or body cannot be read; or there is already
            something where the corrected take would go, which is said before anything is looked at.
    """
    if output is not None:
        require_place(output, capture)
    checked = check_take(capture, claims, all_frames=all_frames or output is not None, workers=workers)
    if output is None or not checked.verdict.findings:
        return checked
    fixed = write_fixed(checked, output, workers=workers)
    return replace(checked, fixed=fixed.path, how_fixed=fixed.told())
