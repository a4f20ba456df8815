"""From a coloured scan of hundreds of thousands of vertices to the few thousand points that tracking reads.

One point a cell of a grid, so that dense parts of a scan do not outweigh sparse ones. Cells are larger on the garment,
which says less about the body. What has the garment's colour or a border's paint is cloth, the rest is skin or suit.

    WORK/points/000123.npz    points of a frame, and what they were made from

To read and to label a scan takes longer than to follow the body in it. So whoever has one open, `extract` or the first
pass of `track`, keeps its points, and whoever needs them later leaves the scan alone. Points are no stage's: they say
what they were made from, and count only where that is what would be read now.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from capture4d.captures.capture import Capture
from capture4d.captures.points.sampling import SamplingConfig
from capture4d.captures.scan_states import as_it_is_now, scan_digest
from capture4d.captures.take_colours import KnownColours, described_colours
from capture4d.colours.labels import classify_colours, settle_labels
from capture4d.colours.printed_cloth import label_print
from capture4d.errors import InputError
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import write_npz
from capture4d.geometry.mesh_kernels import first_in_cells, normals_of_some, open_vertices
from capture4d.runs.made import FileState, digest_of
from capture4d.types import Scan

__all__ = ["KeptPoints", "ScanPoints", "label_scan", "scan_points", "subsample"]

SCHEMA = 1
FOLDER = "points"


@dataclass(frozen=True, slots=True, eq=False)
class ScanPoints:
    """What tracking sees of a scan."""

    points: Float64[np.ndarray, "points 3"]
    """Metres."""
    normals: Float64[np.ndarray, "points 3"]
    """Outwards."""
    cloth: Bool[np.ndarray, " points"]
    """On the garment; the others are on skin or suit."""


def subsample(scan: ScanPoints, count: int) -> ScanPoints:
    """Every so-many-th point; points are in random order."""
    if len(scan.points) <= count:
        return scan
    kept = np.linspace(0, len(scan.points) - 1, count).astype(int)
    return ScanPoints(scan.points[kept], scan.normals[kept], scan.cloth[kept])


def label_scan(scan: Scan, colours: KnownColours) -> UInt8[np.ndarray, " verts"]:
    """Labels of a scan's vertices, as `classify_colours` has them, after the votes of their neighbours.

    Args:
        scan: in the light that the colours hold for.
    """
    paints = tuple(dict.fromkeys(colours.boundary.values()))
    labels = classify_colours(scan.colours, colours.garment, paints, others=colours.others)
    labels = settle_labels(scan.mesh.faces, labels)
    return label_print(scan.mesh.faces, labels) if colours.printed else labels


def scan_points(
    scan: Scan, labels: UInt8[np.ndarray, " verts"], config: SamplingConfig, *, source: str = "scan"
) -> ScanPoints:
    """Points and normals of a labelled scan, in random but fixed order; as exact as a file keeps them, float32.

    Vertices on open edges are left out: their normals are half a neighbourhood's.

    Raises:
        InputError: there is nothing left of the scan.
    """
    faces, vertices = scan.mesh.faces, scan.mesh.vertices
    on_edge, used = open_vertices(faces, len(vertices))
    order = np.random.default_rng(0).permutation(np.flatnonzero(used & ~on_edge))
    cloth = labels[order] > 0
    kept = np.concatenate(
        [
            first_in_cells(vertices, order[~cloth], config.body_cell_m),
            first_in_cells(vertices, order[cloth], config.cloth_cell_m),
        ]
    )
    normals = normals_of_some(vertices, faces, kept)
    sound = normals.any(axis=1)
    if not sound.any():
        raise InputError("expected a surface to track, found no faces", where=source)
    shuffled = np.random.default_rng(1).permutation(np.flatnonzero(sound))
    normals = normals[shuffled].astype(np.float32).astype(np.float64)
    return ScanPoints(vertices[kept[shuffled]].astype(np.float64), normals, labels[kept[shuffled]] > 0)


@dataclass(frozen=True, slots=True, eq=False)
class KeptPoints:
    """The points of a take's scans, in a work folder."""

    folder: Path
    capture: Capture
    made_from: str
    """Digest of what they are made from beside their scans."""

    @staticmethod
    def of(work: Path, capture: Capture, colours: KnownColours, sampling: SamplingConfig) -> KeptPoints:
        """Those that a stage would make that knows the colours."""
        described = {**described_colours(colours), "loops": ""}
        described["boundary_colours"] = list(dict.fromkeys(described["boundary_colours"].values()))
        made_from = digest_of([SCHEMA, capture.units, described, asdict(sampling)])
        return KeptPoints(work / FOLDER, capture, made_from)

    def read(self, frame_id: int) -> tuple[ScanPoints, list[FileState]] | None:
        """The points of a frame and the scan that they are of, if they were kept and that is still the same scan."""
        path = self._path(frame_id)
        if not path.is_file():
            return None
        try:
            with ArrayFile(path) as arrays:
                if str(arrays["made_from"]) != self.made_from:
                    return None
                names, digests = arrays.names("names"), arrays.names("digests")
                numbers = zip(arrays["sizes"].tolist(), arrays["times"].tolist(), strict=True)
                states = zip(names, numbers, digests, strict=True)
                before = tuple(FileState(name, *size_and_time, digest) for name, size_and_time, digest in states)
                found = ScanPoints(
                    arrays["points"].astype(np.float64), arrays["normals"].astype(np.float64), arrays["cloth"]
                )
        except InputError:  # damaged: they are made again
            return None
        files = as_it_is_now(self.capture, frame_id, before)
        if not files or scan_digest(files) != scan_digest(before):
            return None
        return found, list(files)

    def write(self, frame_id: int, points: ScanPoints, files: Sequence[FileState]) -> None:
        """Keep the points of a frame.

        Args:
            files: of the scan, as it was when it was read.
        """
        write_npz(
            self._path(frame_id),
            points=points.points.astype(np.float32),
            normals=points.normals.astype(np.float32),
            cloth=points.cloth,
            made_from=np.array(self.made_from),
            names=np.array([each.name for each in files], np.str_),
            sizes=np.array([each.size for each in files], np.int64),
            times=np.array([each.time_ns for each in files], np.int64),
            digests=np.array([each.digest for each in files], np.str_),
        )

    def _path(self, frame_id: int) -> Path:
        return self.folder / f"{frame_id:06d}.npz"
