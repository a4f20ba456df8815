"""Base colours of glTF surfaces at their vertices: texture times factor times vertex colour, in linear light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from capture4d.colours.spaces import encode_colours, linear_colours
from capture4d.errors import InputError
from capture4d.files.pictures import picture_pixels
from capture4d.files.reading import reading
from capture4d.mesh_files.gltf.accessors import normalised
from capture4d.mesh_files.gltf.document import Document
from capture4d.mesh_files.gltf.entries import count_of, extension, numbers_of
from capture4d.mesh_files.gltf.primitives import Primitive
from capture4d.mesh_files.textures import Wrap, sampled

__all__ = ["MARK", "base_colours", "texture_coordinates"]

MARK = ("capture4d", "COLOR_0")
"""Where the extras of a file's asset may say that its vertex colours are sRGB, which the standard has linear."""
_WRAPS: dict[int, Wrap] = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
_GLOSSINESS = "KHR_materials_pbrSpecularGlossiness"
_READABLE_ELSEWHERE = ("EXT_texture_webp",)
_UNREADABLE = {"KHR_texture_basisu": "KTX2/Basis", "EXT_texture_avif": "AVIF", "MSFT_texture_dds": "DDS"}
_MAGIC = {b"\xabKTX 20\xbb": "KTX2/Basis", b"\xabKTX 11\xbb": "KTX", b"DDS ": "DDS"}


@dataclass(frozen=True, slots=True, eq=False)
class _Paint:
    """What a material says of the base colour."""

    factor: Float64[np.ndarray, "3"] | None
    """Linear."""
    texture: dict[str, Any] | None


def base_colours(
    document: Document, primitives: list[Primitive], *, pictures: bool
) -> UInt8[np.ndarray, "verts 3"] | None:
    """sRGB of the vertices of all surfaces, None if nothing in the file says what colour they have.

    Args:
        pictures: whether textures are looked at; if not, what has one has no colours.
    """
    paints = [_paint(document, primitive) for primitive in primitives]
    textured = any(paint.texture is not None for paint in paints)
    factored = any(paint.factor is not None for paint in paints)
    if not (textured or factored or any("COLOR_0" in primitive.names for primitive in primitives)):
        return None
    if textured and not pictures:
        return None
    images = {index: _image(document, paint.texture) for index, paint in enumerate(paints) if paint.texture is not None}
    colours: dict[int, np.ndarray] = {}
    for image in sorted(set(images.values())):  # each is opened once, and one at a time
        picture = _picture(document, image)
        for index in (index for index, its in images.items() if its == image):
            colours[index] = _textured(document, primitives[index], paints[index], picture)
    for index, (primitive, paint) in enumerate(zip(primitives, paints, strict=True)):
        if index not in colours:
            colours[index] = _combined(document, primitive, paint, None)
    return np.concatenate([colours[index] for index in range(len(primitives))])


def texture_coordinates(document: Document, primitive: Primitive) -> Float64[np.ndarray, "verts 2"] | None:
    """UVs, v up: as the base colour texture is read with, or the first ones of a surface that has none."""
    texture = _paint(document, primitive).texture or {}
    return _coordinates(primitive, texture) if _coordinate_name(texture) in primitive.names else None


def _paint(document: Document, primitive: Primitive) -> _Paint:
    if primitive.material is None:
        return _Paint(None, None)
    material = document.entry("materials", primitive.material)
    glossy = extension(material, _GLOSSINESS)
    if glossy is not None:
        base, factor, texture = glossy, "diffuseFactor", "diffuseTexture"
    else:
        base, factor, texture = material.get("pbrMetallicRoughness") or {}, "baseColorFactor", "baseColorTexture"
    found = base.get(texture)
    if found is not None and not isinstance(found, dict):
        raise InputError(f"{texture}: expected an object, found {str(found)[:40]!r}")
    return _Paint(numbers_of(base, factor, np.ones(4))[:3] if base.get(factor) is not None else None, found)


def _combined(
    document: Document, primitive: Primitive, paint: _Paint, texture: np.ndarray | None
) -> UInt8[np.ndarray, "verts 3"]:
    """All that colours a surface.

    Args:
        texture: (V, 3), sRGB from 0 to 255.
    """
    count = len(primitive.vertices)
    if paint.factor is None and "COLOR_0" not in primitive.names:
        whole = np.full((count, 3), 255.0) if texture is None else texture
        return np.clip(np.rint(whole), 0, 255).astype(np.uint8)
    light = np.ones((count, 3)) if texture is None else linear_colours(texture)
    if paint.factor is not None:
        light = light * paint.factor
    if "COLOR_0" in primitive.names:
        light = light * _vertex_light(document, primitive)
    return encode_colours(light)


