"""Maps with wrinkles for a posed garment: what `wrinkles apply` writes for every frame, as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike

import numpy as np
import torch
from jaxtyping import Float, Float32

from capture4d.errors import InputError
from capture4d.types import Garment
from wrinkles.normal_maps.inference import WrinkleModel, load_model
from wrinkles.normal_maps.pair_files import layout_digest
from wrinkles.normal_maps.seams import SeamTable, seam_table
from wrinkles.normal_maps.template import MapTemplate

__all__ = ["MapMaker", "wrinkle_map"]


@dataclass(frozen=True, slots=True, eq=False)
class MapMaker:
    """A generator, and the template that it was trained on, analysed once for many frames."""

    model: WrinkleModel
    template: MapTemplate
    """Referred to the generator's own."""
    seams: SeamTable

    @staticmethod
    def create(model: WrinkleModel, template: MapTemplate) -> MapMaker:
        """
        Raises:
            InputError: the template is another, or laid out otherwise.
        """
        if layout_digest(template.mesh, template.raster.size) != model.layout_digest:
            raise InputError("template: expected the one that the network was trained on, found another mesh or layout")
        seams = seam_table(template.mesh, template.raster)
        return MapMaker(model, template.referred_to(model.template.vertices), seams)

    def normals(self, vertices: Float[np.ndarray, "V 3"]) -> Float32[np.ndarray, "N 3"]:
        """World normals at the template's texels, alike on both sides of every seam.

        Args:
            vertices: the garment as it lies, metres, world.
        """
        raster, rotation = self.template.raster, self.template.rotation(vertices).astype(np.float32)
        low = raster.image(self.template.low_normals(vertices) @ rotation)
        made = self.model.generate(torch.from_numpy(low).permute(2, 0, 1)).permute(1, 2, 0).numpy()
        values = raster.read(self.seams.blended(np.ascontiguousarray(made), raster))
        length = np.linalg.norm(values, axis=1, keepdims=True)
        return (values / np.maximum(length, 1e-6)) @ rotation.T

    def map(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "size size 3"]:
        """The same as a map in tangent space, relative to the garment as it lies; OpenGL's +Y, flat where it shows
        nothing."""
        return self.template.tangent_image(self.normals(vertices), self.template.frames(vertices))


def wrinkle_map(
    model: WrinkleModel | str | PathLike[str],
    vertices: Float[np.ndarray, "V 3"] | Float[np.ndarray, "frames V 3"],
    *,
    template: Garment | None = None,
) -> Float32[np.ndarray, "size size 3"] | Float32[np.ndarray, "frames size size 3"]:
    """The normal map that a trained network gives a posed garment: what `capture4d wrinkles apply` writes.

    Unit normals in tangent space, relative to the posed garment's own mesh, OpenGL's +Y; (0, 0, 1) where the map shows
    nothing. A `MapMaker` does the same for frames that come one by one, and analyses the template only once.

    Args:
        model: what `wrinkles train` wrote, its folder or generator.safetensors; or that file as `load_model` reads it.
        vertices: of the template that the network was trained on, posed, metres; one frame or several.
        template: a garment of that template, such as the registered one; by default the model's own, which only models
            of early versions lack.
    Raises:
        InputError: there is no such model, it is of another template, or it keeps none and none is given.
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
    maker = MapMaker.create(known, laid_out)
    if vertices.ndim == 2:
        return maker.map(vertices).astype(np.float32)
    size = known.maps.size
    made = np.empty((len(vertices), size, size, 3), np.float32)
    for image, placed in zip(made, vertices, strict=True):
        image[:] = maker.map(placed)
    return made
