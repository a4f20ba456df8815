"""Base colours: textures, factors and vertex colours, against the standard's arithmetic one vertex at a time."""

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from capture4d.errors import InputError
from capture4d.mesh_files.meshes import read_coloured_mesh, read_mesh
from tests.gltf_files import GltfFile, grid

RNG = np.random.default_rng(8)
VERTICES, FACES, UV = grid()
PIXELS = RNG.integers(0, 256, (4, 4, 3)).astype(np.uint8)
CENTRES = (np.stack(np.meshgrid(np.arange(4), np.arange(4)), axis=-1).reshape(-1, 2) + 0.5) / 4
"""UVs, v down, that hit the middle of each pixel, row by row."""
METAL = "pbrMetallicRoughness"


def picture(pixels: np.ndarray = PIXELS, kind: str = "png") -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, kind, **({"lossless": True} if kind == "webp" else {}))
    return stream.getvalue()


def linear(byte: float) -> float:
    value = byte / 255
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def srgb(light: float) -> int:
    light = min(max(light, 0.0), 1.0)
    return round(255 * (12.92 * light if light <= 0.0031308 else 1.055 * light ** (1 / 2.4) - 0.055))


def expected(texture: np.ndarray | None, factor: Any, light: np.ndarray | None) -> list[list[int]]:
    """sRGB(linear(texture) * factor * COLOR_0)."""
    rows = []
    for vertex in range(16):
        row = []
        for channel in range(3):
            value = 1.0 if texture is None else linear(float(texture[vertex, channel]))
            value *= 1.0 if factor is None else factor[channel]
            row.append(srgb(value * (1.0 if light is None else float(light[vertex, channel]))))
        rows.append(row)
    return rows


def sheet(uv: np.ndarray = CENTRES, light: np.ndarray | None = None) -> tuple[GltfFile, dict[str, Any]]:
    file = GltfFile()
    attributes = {"POSITION": file.accessor(VERTICES), "TEXCOORD_0": file.accessor(uv)}
    if light is not None:
        attributes["COLOR_0"] = file.accessor(light)
    return file, file.primitive(attributes, indices=file.accessor(FACES.ravel(), 5123))


def colours(file: GltfFile, folder: Path) -> list[list[int]]:
    found = read_coloured_mesh(file.save(folder / "x.glb")).colours
    assert found is not None
    return found.tolist()


@pytest.mark.parametrize("textured", [True, False])
@pytest.mark.parametrize("factor", [None, [0.2, 0.5, 0.9, 1], [1, 1, 1, 0.5]])
@pytest.mark.parametrize("coloured", [True, False])
def test_all_that_colours_a_surface_is_multiplied(textured: bool, factor: Any, coloured: bool, tmp_path: Path) -> None:
    light = RNG.random((16, 3)).astype(np.float32) if coloured else None
    file, primitive = sheet(light=light)
    metal: dict[str, Any] = {} if factor is None else {"baseColorFactor": factor}
    if textured:
        metal["baseColorTexture"] = file.texture(picture())
    primitive["material"] = file.add("materials", {METAL: metal})
    if not (textured or factor or coloured):
        assert read_coloured_mesh(file.save(tmp_path / "x.glb")).colours is None
        return
    wanted = expected(PIXELS.reshape(16, 3) if textured else None, factor, light)
    assert colours(file, tmp_path) == wanted
    plain = read_mesh(tmp_path / "x.glb").colours
    assert plain is None if textured else plain is not None and plain.tolist() == wanted


def test_a_surface_without_colours_beside_one_with_them_is_white_or_of_its_base_colour(tmp_path: Path) -> None:
    light = RNG.random((16, 4)).astype(np.float32)
    file, _ = sheet(light=light)
    indices = {"indices": 2 + 1}
    file.primitive({"POSITION": 0}, **indices)
    file.primitive(
        {"POSITION": 0}, **indices, material=file.add("materials", {METAL: {"baseColorFactor": [0, 1, 0.5, 1]}})
    )
    found = colours(file, tmp_path)
    assert found[:16] == expected(None, None, light)
    assert found[16:32] == 16 * [[255, 255, 255]]
    assert found[32:] == 16 * [[0, 255, 188]]


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_each_surface_has_its_own_texture(suffix: str, tmp_path: Path) -> None:
    other = PIXELS[::-1].copy()
    file, first = sheet()
    first["material"] = file.add("materials", {METAL: {"baseColorTexture": file.texture(picture())}})
    second = file.primitive(dict(first["attributes"]), indices=first["indices"])
    second["material"] = file.add("materials", {METAL: {"baseColorTexture": file.texture(picture(other))}})
    found = read_coloured_mesh(file.save(tmp_path / f"x{suffix}")).colours
    assert found is not None
    np.testing.assert_array_equal(found, np.concatenate([PIXELS.reshape(16, 3), other.reshape(16, 3)]))