def _vertex_light(document: Document, primitive: Primitive) -> Float64[np.ndarray, "verts 3"]:
    """COLOR_0, linear as the standard has it; integers are fractions whether the file says so or not."""
    found = normalised(primitive.attribute("COLOR_0", (3, 4))[:, :3]).astype(np.float64)
    found = np.nan_to_num(found, nan=0, posinf=0, neginf=0)
    notes: Any = document.tree.get("asset")
    for name in ("extras", *MARK):
        notes = notes.get(name) if isinstance(notes, dict) else None
    return linear_colours(255 * np.clip(found, 0, 1)) if notes == "sRGB" else found


# --- textures ----------------------------------------------------------------------------------------------------


def _textured(
    document: Document, primitive: Primitive, paint: _Paint, picture: np.ndarray
) -> UInt8[np.ndarray, "verts 3"]:
    assert paint.texture is not None
    entry = document.entry("textures", paint.texture.get("index"))
    sampler = document.entry("samplers", entry["sampler"]) if entry.get("sampler") is not None else {}
    across, down = (sampler.get(name, 10497) for name in ("wrapS", "wrapT"))
    if across not in _WRAPS or down not in _WRAPS:
        raise InputError(f"sampler: expected a wrap mode of glTF, found {str((across, down))[:40]}")
    uv = np.nan_to_num(_coordinates(primitive, paint.texture), nan=0, posinf=0, neginf=0)
    return _combined(document, primitive, paint, sampled(picture, uv, wrap=(_WRAPS[across], _WRAPS[down])))


def _coordinate_name(texture: dict[str, Any]) -> str:
    moved = extension(texture, "KHR_texture_transform") or {}
    return f"TEXCOORD_{count_of(moved, 'texCoord', count_of(texture, 'texCoord', 0))}"


def _coordinates(primitive: Primitive, texture: dict[str, Any]) -> Float64[np.ndarray, "verts 2"]:
    """UVs, v up, with what KHR_texture_transform does to them.

    The sign of its rotation is that of its text and its example (the lower left quarter of the image, turned clockwise)
    and of the programs that read it; the matrix printed beside them turns the other way (KhronosGroup/glTF#1563).
    """
    uv = primitive.attribute(_coordinate_name(texture), (2,)).astype(np.float64)
    moved = extension(texture, "KHR_texture_transform")
    if moved is not None:
        u, v = (uv * numbers_of(moved, "scale", np.ones(2))).T
        angle = float(numbers_of({"rotation": [moved.get("rotation", 0.0)]}, "rotation", np.zeros(1))[0])
        cosine, sine = np.cos(angle), np.sin(angle)
        turned = np.column_stack([cosine * u + sine * v, cosine * v - sine * u])
        uv = turned + numbers_of(moved, "offset", np.zeros(2))
    return np.column_stack([uv[:, 0], 1 - uv[:, 1]])


def _image(document: Document, texture: dict[str, Any]) -> int:
    """The image of a texture, in a format that is read if there is one."""
    index = texture.get("index")
    entry = document.entry("textures", index)
    sources = [entry.get("source"), *((extension(entry, name) or {}).get("source") for name in _READABLE_ELSEWHERE)]
    for source in sources:
        if source is not None:
            document.entry("images", source)
            return source
    for name, kind in _UNREADABLE.items():
        if extension(entry, name) is not None:
            raise InputError(f"textures[{index}]: expected a PNG or JPEG image, found {kind} alone ({name})")
    raise InputError(f"textures[{index}]: expected an image, found none")


def _picture(document: Document, index: int) -> UInt8[np.ndarray, "rows columns 3"]:
    uri = document.entry("images", index).get("uri")
    if isinstance(uri, str) and uri[:5].lower() != "data:":
        beside = document.beside("images", uri)
        with reading(beside, "image"):
            return _pixels("", beside.read_bytes())
    return _pixels(f"images[{index}]: ", document.bytes_of("images", index))


def _pixels(where: str, data: bytes) -> UInt8[np.ndarray, "rows columns 3"]:
    kind = next((kind for magic, kind in _MAGIC.items() if data.startswith(magic)), None)
    kind = "AVIF" if data[4:8] == b"ftyp" and data[8:12] in (b"avif", b"avis") else kind
    if kind is not None:
        raise InputError(f"{where}expected a PNG or JPEG image, found {kind}")
    try:
        return picture_pixels(data)
    except InputError as error:
        raise InputError(f"{where}{error.reason}") from error
