"""ONNX graphs, written node by node: no tracing, so that what is in a file is what stands here.

Numbers are double precision unless a graph says otherwise: the runtime is no slower for the few that there are, and a
micrometre stays one. Letters in shapes: names of axes that may be of any length.

References: ONNX operator set 18.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from capture4d.files.optional_packages import ONNX, package_module

__all__ = ["Graph"]

OPSET, FORMAT = 18, 9
"""Of the operators, and of the file: from 2023, read by ONNX Runtime 1.15 and newer."""

Name = str
Shape = Sequence[int | str]


class Graph:
    """A graph that grows; what a method returns is the name of a value.

    Raises:
        InputError: the package onnx is not installed.
    """

    def __init__(self, name: str) -> None:
        self._onnx, self._helper = package_module(ONNX, ""), package_module(ONNX, "helper")
        self._arrays = package_module(ONNX, "numpy_helper")
        self._name = name
        self._nodes: list[Any] = []
        self._constants: list[Any] = []
        self._known: dict[tuple[Any, ...], Name] = {}
        self._inputs: list[Any] = []
        self._outputs: list[Any] = []

    def input(self, name: str, shape: Shape, kind: type = np.float64) -> Name:
        """What a caller hands over."""
        self._inputs.append(self._told(name, shape, kind))
        return name

    def output(self, name: str, value: Name, shape: Shape, kind: type = np.float64) -> None:
        """What a caller gets."""
        self._nodes.append(self._helper.make_node("Identity", [value], [name]))
        self._outputs.append(self._told(name, shape, kind))

    def constant(self, values: Any, kind: type | None = np.float64) -> Name:
        """Numbers that are part of the file; equal small ones are kept once."""
        array = np.ascontiguousarray(values, kind)
        array = array.reshape(np.shape(values))  # a bare number stays one
        key = (array.dtype.str, array.shape, array.tobytes()) if array.size < 64 else (len(self._constants),)
        if key not in self._known:
            self._known[key] = f"c{len(self._constants)}"
            self._constants.append(self._arrays.from_array(array, self._known[key]))
        return self._known[key]

    def whole(self, *values: int) -> Name:
        """Whole numbers, such as axes or a shape."""
        return self.constant(np.array(values), np.int64)

    def add(self, operator: str, *inputs: Name, **attributes: Any) -> Name:
        """A node with one output."""
        made = f"v{len(self._nodes)}"
        self._nodes.append(self._helper.make_node(operator, list(inputs), [made], **attributes))
        return made

    # --- what is used often --------------------------------------------------------------------------------------

    def plus(self, a: Name, b: Name) -> Name:
        return self.add("Add", a, b)

    def minus(self, a: Name, b: Name) -> Name:
        return self.add("Sub", a, b)

    def times(self, a: Name, b: Name) -> Name:
        return self.add("Mul", a, b)

    def over(self, a: Name, b: Name) -> Name:
        return self.add("Div", a, b)

    def matrix(self, a: Name, b: Name) -> Name:
        return self.add("MatMul", a, b)

    def reshaped(self, value: Name, *shape: int) -> Name:
        """0 keeps an axis, -1 takes the rest."""
        return self.add("Reshape", value, self.whole(*shape))

    def summed(self, value: Name, axis: int) -> Name:
        """Over an axis, which stays, of length 1."""
        return self.add("ReduceSum", value, self.whole(axis), keepdims=1)

    def length(self, value: Name) -> Name:
        """Of vectors along the last axis, which stays."""
        return self.add("Sqrt", self.summed(self.times(value, value), -1))

    def at_least(self, value: Name, least: float) -> Name:
        return self.add("Max", value, self.constant(np.float64(least)))

    def at_most(self, value: Name, most: float) -> Name:
        return self.add("Min", value, self.constant(np.float64(most)))

    def columns(self, value: Name, start: int, stop: int) -> Name:
        """Some of the last axis."""
        return self.add("Slice", value, self.whole(start), self.whole(stop), self.whole(-1))

    def chosen(self, value: Name, indices: Sequence[int] | np.ndarray, axis: int) -> Name:
        return self.add("Gather", value, self.constant(np.asarray(indices), np.int64), axis=axis)

    def as_double(self, value: Name) -> Name:
        return self.add("Cast", value, to=self._onnx.TensorProto.DOUBLE)

    def as_single(self, value: Name) -> Name:
        return self.add("Cast", value, to=self._onnx.TensorProto.FLOAT)

    def whole_file(self, metadata: Mapping[str, str]) -> bytes:
        """The file.

        Args:
            metadata: for people and programs: what it was made from, units, licence.
        """
        graph = self._helper.make_graph(self._nodes, self._name, self._inputs, self._outputs, self._constants)
        opset = [self._helper.make_opsetid("", OPSET)]
        model = self._helper.make_model(graph, producer_name="capture4d", opset_imports=opset, ir_version=FORMAT)
        for key, value in metadata.items():
            entry = model.metadata_props.add()
            entry.key, entry.value = key, value
        package_module(ONNX, "checker").check_model(model, full_check=True)
        return model.SerializeToString()

    def _told(self, name: str, shape: Shape, kind: type) -> Any:
        return self._helper.make_tensor_value_info(name, self._helper.np_dtype_to_tensor_dtype(np.dtype(kind)), shape)
