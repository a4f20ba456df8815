"""The registration template of a synthetic take, as a lab's artist would make it: a smooth, evenly meshed shirt of
about 5,000 vertices in the body's rest pose, bound to the body."""

from __future__ import annotations

import numpy as np

from capture4d.body.binding import bind
from capture4d.body.skinning import PosedBody, unskin
from capture4d.types import Garment, Mesh
from data_synth.cloth.patterns import PanelMesh, locate

__all__ = ["bind_template", "carry"]


def carry(source: PanelMesh, target: PanelMesh, positions: np.ndarray) -> np.ndarray:
    """Positions (V, 3) of the target's vertices on a mesh of the same pattern."""
    faces, weights = locate(source, target.vertex_uv)
    return np.einsum("vk,vkc->vc", weights, positions[source.faces[faces]])


def bind_template(
    mesh: PanelMesh,
    dressed: np.ndarray,
    dressed_body: PosedBody,
    settled: np.ndarray,
    settled_body: PosedBody,
    *,
    skin_weights: np.ndarray | None = None,
) -> Garment:
    """Bind to the body where the limbs are well apart, and take the shape from where the cloth has settled.

    Args:
        dressed: (V, 3) vertices in the dressing pose, arms held out.
        settled: (V, 3) vertices in the pose the clip starts with.
        skin_weights: (V, J) of cloth that hangs loose; those of the skin beneath if None.
    """
    faces, barycentric, weights = bind(dressed, mesh.faces, dressed_body)
    weights = weights if skin_weights is None else skin_weights
    rest, flagged = unskin(settled, weights, settled_body.transforms)
    assert not flagged.any(), "the clip's first pose cannot be unposed"
    return Garment(
        template=Mesh(rest.astype(np.float32), mesh.faces, mesh.uv.astype(np.float32)),
        loops={name: loop.astype(np.int32) for name, loop in mesh.loops.items()},
        embedding_faces=faces,
        embedding_barycentric=barycentric,
        skin_weights=weights.astype(np.float32),
        body_shape=settled_body.shaped.shape.astype(np.float32),
        pattern_metres=1.0,
    )
