"""The surfaces that are compared: for every held-out frame, vertices and normals of each, and what they cost."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from capture4d.app.compare.garment import Modelled, ModelledSurface, model_take
from capture4d.app.compare.inputs import Inputs
from capture4d.app.compare.offsets import megabytes, offset_surfaces
from retarget.model_folder import learned_frames
from wrinkles.normal_maps.pairs import PairTake
from wrinkles.normal_maps.template import MapTemplate
from wrinkles.normal_maps.wrinkle_maps import MapMaker

__all__ = ["NETWORK", "Method", "Surfaces", "methods"]

NETWORK = "network"
"""The registration with the network's map."""


@dataclass(frozen=True, slots=True, eq=False)
class Method:
    """A surface for every held-out frame."""

    name: str
    vertices: np.ndarray
    """(T, V, 3)."""
    normals: np.ndarray
    """(T, N, 3) world, per texel."""
    ms_per_frame: float
    megabytes: float
    has_map: bool = False
    learned: bool = False
    """From some of these frames."""


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """All methods, the registration first, and what other pictures are made with."""

    methods: Sequence[Method]
    maker: MapMaker
    """Of the network's maps, for whatever vertices."""
    modelled: Modelled | None
    """The take as the garment model has it, if there is one."""


def methods(inputs: Inputs, held: PairTake) -> Surfaces:
    """Every surface that the inputs give.

    Args:
        held: the frames to compare.
    Raises:
        InputError: the garment model is of another template or skeleton, or a frame is not registered or has no pose.
    """
    sequence, template, rows = inputs.work.registered, inputs.template, inputs.rows(held)
    registered = np.array(sequence.vertices[rows])
    found = [_drawn_by("registration", template, registered, template.low_normals, 0.0)]
    known, moving = inputs.garment_model, inputs.work.posed_body
    modelled: Modelled | None = None
    if known is not None and moving is not None:
        modelled = model_take(known, sequence, *moving, rows)
        seen = any(not set(rows).isdisjoint(part) for part in learned_frames(known.folder, inputs.pairs.registration))
        found += [_without_map(each, template, learned=seen) for each in modelled.surfaces]
    maker = MapMaker.create(inputs.generator, template)
    size = megabytes(inputs.generator.generator)
    found.append(_drawn_by(NETWORK, template, registered, maker.normals, size, has_map=True))
    if inputs.offsets is not None and moving is not None:
        surfaces = offset_surfaces(inputs.offsets, sequence, *moving, rows)
        seen = not inputs.offsets.seen.isdisjoint(held.frame_ids.tolist())
        found += [_without_map(each, template, learned=seen) for each in surfaces]
    return Surfaces(found, maker, modelled)


def _without_map(surface: ModelledSurface, template: MapTemplate, *, learned: bool) -> Method:
    return _drawn_by(
        surface.name, template, surface.vertices, template.low_normals, surface.megabytes,
        extra_ms=surface.ms_per_frame, learned=learned,
    )  # fmt: skip


def _drawn_by(
    name: str,
    template: MapTemplate,
    vertices: np.ndarray,
    normals: Callable[[np.ndarray], np.ndarray],
    megabytes: float,
    *,
    extra_ms: float = 0.0,
    has_map: bool = False,
    learned: bool = False,
) -> Method:
    maps, times = [], []
    for placed in vertices:
        begin = time.perf_counter()
        maps.append(normals(placed))
        times.append(1e3 * (time.perf_counter() - begin))
    return Method(name, vertices, np.stack(maps), float(np.median(times)) + extra_ms, megabytes, has_map, learned)
