"""The coordinates of normal maps, and their form on disk.

world     as registered and scanned
garment   world turned back by the garment's own rigid rotation: what networks learn from. A subject who turns round
          does not change it; a tangent-space low map would be the same in every frame, and useless as a condition
tangent   relative to the template's tangent frames, OpenGL's +Y: what renderers take, and what survives a new body

DeepWrinkles (ECCV 2018), section 3.3, learns in "global coordinates"; taking the subject's turn out is ours.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8, UInt16

from capture4d.errors import InputError
from capture4d.files.pictures import holds_pixels

__all__ = [
    "decode_png",
    "encode_png",
    "encode_png8",
    "flip_green",
    "garment_rotation",
    "to_colours",
    "to_tangent",
]


def garment_rotation(
    template: Float[np.ndarray, "V 3"], vertices: Float[np.ndarray, "V 3"]
) -> Float64[np.ndarray, "3 3"]:
    """The rotation that carries the template nearest to a frame, in the least-squares sense (Kabsch).

    It follows the trunk, needs no poses, and turns exactly with the subject. `normals @ rotation` are world normals in
    garment coordinates.
    """
    before = template.astype(np.float64) - template.mean(axis=0, dtype=np.float64)
    after = vertices.astype(np.float64) - vertices.mean(axis=0, dtype=np.float64)
    left, _, right = np.linalg.svd(after.T @ before)
    handedness = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    return left @ handedness @ right


def to_tangent(normals: Float[np.ndarray, "N 3"], frames: Float[np.ndarray, "N 3 3"]) -> Float[np.ndarray, "N 3"]:
    """Global normals in tangent frames (rows tangent, bitangent, normal)."""
    return np.einsum("nrc,nc->nr", frames, normals)


def flip_green(image: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    """OpenGL's +Y to DirectX's -Y, and back."""
    return image * np.array([1, -1, 1], image.dtype)


def to_colours(image: Float[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """RGB = (n + 1) / 2 in 8 bit, for looking at; zero, no information, is mid-grey."""
    return np.clip(np.round(127.5 * (image + 1)), 0, 255).astype(np.uint8)


def encode_png(image: Float[np.ndarray, "H W 3"], valid: Bool[np.ndarray, "H W"] | None = None) -> bytes:
    """A 16-bit PNG with RGB = (n + 1) / 2, and validity as alpha. The error is 0.001 deg."""
    channels = np.clip(np.round(32767.5 * (image.astype(np.float64) + 1)), 0, 65535).astype(np.uint16)
    pixels = channels[..., ::-1]
    if valid is not None:
        pixels = np.dstack([pixels, np.where(valid, 65535, 0).astype(np.uint16)])
    good, data = cv2.imencode(".png", np.ascontiguousarray(pixels), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert good
    return data.tobytes()


def encode_png8(image: Float[np.ndarray, "H W 3"]) -> bytes:
    """An 8-bit PNG for delivery; 0.17 deg are lost in the mean. Flat is (128, 128, 255), as tools expect."""
    pixels = np.clip(np.floor(127.5 * (image.astype(np.float64) + 1) + 0.5), 0, 255).astype(np.uint8)
    good, data = cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))
    assert good
    return data.tobytes()


def decode_png(data: bytes, *, source: str) -> tuple[Float32[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """A map and its mask; everything is valid where there is no alpha.

    Raises:
        InputError: `source` is not a 16-bit colour PNG, cut off or damaged.
    """
    try:
        whole = data and holds_pixels(data)
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if whole else None
    except cv2.error:  # of a header that claims more than OpenCV reads
        pixels = None
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 3:
        raise InputError("expected a 16-bit colour PNG, found none, or one that is damaged", where=source)
    image = _decoded(pixels)
    valid = pixels[..., 3] > 32767 if pixels.shape[2] == 4 else np.ones(pixels.shape[:2], bool)
    return image, valid


def _decoded(pixels: UInt16[np.ndarray, "H W channels"]) -> Float32[np.ndarray, "H W 3"]:
    return pixels[..., 2::-1].astype(np.float32) / np.float32(32767.5) - 1
