"""The nodes of a glTF scene, each where it stands in the world."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from capture4d.errors import InputError
from capture4d.mesh_files.gltf.document import Document
from capture4d.mesh_files.gltf.entries import extension, numbers_of

__all__ = ["PlacedNode", "placed_nodes"]

_INSTANCES = "EXT_mesh_gpu_instancing"


@dataclass(frozen=True, slots=True, eq=False)
class PlacedNode:
    """A node that is there to be seen."""

    index: int
    entry: dict[str, Any]
    transform: Float64[np.ndarray, "4 4"]
    """From the node to the world."""
    visible: bool
    """Whether neither it nor what it hangs from is hidden."""


def placed_nodes(document: Document) -> Iterator[PlacedNode]:
    """The nodes of the scene, each once, in the world; the last child first."""
    waiting = [(index, np.eye(4), True) for index in _roots(document)]
    seen: set[int] = set()
    while waiting:
        index, parent, shown = waiting.pop()
        node = document.entry("nodes", index)
        if index in seen:
            raise InputError(f"nodes[{index}]: expected a tree of nodes, found one that is reached twice")
        seen.add(index)
        if extension(node, _INSTANCES) is not None:
            raise InputError(f"nodes[{index}]: expected a mesh in one place, found {_INSTANCES}, which is not read")
        hidden = (extension(node, "KHR_node_visibility") or {}).get("visible") is False
        placed = PlacedNode(index, node, parent @ _transform(node), shown and not hidden)
        yield placed
        waiting += [(child, placed.transform, placed.visible) for child in node.get("children", [])]


def _roots(document: Document) -> list[Any]:
    if document.tree.get("scenes"):
        return document.entry("scenes", document.tree.get("scene", 0)).get("nodes", [])
    nodes = document.tree.get("nodes", [])
    children = {child for node in nodes for child in node.get("children", [])}
    roots = [index for index in range(len(nodes)) if index not in children]
    if nodes and not roots:
        raise InputError("expected a tree of nodes, found each below another")
    return roots


def _transform(node: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
    """From the node to its parent: a matrix, or scale, then rotation, then translation."""
    matrix = numbers_of(node, "matrix", np.eye(4).ravel()).reshape(4, 4).T
    x, y, z, w = numbers_of(node, "rotation", np.array([0.0, 0.0, 0.0, 1.0]))
    norm = x * x + y * y + z * z + w * w
    scaled = 2 / norm if norm > 0 else 0.0
    turned = np.eye(4)
    turned[:3, :3] -= scaled * np.array(
        [
            [y * y + z * z, z * w - x * y, -x * z - y * w],
            [-x * y - z * w, x * x + z * z, x * w - y * z],
            [y * w - x * z, -y * z - x * w, x * x + y * y],
        ]
    )
    moved = np.eye(4)
    moved[:3, 3] = numbers_of(node, "translation", np.zeros(3))
    return matrix @ moved @ turned @ np.diag([*numbers_of(node, "scale", np.ones(3)), 1.0])