def test_the_factor_of_glossiness_goes_before_the_metal_one(tmp_path: Path) -> None:
    """Scans of some programs have their colours there."""
    light = RNG.random((16, 3)).astype(np.float32)
    file, primitive = sheet(light=light)
    glossy = {"diffuseFactor": [0.3, 0.6, 0.9, 1], "diffuseTexture": file.texture(picture())}
    material = {METAL: {"baseColorFactor": [0, 0, 0, 1]}, "extensions": {"KHR_materials_pbrSpecularGlossiness": glossy}}
    primitive["material"] = file.add("materials", material)
    file.tree["extensionsRequired"] = ["KHR_materials_pbrSpecularGlossiness"]
    assert colours(file, tmp_path) == expected(PIXELS.reshape(16, 3), [0.3, 0.6, 0.9], light)


def test_unlit_materials_have_base_colours(tmp_path: Path) -> None:
    file, primitive = sheet()
    material = {METAL: {"baseColorTexture": file.texture(picture())}, "extensions": {"KHR_materials_unlit": {}}}
    primitive["material"] = file.add("materials", material)
    file.tree["extensionsRequired"] = ["KHR_materials_unlit"]
    np.testing.assert_array_equal(colours(file, tmp_path), PIXELS.reshape(16, 3))


@pytest.mark.parametrize(("modes", "turn"), [
    ((10497, 10497), lambda t: t % 4),
    ((33071, 33071), lambda t: np.clip(t, 0, 3)),
    ((33648, 33648), lambda t: np.where(t % 8 < 4, t % 8, 7 - t % 8)),
])  # fmt: skip
def test_wrap_modes(modes: tuple[int, int], turn: Any, tmp_path: Path) -> None:
    """Pixels far outside of the picture, each way, along each axis."""
    columns, rows = np.meshgrid(np.array([-9, -5, 6, 11]), np.array([-6, -1, 4, 13]))
    uv = (np.column_stack([columns.ravel(), rows.ravel()]) + 0.5) / 4
    file, primitive = sheet(uv)
    primitive["material"] = file.add("materials", {METAL: {"baseColorTexture": file.texture(picture())}})
    sampler = file.add("samplers", {"wrapS": modes[0], "wrapT": modes[1]})
    file.tree["textures"][0]["sampler"] = sampler
    np.testing.assert_array_equal(colours(file, tmp_path), PIXELS[turn(rows.ravel()), turn(columns.ravel())])


def test_each_axis_wraps_as_it_says(tmp_path: Path) -> None:
    uv = np.tile([[1.125, 1.125]], (16, 1))
    file, primitive = sheet(uv)
    primitive["material"] = file.add("materials", {METAL: {"baseColorTexture": file.texture(picture())}})
    file.tree["textures"][0]["sampler"] = file.add("samplers", {"wrapS": 33071, "wrapT": 33648})
    assert colours(file, tmp_path)[0] == PIXELS[3, 3].tolist()
    file.tree["samplers"][0] = {"wrapT": 33071}
    assert colours(file, tmp_path)[0] == PIXELS[3, 0].tolist()
    file.tree["samplers"][0] = {"wrapT": 3}
    with pytest.raises(InputError, match="expected a wrap mode of glTF"):
        colours(file, tmp_path)


TRANSFORMS = [
    {"offset": [0.25, 0.5]},
    {"scale": [-1, 1], "offset": [1, 0]},
    {"rotation": np.pi / 2, "offset": [0, 1]},
    {"rotation": 0.7, "scale": [0.5, 0.3], "offset": [0.2, 0.4]},
    {},
]


@pytest.mark.parametrize("transform", TRANSFORMS)
def test_a_texture_transform_moves_the_uvs(transform: dict[str, Any], tmp_path: Path) -> None:
    """Scaled, turned counter-clockwise as UVs are drawn (v down), moved: what the file would hold without it."""
    angle = transform.get("rotation", 0.0)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    moved = CENTRES * transform.get("scale", [1, 1]) @ turn.T + transform.get("offset", [0, 0])
    wanted, primitive = sheet(moved)
    primitive["material"] = wanted.add("materials", {METAL: {"baseColorTexture": wanted.texture(picture())}})
    file, primitive = sheet()
    texture = file.texture(picture())
    texture["extensions"] = {"KHR_texture_transform": transform}
    primitive["material"] = file.add("materials", {METAL: {"baseColorTexture": texture}})
    file.tree["extensionsRequired"] = ["KHR_texture_transform"]
    first, second = (read_coloured_mesh(each.save(tmp_path / "x.glb")) for each in (wanted, file))
    assert first.colours is not None
    assert second.colours is not None
    assert np.abs(first.colours.astype(int) - second.colours).max() <= 1, "UVs of 32 bits"
    assert first.mesh.uv is not None
    np.testing.assert_allclose(second.mesh.uv, first.mesh.uv, atol=1e-6)


