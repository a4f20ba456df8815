"""Checkpoints of a training: networks, optimisers and torch's random state in one file, so that a resumed run is the
same run.

The file is safetensors: `modules.NAME.*` are weights, `optimisers.NAME.INDEX.*` what an optimiser keeps of its
INDEX-th parameter, `tensors.*` whatever else the training needs, `random` torch's random state on the CPU. Its note
holds the optimisers' learning rates and a note of the training's own.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from capture4d.errors import InputError
from capture4d.files.reading import reading
from capture4d.files.tensors import TensorFile, read_tensors, write_tensors

__all__ = ["filled", "read_checkpoint", "write_checkpoint"]

Network = TypeVar("Network", bound=nn.Module)

_RANDOM = "random"


def write_checkpoint(
    path: str | Path,
    kind: str,
    *,
    modules: Mapping[str, nn.Module],
    optimisers: Mapping[str, Optimizer],
    tensors: Mapping[str, Tensor] | None = None,
    note: Mapping[str, Any] | None = None,
) -> None:
    """Write where a training stands, atomically. Equal states give equal bytes.

    Args:
        kind: which training it is, checked when it is read: "wrinkle training".
        modules: networks by name; a name has no dot. Weights that are only kept, such as the best so far, are a module.
        tensors: anything else that a resume needs.
        note: whatever JSON holds; finite numbers.
    """
    assert not any("." in name for name in (*modules, *optimisers)), "a name of a module or optimiser has no dot"
    found = {_RANDOM: torch.get_rng_state()}
    for name, module in modules.items():
        found |= {f"modules.{name}.{key}": value for key, value in module.state_dict().items()}
    about = {}
    for name, optimiser in optimisers.items():
        states = optimiser.state_dict()["state"].items()
        kept = {f"optimisers.{name}.{index}.{key}": value for index, state in states for key, value in state.items()}
        about[name] = {"kept": len(kept), "learning_rates": [group["lr"] for group in optimiser.param_groups]}
        found |= kept
    found |= {f"tensors.{name}": value for name, value in (tensors or {}).items()}
    arrays = {name: value.numpy(force=True) for name, value in found.items()}
    write_tensors(path, kind, arrays, {"optimisers": about, "note": dict(note or {})})


def read_checkpoint(
    path: str | Path,
    kind: str,
    *,
    modules: Mapping[str, nn.Module],
    optimisers: Mapping[str, Optimizer],
    command: str,
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Go on from what `write_checkpoint` wrote: networks, optimisers and torch's random state become what they were.

    Nothing is changed unless all of it fits.

    Args:
        command: the training's, which starts anew with --overwrite; for the message.
    Returns:
        The further tensors, on the CPU, and the note.
    Raises:
        InputError: the file is missing, damaged, of another training or of other networks.
    """
    try:
        file = read_tensors(path, kind)
        weights = {name: _fitting_weights(file, name, module) for name, module in modules.items()}
        moments = {name: _fitting_moments(file, name, optimiser) for name, optimiser in optimisers.items()}
        rates = {name: _fitting_rates(file, name, optimiser) for name, optimiser in optimisers.items()}
        random, note = _random_state(file), file.entry("note")
    except InputError as error:
        raise InputError(f"{error.reason}; to start anew: {command} ... --overwrite", where=error.where) from None
    for name, module in modules.items():
        module.load_state_dict(weights[name])
    for name, optimiser in optimisers.items():
        optimiser.load_state_dict({"state": moments[name], "param_groups": optimiser.state_dict()["param_groups"]})
        for group, rate in zip(optimiser.param_groups, rates[name], strict=True):
            group["lr"] = rate
    torch.set_rng_state(random)
    return _tensors(file.prefixed("tensors.")), note


