"""Paint in files beside a mesh: materials of an mtl file, and the pictures they name, as colours at the vertices.

A material's colour is its texture's alone where it has one (exporters write any `Kd` beside it), else its `Kd`, which
counts as sRGB as it does in most viewers. A face has the paint of its own material, a vertex the mean of its corners.
"""

from __future__ import annotations

import os
import re
import unicodedata
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float64, Integer, UInt8

from capture4d.errors import InputError
from capture4d.files.pictures import read_picture
from capture4d.files.reading import companion, one_line
from capture4d.files.text_lines import number, plain_text
from capture4d.mesh_files.polygons import Painted, unit_colours
from capture4d.mesh_files.textures import mean_at_vertices, sampled

__all__ = ["Material", "Texture", "companion_anyhow", "decoded", "paint_at_vertices", "read_materials"]

_ARGUMENTS = dict.fromkeys(
    ("-blendu", "-blendv", "-boost", "-bm", "-cc", "-clamp", "-colorspace", "-imfchan", "-texres", "-type"), 1
) | {"-mm": 2}
"""How many words follow an option of a map; -s, -o and -t have one to three numbers."""
_MOST_LIBRARIES = 1000
_UP_TO_THREE = ("-s", "-o", "-t")
_WORD = re.compile(r"\s*(\S+)\s*")
_QUOTED_OR_WORD = re.compile(r'"([^"]+)"|(\S+)')


@dataclass(frozen=True, slots=True)
class Texture:
    """A picture as a material uses it."""

    name: str
    """As it stands in the file."""
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    """The picture is read at scale * UV + offset."""
    clamped: bool = False
    """Whether it ends at its borders; else it repeats."""


@dataclass(frozen=True, slots=True)
class Material:
    """What a face is painted with."""

    colour: tuple[float, float, float] | None = None
    """From 0 to 1."""
    texture: Texture | None = None


def paint_at_vertices(path: Path, painted: Painted) -> tuple[UInt8[np.ndarray, "verts 3"] | None, tuple[str, ...]]:
    """Colours from the files that a mesh file names, and what to note of them; None if no face has any.

    Raises:
        InputError: a file that a face needs is missing, damaged, or lies elsewhere.
    """
    materials, which, notes = _materials_of(path, painted)
    if not materials:
        return None, notes
    faces = painted.found.mesh.faces
    colours = np.full((len(faces), 3, 3), np.nan)
    order = np.argsort(which, kind="stable")
    firsts = np.searchsorted(which[order], np.arange(len(materials) + 1))

    files: dict[Path, list[int]] = {}
    for index in np.unique(which[which >= 0]).tolist():
        material = materials[index]
        if material.texture is None:
            colours[order[firsts[index] : firsts[index + 1]]] = 255 * np.array(material.colour or np.nan)
        elif painted.uv is not None:
            files.setdefault(_first_there(path, _spellings(material.texture.name), "texture"), []).append(index)
    for file, indices in files.items():
        picture = read_picture(file)
        for index in indices:
            own, texture = order[firsts[index] : firsts[index + 1]], materials[index].texture
            if texture is not None and painted.uv is not None:
                colours[own] = _sampled(picture, texture, painted.uv[own])
    known = np.isfinite(colours).all(axis=2)
    if not known.any():
        return None, notes
    found = mean_at_vertices(faces[known], colours[known], len(painted.found.mesh.vertices))
    bare = len(np.unique(faces)) - len(np.unique(faces[known]))
    return found, (*notes, f"{bare} of {len(found)} vertices are in no painted face: black") if bare else notes


def _sampled(picture: np.ndarray, texture: Texture, uv: np.ndarray) -> Float64[np.ndarray, "faces 3 3"]:
    """A picture at the corners of faces; NaN where they have no UVs."""
    place = uv.reshape(-1, 2) * np.array(texture.scale) + np.array(texture.offset)
    known = np.isfinite(place).all(axis=1)
    colours = np.full((len(place), 3), np.nan)
    colours[known] = sampled(picture, np.clip(place[known], 0, 1) if texture.clamped else place[known])
    return colours.reshape(-1, 3, 3)


