"""A garment put on: once for each kind, on the mean person and in the draft's own style.

Shirts are closed by the moving simulator (`data_synth.cloth.simulation`), whose arms come out of the sleeves; the rest
is hung around the body and closed by the solver of drapes. Either is then averaged with its own mirror image and
brought to rest. That is kept in the user's cache folder, for it is the same for every set.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass

import numpy as np

from capture4d.body.skinning import PosedBody, ShapedBody, with_pose
from capture4d.cache import user_cache_folder
from capture4d.files.arrays import ArrayFile
from capture4d.files.atomic import write_npz
from capture4d.geometry.triangles import count_intersecting_faces
from data_synth.cloth.fabrics import FABRICS
from data_synth.cloth.panels import Pattern
from data_synth.cloth.patterns import PanelMesh, mesh_pattern
from data_synth.cloth.simulation import dress, simulate
from data_synth.config import SimulationConfig
from data_synth.drapes.config import STYLES, GarmentName
from data_synth.drapes.garments import GARMENTS, Placement, panel_vertices

__all__ = ["MIRROR", "Base", "base_garment", "hung", "mirrored"]

DRESSING_VERSION = 1
MIRROR = np.array([-1.0, 1.0, 1.0])
SIMULATED_FRAMES = 44
"""After which a shirt in the dressing pose moves no more."""


@dataclass(frozen=True, slots=True, eq=False)
class Base:
    """A garment in its draft's own style on the mean person."""

    pattern: Pattern
    mesh: PanelMesh
    hung: np.ndarray
    """(V, 3) around the body in the dressing pose: closed, but for garments that the solver of drapes closes."""


def base_garment(garment: GarmentName, mean: ShapedBody, vertices: int, seed: int) -> Base:
    """Draft, mesh and hang a garment; what the moving simulator does of it is done once for each machine.

    Args:
        mean: the mean person, in the rest pose.
        vertices: wanted number of the mesh's.
        seed: of the mesh.
    """
    kind = GARMENTS[garment]
    pattern = kind.draft(mean, STYLES[garment]())
    mesh = mesh_pattern(pattern, vertices, np.random.default_rng([seed, 0]), symmetric=True)
    body = with_pose(mean, kind.dressing(mean), np.zeros(3))
    if kind.hang is not None:
        return Base(pattern, mesh, hung(garment, mesh, pattern, body))
    known = [DRESSING_VERSION, garment, asdict(STYLES[garment]()), vertices, seed]
    key = hashlib.sha256(json.dumps(known).encode()).hexdigest()[:12]
    path = user_cache_folder() / "drapes" / f"{garment}-{key}.npz"
    if not path.is_file():
        worn = _simulated(mesh, pattern, body)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_npz(path, vertices=worn)
    with ArrayFile(path) as arrays:
        return Base(pattern, mesh, arrays["vertices"])


def hung(garment: GarmentName, mesh: PanelMesh, pattern: Pattern, body: PosedBody) -> np.ndarray:
    """The panels around a body in the dressing pose, (V, 3), as the garment's kind has them."""
    hang = GARMENTS[garment].hang
    assert hang is not None, f"a {garment} is put on by the moving simulator"
    return hang(Placement(*panel_vertices(mesh, pattern), pattern), body)


def mirrored(points: np.ndarray, mesh: PanelMesh) -> np.ndarray:
    """The mirror image of a garment, (V, 3), vertex for vertex."""
    assert mesh.mirror is not None
    return points[mesh.mirror] * MIRROR


def _simulated(mesh: PanelMesh, pattern: Pattern, body: PosedBody) -> np.ndarray:
    """A shirt that the moving simulator has closed on a body, (V, 3), the same on both sides."""
    start = dress(body.shaped, mesh, pattern, body, body.rotations)
    config = SimulationConfig(vertices=mesh.vertex_count, substeps=48, damping=0.99, hold_hz=0.0)
    frames = list(simulate(mesh, start, [body] * SIMULATED_FRAMES, FABRICS["jersey"], config))
    worn = (frames[-1] + mirrored(frames[-1], mesh)) / 2
    cut = count_intersecting_faces(worn, mesh.faces)
    assert cut == 0, f"a shirt as it is put on cuts itself in {cut} faces"
    return worn
