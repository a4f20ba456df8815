"""Layers of torch as nodes of a graph."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import nn

from capture4d.app.onnx_models.graph import Graph, Name
from capture4d.errors import InputError
from wrinkles.normal_maps.networks import UNet

__all__ = ["lstm_answer", "perceptron", "unet"]


def perceptron(graph: Graph, network: nn.Sequential, value: Name) -> Name:
    """Linear layers and what stands between them; what drops out in training is left out."""
    for layer in network:
        match layer:
            case nn.Linear():
                value = graph.matrix(value, graph.constant(_values(layer.weight).T))
                value = graph.plus(value, graph.constant(_values(layer.bias)))
            case nn.ReLU():
                value = graph.add("Relu", value)
            case nn.Tanh():
                value = graph.add("Tanh", value)
            case nn.Dropout():
                pass
            case _:
                raise InputError(f"expected layers that ONNX files of this project know, found {type(layer).__name__}")
    return value


def _values(tensor: torch.Tensor) -> np.ndarray:
    return tensor.numpy(force=True).astype(np.float64)


def lstm_answer(graph: Graph, network: nn.Module, window: list[Name], shapes: int) -> Name:
    """What a sequence-to-sequence network says of the last frame of a window.

    Args:
        network: an `EncoderDecoder`.
        window: (frames, controls) of each frame of the window.
        shapes: how many numbers it says.
    """
    encoder, decoder, head = (getattr(network, name) for name in ("encoder", "decoder", "head"))
    size, layers = encoder.hidden_size, encoder.num_layers
    frames = graph.add("Shape", window[0], start=0, end=1)

    def zeros(count: int) -> Name:
        shape = graph.add("Concat", frames, graph.whole(count), axis=0)
        return graph.add("Expand", graph.constant(np.zeros((1, 1))), shape)

    state = [(zeros(size), zeros(size)) for _ in range(layers)]
    for value in window:
        _, state = _step(graph, encoder, value, state)
    said = zeros(shapes)
    for _ in window:
        hidden, state = _step(graph, decoder, said, state)
        said = perceptron(graph, nn.Sequential(head), hidden)
    return said


def _step(graph: Graph, lstm: Any, value: Name, state: list[tuple[Name, Name]]) -> tuple[Name, list[tuple[Name, Name]]]:
    """All layers of an LSTM, one frame on. Torch keeps input, forget, cell and output gates in this order."""
    size, after = lstm.hidden_size, []
    for layer, (hidden, cell) in enumerate(state):
        weights = [_values(getattr(lstm, f"weight_{kind}_l{layer}")).T for kind in ("ih", "hh")]
        bias = sum(_values(getattr(lstm, f"bias_{kind}_l{layer}")) for kind in ("ih", "hh"))
        both = graph.add("Concat", value, hidden, axis=-1)
        gates = graph.plus(graph.matrix(both, graph.constant(np.concatenate(weights))), graph.constant(bias))
        parts = [graph.columns(gates, each * size, (each + 1) * size) for each in range(4)]
        into, kept, out = (graph.add("Sigmoid", parts[each]) for each in (0, 1, 3))
        cell = graph.plus(graph.times(kept, cell), graph.times(into, graph.add("Tanh", parts[2])))
        value = graph.times(out, graph.add("Tanh", cell))
        after.append((value, cell))
    return value, after


def unet(graph: Graph, network: UNet, value: Name) -> Name:
    """The generator's answer, `UNet.paint`, in single precision."""
    passed = [value]
    for block in network.down:
        passed.append(_image_layers(graph, block, passed[-1]))
    image = passed.pop()
    for block in network.up:
        image = _image_layers(graph, block, image)
        beside = passed.pop()
        if passed:
            image = graph.add("Concat", beside, image, axis=1)
    return image


def _image_layers(graph: Graph, block: Any, value: Name) -> Name:
    for layer in block:
        match layer:
            case nn.Conv2d() | nn.ConvTranspose2d():
                kind = "ConvTranspose" if isinstance(layer, nn.ConvTranspose2d) else "Conv"
                given = [layer.weight] if layer.bias is None else [layer.weight, layer.bias]
                numbers = [graph.constant(each.numpy(force=True), np.float32) for each in given]
                steps, pads = [*layer.stride], [*layer.padding, *layer.padding]
                value = graph.add(kind, value, *numbers, kernel_shape=[*layer.kernel_size], strides=steps, pads=pads)
            case nn.BatchNorm2d():
                own = [graph.constant(each.numpy(force=True), np.float32) for each in (layer.weight, layer.bias)]
                if layer.training:  # of each map by itself, as pix2pix tests
                    value = graph.add("InstanceNormalization", value, *own, epsilon=layer.eps)
                else:
                    assert layer.running_mean is not None
                    assert layer.running_var is not None
                    known = (layer.running_mean, layer.running_var)
                    kept = [graph.constant(each.numpy(force=True), np.float32) for each in known]
                    value = graph.add("BatchNormalization", value, *own, *kept, epsilon=layer.eps)
            case nn.LeakyReLU():
                value = graph.add("LeakyRelu", value, alpha=layer.negative_slope)
            case nn.ReLU():
                value = graph.add("Relu", value)
            case nn.Tanh():
                value = graph.add("Tanh", value)
            case nn.Dropout():
                pass
            case _:
                raise InputError(f"expected layers that ONNX files of this project know, found {type(layer).__name__}")
    return value