def _materials_of(
    path: Path, painted: Painted
) -> tuple[list[Material], Integer[np.ndarray, " faces"], tuple[str, ...]]:
    """Materials, which of them each face has, -1 for none, and notes."""
    count = len(painted.found.mesh.faces)
    paint = painted.paint
    if painted.images:
        if paint is None and len(set(painted.images)) > 1:
            raise InputError(
                f"expected one texture, or a texnumber of every face, found {len(painted.images)} textures"
            )
        materials = [Material(texture=Texture(name)) for name in painted.images]
        which = np.zeros(count, np.int64) if paint is None else np.where(paint < len(materials), paint, -1)
        return materials, np.maximum(which, -1), ()
    if not painted.libraries:
        return [], np.full(count, -1), ()
    known, missing = _read_libraries(path, painted.libraries)
    if paint is None:
        notes = () if missing is None else (f"{missing}",)
        textured = {material.texture: material for material in known.values() if material.texture}
        chosen = list((textured or known).values())
        if len(chosen) > 1:
            raise InputError(f"expected usemtl lines, for there are {len(chosen)} materials, found none")
        return chosen, np.full(count, len(chosen) - 1), notes
    used = [painted.names[index] for index in np.unique(paint[paint >= 0])]
    folded = {name.casefold(): material for name, material in known.items()}
    found = {name: _looked_up(known, folded, name) for name in used}
    unknown = sorted(name for name, material in found.items() if material is None)
    if unknown and missing is not None:
        raise missing
    notes = (f"no material '{unknown[0][:80]}' in {', '.join(painted.libraries)[:80]}",) if unknown else ()
    return [found.get(name) or Material() for name in painted.names], paint, notes


def _looked_up(known: dict[str, Material], folded: dict[str, Material], name: str) -> Material | None:
    """The material of a name, of that name in another case, or of the name without a comment behind it."""
    bare = name.partition(" #")[0].strip()
    for each in (name, bare):
        if each in known or each.casefold() in folded:
            return known.get(each) or folded[each.casefold()]
    return None


# --- mtl files -------------------------------------------------------------------------------------------------------


def _read_libraries(path: Path, names: tuple[str, ...]) -> tuple[dict[str, Material], InputError | None]:
    """The materials of all files that are there, and the fault of the first that is not.

    What stands behind `mtllib` is one name with spaces in it, or several names.
    """
    words_of = {
        text: list(dict.fromkeys(quoted or word for quoted, word in _QUOTED_OR_WORD.findall(text))) for text in names
    }
    count = sum(len(words) for words in words_of.values())
    if count > _MOST_LIBRARIES:
        raise InputError(f"expected at most {_MOST_LIBRARIES} files of materials, found {count}")
    known: dict[str, Material] = {}
    missing = None
    for text, words in words_of.items():
        files, fault = _library_files(path, text, words)
        missing = missing or fault
        for file in files:
            known = read_materials(file) | known
    return known, missing


def _library_files(path: Path, text: str, words: list[str]) -> tuple[list[Path], InputError | None]:
    """The files of one line that are there, and the fault of the first that is not."""
    try:
        return [_first_there(path, _spellings(text), "materials")], None
    except InputError as error:
        if len(words) == 1:
            return [], error
    files, missing = [], None
    for word in words:
        try:
            files.append(companion_anyhow(path, word, "materials"))
        except InputError as error:
            missing = missing or error
    return files, missing


def read_materials(path: Path) -> dict[str, Material]:
    """The materials of an mtl file, by name; of two with one name, the first."""
    try:
        lines = decoded(plain_text(path.read_bytes())).splitlines()
    except InputError as error:
        raise error.at(path) from None
    entries: dict[str, dict[str, str]] = {}
    own: dict[str, str] = {}
    for line in lines:
        keyword, _, rest = line.strip().replace("\t", " ").partition(" ")
        if keyword.lower() == "newmtl":
            own = {}
            entries.setdefault(rest.strip(), own)
        own.setdefault(keyword.lower(), rest.strip())
    return {name: _material(own) for name, own in entries.items()}