def test_the_example_of_the_texture_transform_shows_the_lower_left_quarter(tmp_path: Path) -> None:
    """ "Only the lower left quadrant of the source image, rotated clockwise 90 degrees"."""
    file, primitive = sheet()
    transform = {"offset": [0, 1], "rotation": 1.57079632679, "scale": [0.5, 0.5]}
    texture = file.texture(picture(), **transform)
    primitive["material"] = file.add("materials", {METAL: {"baseColorTexture": texture}})
    uv = read_mesh(file.save(tmp_path / "x.glb")).mesh.uv
    assert uv is not None
    assert uv.min() >= 0
    assert uv.max() <= 0.5
    corner = uv.reshape(-1, 2)[np.flatnonzero(FACES.ravel() == 0)[0]]
    np.testing.assert_allclose(corner, [0.0625, 0.0625], atol=1e-6, err_msg="top left shows bottom left: clockwise")


@pytest.mark.parametrize("overridden", [False, True])
def test_the_uvs_are_those_that_the_texture_names(overridden: bool, tmp_path: Path) -> None:
    file, primitive = sheet(np.zeros((16, 2)))
    primitive["attributes"]["TEXCOORD_1"] = file.accessor(CENTRES)
    texture = file.texture(picture())
    texture["texCoord"] = 0 if overridden else 1
    if overridden:
        texture["extensions"] = {"KHR_texture_transform": {"texCoord": 1}}
    primitive["material"] = file.add("materials", {METAL: {"baseColorTexture": texture}})
    np.testing.assert_array_equal(colours(file, tmp_path), PIXELS.reshape(16, 3))
    uv = read_mesh(tmp_path / "x.glb").mesh.uv
    assert uv is not None
    np.testing.assert_allclose(uv, ([0, 1] + CENTRES * [1, -1])[FACES], atol=1e-6)


def test_a_texture_without_its_uvs_is_one_line(tmp_path: Path) -> None:
    file, primitive = sheet()
    texture = file.texture(picture())
    texture["texCoord"] = 2
    primitive["material"] = file.add("materials", {METAL: {"baseColorTexture": texture}})
    with pytest.raises(InputError, match="expected TEXCOORD_2 in a primitive, found POSITION, TEXCOORD_0"):
        colours(file, tmp_path)
    assert read_mesh(tmp_path / "x.glb").mesh.uv is None


def test_uvs_that_are_no_numbers_leave_the_surface(tmp_path: Path) -> None:
    uv = CENTRES.copy()
    uv[3] = np.nan
    file, primitive = sheet(uv)
    primitive["material"] = file.add("materials", {METAL: {"baseColorTexture": file.texture(picture())}})
    found = read_coloured_mesh(file.save(tmp_path / "x.glb"))
    assert found.mesh.uv is None
    assert found.notes == ("1 of 1 surfaces have UVs that are no numbers: the mesh is without",)
    assert found.colours is not None
    others = np.arange(16) != 3
    np.testing.assert_array_equal(found.colours[others], PIXELS.reshape(16, 3)[others])


# --- images ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["png", "webp", "bmp", "tiff"])
def test_images_of_several_kinds(kind: str, tmp_path: Path) -> None:
    file, primitive = sheet()
    primitive["material"] = file.add("materials", {METAL: {"baseColorTexture": file.texture(picture(kind=kind))}})
    if kind == "webp":
        file.tree["textures"][0] = {"extensions": {"EXT_texture_webp": {"source": 0}}}
        file.tree["extensionsRequired"] = ["EXT_texture_webp"]
    np.testing.assert_array_equal(colours(file, tmp_path), PIXELS.reshape(16, 3))


