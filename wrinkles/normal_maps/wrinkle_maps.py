"""Maps with wrinkles for a posed garment: what `wrinkles apply` writes for every frame, as arrays.

The low map is made at the size that is wanted. The network sees it at the scale it was trained at; what it adds there
is enlarged without steps (bicubic), which says nothing that it did not, and added to the low map.
"""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32

from capture4d.errors import InputError
from capture4d.types import Garment
from wrinkles.normal_maps.inference import WrinkleModel, load_model
from wrinkles.normal_maps.pair_files import layout_digest
from wrinkles.normal_maps.template import MapTemplate

__all__ = ["MapMaker", "require_size", "wrinkle_map"]

LARGEST = 4096
"""Texels along a side. A map of 1,024 takes 0.2 GB beside what torch needs, and one of as many sixteen times that."""


@dataclass(frozen=True, slots=True, eq=False)
class MapMaker:
    """A generator, and the template that it was trained on, analysed once for many frames."""

    model: WrinkleModel
    template: MapTemplate
    """Referred to the generator's own; at the size of the maps that are made."""
    kept: MapTemplate
    """At the size of the maps that the generator's were made of."""
    learned: MapTemplate
    """At the size of those that the generator learned from."""

    @staticmethod
    def create(model: WrinkleModel, template: MapTemplate, *, texels: int | None = None) -> MapMaker:
        """
        Args:
            template: at the size of the maps that the generator's were made of.
            texels: side of the maps to make; by default as many.
        Raises:
            InputError: the template is another, or laid out otherwise, or its layout does not permit so many texels.
        """
        if layout_digest(template.mesh, template.raster.size) != model.layout_digest:
            raise InputError("template: expected the one that the network was trained on, found another mesh or layout")
        require_size(model, texels)
        referred, size = template.referred_to(model.template.vertices), texels or model.maps.size

        def sized(size: int) -> MapTemplate:
            return referred if size == referred.raster.size else referred.at(model.maps.sized(size))

        learned = sized(model.texels)
        return MapMaker(model, learned if size == model.texels else sized(size), referred, learned)

    def normals(self, vertices: Float[np.ndarray, "V 3"]) -> Float32[np.ndarray, "N 3"]:
        """World normals at the template's texels, alike on both sides of every seam.

        Args:
            vertices: the garment as it lies, metres, world.
        """
        raster, rotation = self.template.raster, self.template.rotation(vertices).astype(np.float32)
        seen = torch.from_numpy(self.kept.raster.image(self.kept.low_normals(vertices) @ rotation))
        added = self.learned.across_seams(self.model.added(seen.permute(2, 0, 1)).permute(1, 2, 0).numpy())
        if len(added) != raster.size:
            how = cv2.INTER_CUBIC if raster.size > len(added) else cv2.INTER_AREA
            added = cv2.resize(added, (raster.size, raster.size), interpolation=how)
        made = self.template.low_normals(vertices) @ rotation + raster.read(added)
        made = raster.read(self.template.across_seams(raster.image(made / _lengths(made))))
        return (made / _lengths(made)) @ rotation.T

    def map(self, vertices: Float[np.ndarray, "V 3"]) -> Float32[np.ndarray, "size size 3"]:
        """The same as a map in tangent space, relative to the garment as it lies; OpenGL's +Y, flat where it shows
        nothing."""
        return self.template.tangent_image(self.normals(vertices), vertices)


def require_size(model: WrinkleModel, texels: int | None) -> None:
    """
    Raises:
        InputError: the layout of a network's maps does not permit so many texels, or so few.
    """
    least = model.maps.smallest
    if texels is not None and not least <= texels <= LARGEST:
        reach = f"from {least}, so that the layout's islands stay apart, to {LARGEST}"
        raise InputError(f"texels: expected {reach}, found {texels}")


def _lengths(vectors: np.ndarray) -> np.ndarray:
    return np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-6)


def wrinkle_map(
    model: WrinkleModel | str | PathLike[str],
    vertices: Float[np.ndarray, "V 3"] | Float[np.ndarray, "frames V 3"],
    *,
    template: Garment | None = None,
    texels: int | None = None,
) -> Float32[np.ndarray, "size size 3"] | Float32[np.ndarray, "frames size size 3"]:
    """The normal map that a trained network gives a posed garment: what `capture4d wrinkles apply` writes.

    Unit normals in tangent space, relative to the posed garment's own mesh, OpenGL's +Y; (0, 0, 1) where the map shows
    nothing. A `MapMaker` does the same for frames that come one by one, and analyses the template only once.

    Args:
        model: what `wrinkles train` wrote, its folder or generator.safetensors; or that file as `load_model` reads it.
        vertices: of the template that the network was trained on, posed, metres; one frame or several.
        template: a garment of that template, such as the registered one; by default the model's own, which only models
            of early versions lack.
        texels: side of the map; that of the maps that the network's were made of by default. Twice as many take four
            times as long: a map of 1,024 takes about a second.
    Raises:
        InputError: there is no such model, it is of another template, or it keeps none and none is given; or its layout
            does not permit so many texels.
    """
    known = model if isinstance(model, WrinkleModel) else load_model(model)
    count = len(known.template.vertices)
    if vertices.shape[-2:] != (count, 3) or vertices.ndim not in (2, 3):
        raise InputError(f"vertices: expected (frames, {count}, 3) or ({count}, 3), found {vertices.shape}")
    if template is not None:
        laid_out = MapTemplate.create(template, known.maps)
    elif known.template.uv is not None:
        laid_out = MapTemplate.laid_out(known.template, known.maps)
    else:
        raise InputError("template: expected one, for the model is of an early version, which kept none; found none")
    maker = MapMaker.create(known, laid_out, texels=texels)
    if vertices.ndim == 2:
        return maker.map(vertices)
    size = maker.template.raster.size
    made = np.empty((len(vertices), size, size, 3), np.float32)
    for image, placed in zip(made, vertices, strict=True):
        image[:] = maker.map(placed)
    return made