def _material(entries: dict[str, str]) -> Material:
    picture = entries.get("map_kd") or entries.get("map_ka")
    return Material(_colour(entries.get("kd", "")), _texture(picture) if picture else None)


def _colour(text: str) -> tuple[float, float, float] | None:
    """Of `Kd r g b`, or `Kd grey`; None for what names a spectrum."""
    try:
        values = [number(word.encode()) for word in text.partition("#")[0].split()[:3]]
    except ValueError:
        return None
    if len(values) not in (1, 3) or not np.isfinite(values).all():
        return None
    red, green, blue = unit_colours(np.array([values * (3 // len(values))], np.float64))[0].tolist()
    return red, green, blue


def _texture(text: str) -> Texture | None:
    """Of what stands behind `map_Kd`: options with their words, then a file name, which may have spaces in it."""
    scale, offset, clamped, place = [1.0, 1.0], [0.0, 0.0], False, 0
    while (found := _WORD.match(text, place)) and (option := found[1].lower()) in (*_ARGUMENTS, *_UP_TO_THREE):
        place = found.end()
        words: list[str] = []
        most = _ARGUMENTS.get(option, 3)
        while len(words) < most and (word := _WORD.match(text, place)) and word.end() < len(text):
            if option in _UP_TO_THREE and not _is_number(word[1]):
                break
            words.append(word[1])
            place = word.end()
        if option == "-clamp":
            clamped = [word.lower() for word in words] == ["on"]
        elif option in ("-s", "-o"):
            pair = scale if option == "-s" else offset
            pair[: len(words[:2])] = [float(word) for word in words[:2]]
    name = text[place:].strip()
    return Texture(name, (scale[0], scale[1]), (offset[0], offset[1]), clamped) if name else None


def _is_number(word: str) -> bool:
    try:
        return bool(np.isfinite(number(word.encode())))
    except ValueError:
        return False


def decoded(text: bytes) -> str:
    """Text as UTF-8, or as Windows of western Europe wrote it."""
    try:
        return text.decode("utf-8")
    except UnicodeDecodeError:
        return text.decode("cp1252", errors="replace")


# --- names of files --------------------------------------------------------------------------------------------------


def _spellings(text: str) -> list[str]:
    """What a name may be that stands at the end of a line: all of it; without quotes, a comment behind, or escapes."""
    bare = text.partition(" #")[0].strip()
    return list(dict.fromkeys([text, text.strip("\"'"), bare, bare.strip("\"'"), unquote(text)]))


def _first_there(path: Path, names: list[str], what: str) -> Path:
    fault = None
    for name in names:
        try:
            return companion_anyhow(path, name, what)
        except InputError as error:
            fault = fault or error
    assert fault is not None
    raise fault


def companion_anyhow(path: Path, name: str, what: str) -> Path:
    r"""The file that another file names, as a program on another system may have written it.

    With \ for /, in other letters' case, or absolute: then the file of that name beside the mesh.

    Raises:
        InputError: as `companion`.
    """
    spelled = name.replace("\\", "/")
    inside = PurePosixPath(spelled)
    elsewhere = inside.is_absolute() or bool(PureWindowsPath(name).drive)
    try:
        return companion(path, name if elsewhere or (path.parent / name).is_file() else spelled, what)
    except InputError as error:
        fault = error
    except OSError as error:  # a name that no system allows
        raise InputError(f"{one_line(error)}, the {what} of {path.name}", where=path) from None
    if elsewhere:
        inside = PurePosixPath(PureWindowsPath(name).name)
    real = _in_any_case(path.parent, inside.parts)
    if real is None:
        raise fault
    return companion(path, real, what)


def _in_any_case(folder: Path, parts: tuple[str, ...]) -> str | None:
    """The path of that name below a folder, whatever the case of its letters."""
    found: list[str] = []
    for part in parts:
        place = folder.joinpath(*found)
        if part == ".." or "\0" in part or not place.is_dir():
            return None
        entries = sorted(os.listdir(place), key=lambda entry: (entry != part, entry))
        same = [entry for entry in entries if _folded(entry) == _folded(part)]
        if not same:
            return None
        found.append(same[0])
    return "/".join(found) or None


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()