@pytest.mark.parametrize(("name", "kind"), [("KHR_texture_basisu", "KTX2/Basis"), ("EXT_texture_avif", "AVIF")])
def test_what_nothing_here_decodes_is_named_unless_there_is_another(name: str, kind: str, tmp_path: Path) -> None:
    file, primitive = sheet()
    primitive["material"] = file.add("materials", {METAL: {"baseColorTexture": file.texture(picture())}})
    packed = file.add("images", {"bufferView": 0, "mimeType": "image/ktx2"})
    file.tree["extensionsRequired"] = [name]
    file.tree["textures"][0] = {"source": 0, "extensions": {name: {"source": packed}}}
    np.testing.assert_array_equal(colours(file, tmp_path), PIXELS.reshape(16, 3))
    del file.tree["textures"][0]["source"]
    with pytest.raises(
        InputError, match=rf"textures\[0\]: expected a PNG or JPEG image, found {kind} alone \({name}\)"
    ):
        colours(file, tmp_path)
    assert len(read_mesh(tmp_path / "x.glb").mesh.vertices) == 16, "the surface is there all the same"


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"\xabKTX 20\xbb\r\n\x1a\n", "found KTX2/Basis"),
        (b"\0\0\0\x20ftypavif", "found AVIF"),
        (b"DDS \x7c", "found DDS"),
        (b"%!PS-Adobe-3.0 EPSF-3.0", "not a readable image"),
    ],
)
def test_an_image_of_another_kind_is_named(data: bytes, said: str, tmp_path: Path) -> None:
    file, primitive = sheet()
    primitive["material"] = file.add("materials", {METAL: {"baseColorTexture": file.texture(data)}})
    with pytest.raises(InputError, match=rf"x\.glb: images\[0\]: .*{said}"):
        colours(file, tmp_path)
    (tmp_path / "t.png").write_bytes(data)
    file.tree["images"][0] = {"uri": "t.png"}
    with pytest.raises(InputError, match=rf"t\.png: .*{said}"):
        colours(file, tmp_path)


def test_an_image_is_opened_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many surfaces take their colours from it: a small file can name a large image often."""
    import capture4d.mesh_files.gltf.base_colours as module

    opened = []
    real = module.picture_pixels
    monkeypatch.setattr(module, "picture_pixels", lambda data: opened.append(1) or real(data))
    file, primitive = sheet()
    for _ in range(3):
        material = file.add("materials", {METAL: {"baseColorTexture": {"index": 0}}})
        primitive["material"] = material
        primitive = file.primitive(dict(primitive["attributes"]), indices=primitive["indices"])
    file.texture(picture())
    primitive["material"] = 0
    assert len(colours(file, tmp_path)) == 64
    assert len(opened) == 1


# --- whose colours are linear ------------------------------------------------------------------------------------


def test_a_file_may_say_that_its_vertex_colours_are_srgb(tmp_path: Path) -> None:
    bytes_ = RNG.integers(0, 256, (16, 3)).astype(np.uint8)
    file = GltfFile()
    attributes = {"POSITION": file.accessor(VERTICES), "COLOR_0": file.accessor(bytes_, 5121, fractions=True)}
    file.primitive(attributes, indices=file.accessor(FACES.ravel(), 5123))
    assert colours(file, tmp_path) == expected(None, None, bytes_ / 255)
    file.tree["asset"]["extras"] = {"capture4d": {"COLOR_0": "sRGB"}}
    np.testing.assert_array_equal(colours(file, tmp_path), bytes_)
    file.tree["asset"]["extras"] = ["capture4d"]
    assert colours(file, tmp_path) == expected(None, None, bytes_ / 255)


def test_colours_that_are_no_numbers_or_too_bright_are_still_colours(tmp_path: Path) -> None:
    light = np.tile(np.array([np.nan, 7.0, -1.0], np.float32), (16, 1))
    file, _ = sheet(light=light)
    assert colours(file, tmp_path) == 16 * [[0, 255, 0]]


def test_a_texture_does_not_begin_again_a_hair_beyond_its_edge(tmp_path: Path) -> None:
    """Where the rounding of a compressed coordinate puts it."""
    uv = np.tile([[1 + 2e-7, -3e-5]], (16, 1))
    file, primitive = sheet(uv)
    primitive["material"] = file.add("materials", {METAL: {"baseColorTexture": file.texture(picture())}})
    assert colours(file, tmp_path)[0] == PIXELS[0, 3].tolist()


def test_images_lie_in_the_json_or_beside_the_file(tmp_path: Path) -> None:
    body = base64.b64encode(picture()).decode()
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "ä b.png").write_bytes(picture())
    for uri in (f"data:image/png;base64,{body}", "inner/%C3%A4%20b.png", "inner/ä b.png", "inner\\ä b.png"):
        for suffix in (".glb", ".gltf"):
            file, primitive = sheet()
            file.add("images", {"uri": uri})
            texture = {"index": file.add("textures", {"source": 0})}
            primitive["material"] = file.add("materials", {METAL: {"baseColorTexture": texture}})
            found = read_coloured_mesh(file.save(tmp_path / f"x{suffix}")).colours
            np.testing.assert_array_equal(found, PIXELS.reshape(16, 3))
