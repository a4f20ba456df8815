"""The peers: published non-rigid registration one can install, from the same start, timed with the same clock.

trimesh's `nricp_amberg` (Amberg et al. 2007) and `nricp_sumner` (Sumner and Popovic 2004), matched to vertices, which
is their faster and here more accurate setting; MeshMonk's pyramid registration (White et al. 2019) in the millimetres
its constants are made for. All with their own defaults, and none of them knows painted borders.

    python -m benchmarks.peers CAPTURE WORK OUTPUT --every 5

registers frames of a take with each of them, from the template skinned by the body of WORK, to the garment that
`extract` cut out: OUTPUT/meshmonk/000001.obj and so on, as `capture4d import` reads them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from capture4d.captures.capture import read_capture
from capture4d.captures.garment_scans import load_garment_scan
from capture4d.captures.work_folder import open_work
from capture4d.mesh_files.meshes import write_mesh
from capture4d.types import Mesh
from registration.config import RegistrationConfig
from registration.predictions import Mover
from registration.template import analyse_template

__all__ = ["PEERS", "PeerResult", "run_peer"]


@dataclass(frozen=True, slots=True, eq=False)
class PeerResult:
    """What a peer made of one frame."""

    vertices: np.ndarray
    """(V, 3) float64, metres."""
    cpu_s: float
    """Process time, all threads."""


def nricp_amberg(start: np.ndarray, faces: np.ndarray, scan: np.ndarray, scan_faces: np.ndarray) -> np.ndarray:
    """trimesh `nricp_amberg(use_faces=False)`."""
    import trimesh

    source, target = _trimesh_pair(start, faces, scan, scan_faces)
    return np.asarray(trimesh.registration.nricp_amberg(source, target, use_faces=False))


def nricp_sumner(start: np.ndarray, faces: np.ndarray, scan: np.ndarray, scan_faces: np.ndarray) -> np.ndarray:
    """trimesh `nricp_sumner(use_faces=False)`."""
    import trimesh

    source, target = _trimesh_pair(start, faces, scan, scan_faces)
    return np.asarray(trimesh.registration.nricp_sumner(source, target, use_faces=False))


def meshmonk(start: np.ndarray, faces: np.ndarray, scan: np.ndarray, scan_faces: np.ndarray) -> np.ndarray:
    """MeshMonk `pyramid_register`, in millimetres about the scan's centre."""
    import meshmonk as package

    package.set_log_level("error")
    centre = scan.mean(axis=0)
    source, target = ((points - centre).astype(np.float32) * 1000 for points in (start, scan))
    result = package.pyramid_register(
        floating_features=package.features_from_vertices(source, faces.astype(np.int32)),
        target_features=package.features_from_vertices(target, scan_faces.astype(np.int32)),
        floating_faces=faces.astype(np.int32),
        target_faces=scan_faces.astype(np.int32),
        floating_flags=np.ones(len(source), np.float32),
        target_flags=np.ones(len(target), np.float32),
    )
    return result.aligned_features[:, :3].astype(np.float64) / 1000 + centre


PEERS: Mapping[str, Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]] = {
    "nricp_amberg": nricp_amberg,
    "nricp_sumner": nricp_sumner,
    "meshmonk": meshmonk,
}


def run_peer(name: str, start: np.ndarray, faces: np.ndarray, scan: np.ndarray, scan_faces: np.ndarray) -> PeerResult:
    """Run one of `PEERS`.

    Args:
        start: (V, 3) template vertices at the start, metres.
        scan: (S, 3) scan vertices, metres, every one used by a face.
    """
    begin = time.process_time()
    vertices = PEERS[name](start, faces, scan, scan_faces)
    return PeerResult(vertices, time.process_time() - begin)


def _trimesh_pair(start: np.ndarray, faces: np.ndarray, scan: np.ndarray, scan_faces: np.ndarray):
    import trimesh

    return (
        trimesh.Trimesh(start.astype(np.float64), faces, process=False),
        trimesh.Trimesh(scan.astype(np.float64), scan_faces, process=False),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Register frames of a take with each peer.")
    parser.add_argument("capture", type=Path, help="whose template is registered")
    parser.add_argument("work", type=Path, help="with garment/ and body/")
    parser.add_argument("output", type=Path, help="folder to write, one folder of OBJ files a peer")
    parser.add_argument("--every", type=int, default=1, help="of the frames")
    parser.add_argument("--peer", choices=sorted(PEERS), action="append", help="all if absent")
    given = parser.parse_args()
    garment = read_capture(given.capture).template
    body, poses = open_work(given.work).require_posed_body()
    mover = Mover.create(analyse_template(garment, RegistrationConfig()), body, poses)
    assert mover is not None, "the template is bound to the body"
    faces, rows = garment.template.faces, range(0, len(poses.frame_ids), given.every)
    for name in given.peer or PEERS:
        seconds = []
        for row in rows:
            frame_id = int(poses.frame_ids[row])
            scan = load_garment_scan(given.work / "garment" / "frames" / f"{frame_id:06d}.npz", frame_id).mesh
            found = run_peer(name, mover.skinned(row), faces, scan.vertices.astype(np.float64), scan.faces)
            write_mesh(given.output / name / f"{frame_id:06d}.obj", Mesh(found.vertices.astype(np.float32), faces))
            seconds.append(found.cpu_s)
        print(f"{name}: {len(seconds)} frames, {np.mean(seconds):.1f} CPU s each: {given.output / name}")


if __name__ == "__main__":
    main()
