"""Whose motion a file holds, and what its makers ask to be said where it is shown.

Nothing in a BVH or npz says so: a file is known by its name, or by that of a folder it lies in, as archives have it
(`CMU/12/12_01.bvh`, `cmu_12_01_walk.bvh`). A file that was renamed is not known, and skeletons prove nothing: other
databases use that of CMU's.
"""

from __future__ import annotations

import re
from pathlib import Path

__all__ = ["CMU", "acknowledgement"]

CMU = (
    "The data used in this project was obtained from mocap.cs.cmu.edu. "
    "The database was created with funding from NSF EIA-0196217."
)
"""As the database asks, word by word."""
_CMU_NAME = re.compile(r"(?<![a-z])cmu(?![a-z])", re.IGNORECASE)
_FOLDERS = 3
"""Above the file, in which a database's name may stand."""


def acknowledgement(path: Path) -> str | None:
    """What is to be said where the motion of a file is shown; None of files that are not known."""
    named = path.parts[-1 - _FOLDERS :]
    return CMU if any(_CMU_NAME.search(part) for part in named) else None
