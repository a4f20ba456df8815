"""Settings of `export-onnx`. Standard library alone: `capture4d --help` loads it."""

from __future__ import annotations

from typing import Annotated, Literal

from capture4d.settings import Number, Range, settings

__all__ = ["OnnxConfig"]


@settings
class OnnxConfig:
    """What of a model goes into the file."""

    regressor: Literal["auto", "ensemble", "kernel", "lstm", "linear"] = "auto"
    """Of a learned garment: `auto` is the one that did best on the frames that validated."""
    beta: tuple[Number, ...] = ()
    """Body shape of the wearer, as `animate` takes it; if absent, whom the garment was learned on."""
    style: tuple[str, ...] = ()
    """Of a garment with styles: numbers of the pattern, NAME=VALUE each; in the middle of their range if absent."""
    probes: Annotated[int, Range(least=8, most=4096)] = 64
    """Frames or maps on which the file is compared with the model, and timed."""
