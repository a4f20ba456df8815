"""A wrinkle generator as a graph: low map in, unit normals with wrinkles out, as `WrinkleModel.generate` has it."""

from __future__ import annotations

import numpy as np
import torch

from capture4d.app.onnx_models.graph import Graph, Name
from capture4d.app.onnx_models.layers import unet
from capture4d.errors import InputError
from wrinkles.normal_maps.inference import WrinkleModel

__all__ = ["probe_maps", "wrinkle_graph"]


def wrinkle_graph(model: WrinkleModel) -> Graph:
    """Input `low`, output `high`: (maps, 3, texels, texels) float32, unit normals in garment coordinates, zero beside
    the cloth; each map by itself.

    Raises:
        InputError: the generator sees squares of a map, which it is fed one by one by code.
    """
    if model.crop is not None and model.crop != model.texels:
        raise InputError(f"expected a generator that sees whole maps, found one of squares of {model.crop} texels")
    graph, size = Graph("wrinkles"), model.texels
    low = graph.input("low", ("maps", 3, size, size), np.float32)
    painted = unet(graph, model.generator, low)
    made = graph.plus(low, painted) if model.generator.output == "residual" else painted
    absolute = graph.add("Abs", low)
    some = graph.add("ReduceMax", absolute, graph.whole(1), keepdims=1)
    zero = graph.constant(np.float32(0), np.float32)
    shown = graph.as_single(graph.add("Greater", some, zero))
    added = graph.times(graph.minus(_unit(graph, made), _unit(graph, low)), shown)
    high = graph.times(_unit(graph, graph.plus(low, added)), shown)
    graph.output("high", high, ("maps", 3, size, size), np.float32)
    return graph


def _unit(graph: Graph, image: Name) -> Name:
    squares = graph.summed(graph.times(image, image), 1)
    least = graph.add("Max", squares, graph.constant(np.float32(1e-12), np.float32))
    return graph.over(image, graph.add("Sqrt", least))


def probe_maps(model: WrinkleModel, count: int, seed: int = 0) -> np.ndarray:
    """(n, 3, texels, texels) float32: smooth normals with bare places, to compare with."""
    rng, size = np.random.default_rng(seed), model.texels
    coarse = torch.from_numpy(
        rng.standard_normal((count, 4, max(size // 16, 2), max(size // 16, 2))).astype(np.float32)
    )
    smooth = torch.nn.functional.interpolate(coarse, size=(size, size), mode="bicubic", align_corners=False)
    maps = torch.nn.functional.normalize(smooth[:, :3], dim=1) * (smooth[:, 3:] > -0.8)
    return maps.numpy()
