"""What networks of offset images are trained with. Lengths in centimetres.

Letters: B frames of a batch, V vertices, F faces, E edges, k images of three channels.

References: Jin et al., A pixel-based framework for data-driven clothing, SCA 2020, section 5.2 and appendix.
"""

from __future__ import annotations

from typing import Literal, assert_never

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

__all__ = ["GridNorm", "edge_length_loss", "grid_loss", "normal_loss", "vertex_normals_of"]

GridNorm = Literal["l1", "l2", "l2_squared"]
"""The paper's "L2 norm" may be meant squared or not; its figures in cm are lengths."""


def grid_loss(
    made: Float[Tensor, "B channels rows columns"],
    truth: Float[Tensor, "B channels rows columns"],
    mask: Bool[Tensor, "k rows columns"],
    norm: GridNorm,
) -> Float[Tensor, ""]:
    """The mean over the texels of the mask of the norm of the difference of three channels:
    sum W |made - truth| / sum W."""
    difference = (made - truth).unflatten(1, (len(mask), 3))
    match norm:
        case "l1":
            length = difference.abs().sum(dim=2)
        case "l2":
            length = difference.norm(dim=2)
        case "l2_squared":
            length = difference.square().sum(dim=2)
        case _:
            assert_never(norm)
    return (length * mask).sum() / (mask.sum() * len(made))


def normal_loss(
    made: Float[Tensor, "B V 3"], truth: Float[Tensor, "B V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, ""]:
    """The mean over the vertices of 1 - cos of the angle between the normals."""
    return (1 - (vertex_normals_of(made, faces) * vertex_normals_of(truth, faces)).sum(dim=-1)).mean()


def edge_length_loss(
    made: Float[Tensor, "B V 3"], truth: Float[Tensor, "B V 3"], edges: Int[Tensor, "E 2"]
) -> Float[Tensor, ""]:
    """The mean over the edges of the difference of their lengths: the necktie's, which slides along itself."""
    lengths = [(each[:, edges[:, 0]] - each[:, edges[:, 1]]).norm(dim=-1) for each in (made, truth)]
    return (lengths[0] - lengths[1]).abs().mean()


def vertex_normals_of(vertices: Float[Tensor, "B V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "B V 3"]:
    """Unit normals, weighted by the areas of the faces; differentiable."""
    corner, along, across = (vertices[:, faces[:, k]] for k in range(3))
    vector = torch.linalg.cross(along - corner, across - corner)
    total = torch.zeros_like(vertices)
    for k in range(3):
        total = total.index_add(1, faces[:, k], vector)
    return nn.functional.normalize(total, dim=-1, eps=1e-12)
