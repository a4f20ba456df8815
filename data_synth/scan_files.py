"""Which scans of a capture still have to be made: those that are missing, and those that were cut off."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from capture4d.runs.stage import Stage

__all__ = ["is_whole_scan", "pending_scans"]

_HEADER = re.compile(
    rb"ply\nformat binary_little_endian 1\.0\n"
    rb"element vertex (\d+)\n(?:property float [xyz]\n){3}(?:property uchar (?:red|green|blue)\n){3}"
    rb"element face (\d+)\nproperty list uchar int vertex_indices\nend_header\n"
)
_VERTEX_BYTES, _FACE_BYTES = 3 * 4 + 3, 1 + 3 * 4


def pending_scans(stage: Stage, frame_ids: Iterable[int]) -> list[int]:
    """The frames that have no whole scan yet, in the order given."""
    return [frame_id for frame_id in frame_ids if not is_whole_scan(stage.frame_path(frame_id, ".ply", folder="scans"))]


def is_whole_scan(path: Path) -> bool:
    """Whether a file is as long as its header says, and its header one of `capture4d.captures.capture.write_scan`."""
    try:
        with path.open("rb") as file:
            header = _HEADER.match(file.read(1024))
        size = path.stat().st_size
    except OSError:
        return False
    if header is None:
        return False
    vertices, faces = (int(count) for count in header.groups())
    return size == header.end() + _VERTEX_BYTES * vertices + _FACE_BYTES * faces