def filled(make: Callable[[], Network], weights: Mapping[str, Tensor], *, source: str | Path) -> Network:
    """A network of a file, made and filled; what its description claims costs no memory before the weights are there.

    Args:
        make: makes the network from what the file says of it.
        source: the file, for the message.
    Raises:
        InputError: they are the weights of another architecture, or no weights.
    """
    with reading(source, "network"):
        with torch.device("meta"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of layers without a number: their weights are judged below
            network = make()
        _require_weights(network, weights, source)
        for key, value in weights.items():
            if not value.dtype.is_floating_point and key.rpartition(".")[2] != "num_batches_tracked":
                raise InputError(f"'{key}': expected floating-point weights, found {value.dtype}")
            if not torch.isfinite(value).all():
                raise InputError(f"'{key}': expected finite weights, found NaN or inf")
        network.to_empty(device="cpu")
        network.load_state_dict(dict(weights))
    return network


def _require_weights(network: nn.Module, weights: Mapping[str, Tensor], source: str | Path) -> None:
    own = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    given = {key: tuple(value.shape) for key, value in weights.items()}
    odd = sorted(key for key in own.keys() | given.keys() if own.get(key) != given.get(key))
    if odd:
        key = min(own.keys() & given.keys() & set(odd), default=odd[0])
        expected, found = own.get(key, "none"), given.get(key, "none")
        raise InputError(f"weights of another architecture: '{key}', expected {expected}, found {found}", where=source)


def _fitting_weights(file: TensorFile, name: str, module: nn.Module) -> dict[str, Tensor]:
    weights = _tensors(file.prefixed(f"modules.{name}."))
    _require_weights(module, weights, file.path)
    return weights


def _fitting_moments(file: TensorFile, name: str, optimiser: Optimizer) -> dict[int, dict[str, Tensor]]:
    """What an optimiser keeps of its parameters, each a single number or as large as the parameter."""
    parameters = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    found = _tensors(file.prefixed(f"optimisers.{name}."))
    moments: dict[int, dict[str, Tensor]] = {}
    for key, value in found.items():
        whole = f"optimisers.{name}.{key}"
        index, _, entry = key.partition(".")
        if not index.isdecimal() or int(index) >= len(parameters):
            raise InputError(f"'{whole}': expected one of {len(parameters)} parameters", where=file.path)
        shape = tuple(parameters[int(index)].shape)
        if value.ndim and tuple(value.shape) != shape:
            raise InputError(f"'{whole}': expected {shape}, found {tuple(value.shape)}", where=file.path)
        moments.setdefault(int(index), {})[entry] = value
    kept = _about(file, name).get("kept")
    if len(found) != kept:
        raise InputError(f"expected {kept} tensors of the optimiser '{name}', found {len(found)}", where=file.path)
    return moments


def _fitting_rates(file: TensorFile, name: str, optimiser: Optimizer) -> list[float]:
    rates, count = _about(file, name).get("learning_rates"), len(optimiser.param_groups)
    if not isinstance(rates, list) or len(rates) != count:
        raise InputError(f"expected {count} learning rates of '{name}', found {rates}", where=file.path)
    return rates


def _about(file: TensorFile, name: str) -> dict[str, Any]:
    """What the file's note says of an optimiser."""
    known = file.entry("optimisers")
    if name not in known:
        raise InputError(f"expected an optimiser '{name}', found {', '.join(known) or 'none'}", where=file.path)
    return known[name]


def _random_state(file: TensorFile) -> Tensor:
    if _RANDOM not in file.tensors:
        raise InputError(f"expected a whole checkpoint, found one without '{_RANDOM}'", where=file.path)
    found, own = torch.from_numpy(file.tensors[_RANDOM]), torch.get_rng_state()
    if found.dtype != own.dtype or found.shape != own.shape:
        raise InputError(f"'{_RANDOM}': expected torch's random state, {len(own)} bytes, found "
                         f"{tuple(found.shape)} of {found.dtype}", where=file.path)  # fmt: skip
    return found


def _tensors(arrays: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    return {name: torch.from_numpy(array) for name, array in arrays.items()}
