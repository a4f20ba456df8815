"""Printed fabric: images over a sewing pattern, with features of a known size, and none of the border paint's colour.

A print is ink on white cloth in the plane of the pattern, at a millimetre a pixel. It is drawn on the whole sheet: the
panels are cut afterwards, so that stripes run along the grain of every panel.
"""

from __future__ import annotations

from typing import assert_never

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8
from scipy.ndimage import gaussian_filter, map_coordinates

from capture4d.colours.spaces import Colour, nearly_encoded, nearly_linear
from data_synth.cloth.patterns import PanelMesh
from data_synth.outfits import Outfit, PrintName
from data_synth.scanner.raycast import Print

__all__ = ["draw_print", "logo_circle", "picture_over", "printed_cloth"]

FEATURE_MM = 10.0
"""Size of the features where none is given."""
PIXEL_M = 0.001
MARGIN_M = 0.01
"""Of the image around the pattern."""
SOFTNESS_M = 0.0008
"""Standard deviation to which ink runs."""
UNLIKE_PAINT = 0.34
"""Least angle in linear RGB between the print and the paint, radians."""
LOGO_FEATURES = 14
"""A logo is so many features wide."""
CHEST = 0.72
"""Height of the logo's middle on the front panel, as a share of it."""
INKS: tuple[Colour, Colour] = ((150, 152, 156), (214, 168, 140))
"""Of stripes, squares and logos, beside the outfit's garment colour: the suit's grey and the skin's tone, the hardest
for whoever cuts the garment out by colour."""


def printed_cloth(
    mesh: PanelMesh,
    name: PrintName,
    outfit: Outfit,
    *,
    feature_mm: float | None,
    painted: Bool[np.ndarray, " verts"],
    seed: int,
) -> Print:
    """A print on the mesh of a pattern, but for its painted borders.

    Args:
        painted: vertices of the mesh in the paint along its borders.
    """
    corner = mesh.uv.reshape(-1, 2)
    origin = (corner.min(axis=0) - MARGIN_M).astype(np.float32)
    columns, rows = np.ceil((corner.max(axis=0) + MARGIN_M - origin) / PIXEL_M).astype(int).tolist()
    chest, _ = logo_circle(mesh, feature_mm)
    image = draw_print(
        name, (rows, columns), outfit,
        feature_px=(feature_mm or FEATURE_MM) / (1000 * PIXEL_M), chest_px=(chest - origin) / PIXEL_M,
        rng=np.random.default_rng(seed),
    )  # fmt: skip
    places = ((mesh.uv - origin) / PIXEL_M).astype(np.float32)
    return Print(image, places, 1 - painted[mesh.faces].astype(np.float32))


def picture_over(
    found: Print, mesh: PanelMesh, uv: Float[np.ndarray, "faces 3 2"]
) -> UInt8[np.ndarray, "rows columns 3"]:
    """A print on the mesh of a pattern as the picture that spans the bounding box of UVs of the same pattern.

    The first row is that of the largest v, as in textures.
    """
    origin = mesh.uv[0, 0] - PIXEL_M * found.places[0, 0]
    low, high = uv.reshape(-1, 2).min(axis=0), uv.reshape(-1, 2).max(axis=0)
    columns, rows = np.ceil((high - low) / PIXEL_M).astype(int)
    u = low[0] + (np.arange(columns) + 0.5) / columns * (high - low)[0]
    v = high[1] - (np.arange(rows) + 0.5) / rows * (high - low)[1]
    places = np.meshgrid((v - origin[1]) / PIXEL_M, (u - origin[0]) / PIXEL_M, indexing="ij")
    channels = [map_coordinates(found.image[..., c], places, order=1, mode="nearest") for c in range(3)]
    return np.clip(np.rint(255 * np.stack(channels, axis=-1)), 0, 255).astype(np.uint8)


def logo_circle(mesh: PanelMesh, feature_mm: float | None) -> tuple[Float64[np.ndarray, " 2"], float]:
    """Middle (u, v) and radius of a logo on the front panel of a pattern, metres."""
    front = mesh.uv[mesh.face_panels == 0].reshape(-1, 2)
    low, high = front.min(axis=0), front.max(axis=0)
    middle = np.array([(low[0] + high[0]) / 2, low[1] + CHEST * (high[1] - low[1])])
    return middle, LOGO_FEATURES * (feature_mm or FEATURE_MM) / 2000


def draw_print(
    name: PrintName,
    shape: tuple[int, int],
    outfit: Outfit,
    *,
    feature_px: float,
    chest_px: Float[np.ndarray, " 2"],
    rng: np.random.Generator,
) -> Float32[np.ndarray, "rows columns 3"]:
    """The image of a print, sRGB from 0 to 1; row 0 is the lowest of the pattern.

    Args:
        feature_px: size of its features.
        chest_px: column and row of a logo's middle.
    """
    rows, columns = np.indices(shape)
    cloth = np.array(outfit.garment) / 255
    grey, skin = np.array(INKS) / 255
    match name:
        case "random":
            image = _blobs(shape, feature_px, rng)
        case "stripes":
            image = np.where((columns // feature_px % 2 == 0)[..., None], cloth, grey)
        case "checks":
            across, up = columns // feature_px % 2, rows // feature_px % 2
            image = np.where((across + up)[..., None] == 1, skin, np.where((across * up)[..., None] == 1, grey, cloth))
        case "logo":
            away = np.hypot(columns - chest_px[0], rows - chest_px[1])
            image = np.where((away < LOGO_FEATURES * feature_px / 2)[..., None], _blobs(shape, feature_px, rng), cloth)
        case _:
            assert_never(name)
    soft = gaussian_filter(image, (SOFTNESS_M / PIXEL_M, SOFTNESS_M / PIXEL_M, 0))
    return _unlike(soft, outfit.border).astype(np.float32)


def _blobs(shape: tuple[int, int], feature_px: float, rng: np.random.Generator) -> np.ndarray:
    """Three channels of smooth noise, pushed towards dark and bright."""
    noise = gaussian_filter(rng.standard_normal((*shape, 3)), (feature_px / 2.5, feature_px / 2.5, 0), mode="wrap")
    return 0.5 + 0.38 * np.tanh(2.5 * noise / noise.std(axis=(0, 1)))


def _unlike(image: np.ndarray, paint: Colour) -> np.ndarray:
    """The image, what resembles the paint mixed with grey: who prints a garment chooses another paint for it."""
    wanted = nearly_linear(np.array(paint) / 255)
    wanted /= np.linalg.norm(wanted)
    light = nearly_linear(np.clip(image, 0, 1))
    grey = np.broadcast_to(light.mean(axis=-1, keepdims=True), light.shape)
    result = light.copy()
    for share in np.linspace(0, 1, 11):
        mixed = (1 - share) * light + share * grey
        cosine = result @ wanted / np.maximum(np.linalg.norm(result, axis=-1), 1e-9)
        near = cosine > np.cos(UNLIKE_PAINT)
        result[near] = mixed[near]
    return nearly_encoded(result)
