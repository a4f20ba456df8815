"""Materials and textures as exporters name them: every face has its own paint, or one line says why not."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from capture4d.errors import InputError
from capture4d.mesh_files.materials import read_materials
from capture4d.mesh_files.meshes import read_coloured_mesh, read_mesh

RED, GREEN, BLUE = (200, 10, 20), (30, 180, 40), (50, 60, 170)
BLACK = (0, 0, 0)


def picture(path: Path, colour: tuple[int, int, int]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (4, 4), colour).save(path)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, colour in (("r.png", RED), ("g.png", GREEN), ("textures/b.png", BLUE)):
        picture(tmp_path / name, colour)
    return tmp_path


def obj(*faces: str, library: str = "mtllib x.mtl", texture: bool = True) -> str:
    """Triangles that share no vertex, each behind its own lines."""
    lines = [library]
    for index, before in enumerate(faces):
        lines += [f"v {index} 0 0", f"v {index} 1 0", f"v {index} 0 1", "vt 0.1 0.2", "vt 0.9 0.2", "vt 0.1 0.8"]
        lines += [line for line in before.split("\n") if line]
        corners = range(3 * index + 1, 3 * index + 4)
        lines.append("f " + " ".join(f"{corner}/{corner}" if texture else f"{corner}" for corner in corners))
    return "\n".join(lines) + "\n"


def colours(folder: Path, text: str, materials: str | bytes | None = None) -> list[tuple[int, ...]] | None:
    """One of each face, whose corners must have the same."""
    (folder / "x.obj").write_text(text, encoding="utf-8")
    if materials is not None:
        (folder / "x.mtl").write_bytes(materials if isinstance(materials, bytes) else materials.encode())
    found = read_coloured_mesh(folder / "x.obj").colours
    if found is None:
        return None
    by_face = found.reshape(-1, 3, 3)
    assert (by_face == by_face[:, :1]).all()
    return [tuple(each) for each in by_face[:, 0].tolist()]


TWO = "newmtl a\nmap_Kd r.png\nnewmtl b\nmap_Kd g.png\n"


def test_each_face_has_its_own_texture_or_colour(folder: Path):
    materials = (
        TWO + "newmtl c\nKd 0.2 0.4 0.6\nnewmtl d\nKd 0 0 0\nmap_Kd textures/b.png\nnewmtl unused\nmap_Kd no.png\n"
    )
    text = obj("usemtl b", "usemtl a", "usemtl c", "", "usemtl d", "usemtl b")
    assert colours(folder, text, materials) == [GREEN, RED, (51, 102, 153), (51, 102, 153), BLUE, GREEN]


def test_a_vertex_between_two_materials_has_the_mean(folder: Path):
    (folder / "x.mtl").write_text(TWO)
    head = "mtllib x.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nvt .5 .5\n"
    (folder / "x.obj").write_text(f"{head}usemtl a\nf 1/1 2/1 3/1\nusemtl b\nf 2/1 4/1 3/1\n")
    found = read_coloured_mesh(folder / "x.obj").colours
    assert found is not None
    between = tuple(np.rint((np.array(RED) + GREEN) / 2).astype(int).tolist())
    assert [tuple(row) for row in found.tolist()] == [RED, between, between, GREEN]


def test_trimesh_agrees_about_which_face_has_which_texture(tmp_path: Path):
    """It makes a mesh of each material, with the picture that it read."""
    rng = np.random.default_rng(3)
    paints = rng.integers(0, 256, (6, 3))
    for index, paint in enumerate(paints.tolist()):
        picture(tmp_path / f"t {index}.png", (paint[0], paint[1], paint[2]))
    (tmp_path / "x.mtl").write_text("".join(f"newmtl m{index}\nmap_Kd t {index}.png\n" for index in range(6)))
    (tmp_path / "x.obj").write_text(obj(*(f"usemtl m{index}" for index in rng.integers(0, 6, 40))))
    found = read_coloured_mesh(tmp_path / "x.obj")
    assert found.colours is not None
    ours = {
        tuple(np.sort(found.mesh.vertices[face], axis=0).ravel().tolist()): found.colours[face[0]].tolist()
        for face in found.mesh.faces
    }
    theirs = {}
    for mesh in trimesh.load(tmp_path / "x.obj", process=False, force="scene").geometry.values():
        paint = list(mesh.visual.material.image.convert("RGB").getpixel((0, 0)))
        theirs |= {tuple(np.sort(triangle, axis=0).ravel().tolist()): paint for triangle in mesh.triangles}
    assert len(ours) == 40
    assert ours == theirs


ONE_NAME = {
    "as it is": "newmtl a\nmap_Kd r.png",
    "byte order mark": b"\xef\xbb\xbfnewmtl a\nmap_Kd r.png",
    "CRLF": "newmtl a\r\nmap_Kd r.png\r\n",
    "CR": "newmtl a\rmap_Kd r.png\r",
    "small letters": "newmtl a\nmap_kd r.png",
    "capitals": "NEWMTL a\nMAP_KD r.png",
    "indented": "newmtl a\n\tmap_Kd\tr.png\n",
    "blanks behind": "newmtl a \nmap_Kd r.png  \t\n",
    "the ambient map alone": "newmtl a\nmap_Ka r.png",
    "another ambient map": "newmtl a\nmap_Ka no.png\nmap_Kd r.png",
    "maps of other things": "newmtl a\nmap_d no.png\nmap_Bump -bm 1 no.png\nbump no.png\nmap_Ks no.png\nmap_Kd r.png",
    "a grey beside it": "newmtl a\nKd 0.8 0.8 0.8\nmap_Kd r.png",
    "black beside it": "newmtl a\nmap_Kd r.png\nKd 0 0 0",
    "twice": "newmtl a\nmap_Kd r.png\nnewmtl a\nmap_Kd g.png",
    "a comment behind": "newmtl a\nmap_Kd r.png # diffuse",
    "comments": "# map_Kd no.png\nnewmtl a\n# newmtl b\nmap_Kd r.png",
    "double quotes": 'newmtl a\nmap_Kd "r.png"',
    "single quotes": "newmtl a\nmap_Kd 'r.png'",
    "a folder": "newmtl a\nmap_Kd ./r.png",
    "a folder as on Windows": "newmtl a\nmap_Kd .\\r.png",
    "escaped": "newmtl a\nmap_Kd %72.png",
    "other case": "newmtl a\nmap_Kd R.PNG",
    "absolute on Windows": "newmtl a\nmap_Kd C:\\Users\\me\\My Scans\\r.png",
    "absolute on Windows, with slashes": "newmtl a\nmap_Kd D:/scans/r.png",
    "absolute on Windows, other case": "newmtl a\nmap_Kd C:\\SCANS\\R.PNG",
    "of a server": "newmtl a\nmap_Kd \\\\server\\share\\r.png",
    "absolute": "newmtl a\nmap_Kd /home/me/scans/r.png",
    "scale": "newmtl a\nmap_Kd -s 1 1 1 r.png",
    "scale of two": "newmtl a\nmap_Kd -s 2 2 r.png",
    "offset of one": "newmtl a\nmap_Kd -o 0.5 r.png",
    "all options": "newmtl a\nmap_Kd -blendu on -blendv off -boost 2 -mm 0 1 -o 0 0 0 -s 1 1 1 -t 0 0 0 -texres 512 "
    "-clamp on -bm 1 -imfchan r -type sphere -cc on -colorspace linear r.png",
    "options in capitals": "newmtl a\nmap_Kd -S 1 1 1 -Clamp on r.png",
    "turbulence": "newmtl a\nmap_Kd -t 1 1 1 r.png",
    "opacity and the rest": "newmtl a\nNs 10\nKa 1 1 1\nd 1\nTr 0\nillum 2\nmap_Kd r.png\nmap_d r.png",
}


@pytest.mark.parametrize("name", ONE_NAME)
@pytest.mark.parametrize("used", ["usemtl a", ""])
def test_a_texture_however_it_is_named(name: str, used: str, folder: Path):
    assert colours(folder, obj(used), ONE_NAME[name]) == [RED]


FILES = ["my texture.png", "a  b.png", "haut#1.png", "Größe.png", "1 2 3.png", "-s.png", "r.JPG.png", "sub dir/t.png"]


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("spelled", ["{}", '"{}"', "-s 1 1 1 {}", "-clamp on {}", "-o 0 0 0 {}"])
def test_names_of_files(name: str, spelled: str, tmp_path: Path):
    picture(tmp_path / name, BLUE)
    assert colours(tmp_path, obj("usemtl a"), f"newmtl a\nmap_Kd {spelled.format(name)}\n") == [BLUE]
    (tmp_path / "my materials.mtl").write_text(f"newmtl a\nmap_Kd {name}\n", encoding="utf-8")
    assert colours(tmp_path, obj("usemtl a", library="mtllib my materials.mtl")) == [BLUE]


def test_a_name_of_western_europe(tmp_path: Path):
    picture(tmp_path / "Größe.png", BLUE)
    assert colours(tmp_path, obj("usemtl a"), "newmtl a\nmap_Kd Größe.png\n".encode("cp1252")) == [BLUE]


@pytest.mark.parametrize("name", ["textures\\b.png", "Textures/B.PNG", ".\\TEXTURES\\b.png", "textures//b.png"])
def test_names_of_files_below(name: str, folder: Path):
    assert colours(folder, obj("usemtl a"), f"newmtl a\nmap_Kd {name}\n") == [BLUE]


LIBRARIES = [
    "mtllib a.mtl b.mtl",
    "mtllib a.mtl\nmtllib b.mtl",
    'mtllib "a.mtl" "b.mtl"',
    "mtllib A.MTL b.mtl",
    "mtllib a.mtl b.mtl missing.mtl",
    "mtllib missing.mtl\nmtllib b.mtl a.mtl",
    "MTLLIB .\\a.mtl\nmtllib b.mtl",
]


@pytest.mark.parametrize("library", LIBRARIES)
def test_several_files_of_materials(library: str, folder: Path):
    for name, texture in (("a", "r"), ("b", "g")):
        (folder / f"{name}.mtl").write_text(f"newmtl {name}\nmap_Kd {texture}.png\n")
    assert colours(folder, obj("usemtl b", "usemtl a", library=library)) == [GREEN, RED]


def halves(path: Path) -> None:
    pixels = np.zeros((1, 64, 3), np.uint8)
    pixels[:, :32], pixels[:, 32:] = RED, GREEN
    Image.fromarray(pixels).save(path)


@pytest.mark.parametrize(
    ("options", "u", "expected"),
    [
        ("", 0.2, RED), ("", 0.7, GREEN), ("", 1.2, RED), ("", -0.2, GREEN),
        ("-s 2 1 1", 0.3, GREEN), ("-s 0.5 1 1", 0.7, RED), ("-s 2", 0.6, RED),
        ("-o 0.5 0 0", 0.2, GREEN), ("-o 0.5", 0.7, RED), ("-s 2 1 1 -o 0.5 0 0", 0.1, GREEN),
        ("-clamp on", 1.2, GREEN), ("-clamp on", -0.2, RED), ("-clamp off", 1.2, RED),
    ],
)  # fmt: skip
def test_options_move_the_picture(options: str, u: float, expected: tuple[int, ...], tmp_path: Path):
    halves(tmp_path / "t.png")
    text = re.sub(r"vt \S+", f"vt {u}", obj("usemtl a"))
    assert colours(tmp_path, text, f"newmtl a\nmap_Kd {options} t.png\n") == [expected]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("Kd 0.2 0.4 0.6", (51, 102, 153)), ("kd 1 0 0 # red", (255, 0, 0)), ("Kd 0.2", (51, 51, 51)),
        ("Kd 1.0003 0 0", (255, 0, 0)), ("Kd 128 64 32", (128, 64, 32)), ("  Kd\t0\t0\t0", BLACK),
    ],
)  # fmt: skip
def test_a_colour_without_a_texture_or_uvs(line: str, expected: tuple[int, ...], tmp_path: Path):
    for used in ("usemtl a", ""):
        assert colours(tmp_path, obj(used, texture=False), f"newmtl a\n{line}\n") == [expected]


@pytest.mark.parametrize("line", ["Kd spectral file.rfl 1", "Kd xyz 1 1 1", "Kd nan 0 0", "Kd", "Ka 1 0 0", "Kd 1 1"])
def test_a_material_without_a_colour(line: str, tmp_path: Path):
    assert colours(tmp_path, obj("usemtl a", texture=False), f"newmtl a\n{line}\n") is None


def test_faces_without_paint_are_black_and_noted(folder: Path):
    (folder / "x.mtl").write_text(TWO)
    (folder / "x.obj").write_text(obj("", "usemtl a", "usemtl nobody"))
    found = read_coloured_mesh(folder / "x.obj")
    assert found.colours is not None
    assert [tuple(row) for row in found.colours[::3].tolist()] == [BLACK, RED, BLACK]
    assert found.notes == ("no material 'nobody' in x.mtl", "6 of 9 vertices are in no painted face: black")
    (folder / "x.obj").write_text(obj("usemtl a") + "v 9 9 9\n")
    assert read_coloured_mesh(folder / "x.obj").notes == (), "a vertex in no face at all needs no paint"


def test_a_name_may_differ_in_its_case_alone(folder: Path):
    assert colours(folder, obj("usemtl A", "usemtl B # second"), TWO) == [RED, GREEN]


@pytest.mark.parametrize("vt", ["vt nan nan", "vt 0.9 -1.#IND", "vt inf 0"])
def test_a_corner_without_uvs_costs_its_own_colour(vt: str, folder: Path):
    (folder / "x.mtl").write_text(TWO)
    lines = obj("usemtl a", "usemtl b")
    (folder / "x.obj").write_text(lines.replace("vt 0.9 0.2", vt, 1) + "f 1 2 3\n")
    found = read_coloured_mesh(folder / "x.obj")
    assert found.colours is not None
    assert [tuple(row) for row in found.colours.tolist()] == [RED, BLACK, RED, GREEN, GREEN, GREEN]
    assert found.mesh.uv is None
    assert len(found.notes) == 2


def test_textures_need_uvs(folder: Path):
    assert colours(folder, obj("usemtl a", texture=False), TWO) is None


@pytest.mark.parametrize(
    ("text", "materials", "said"),
    [
        (obj("usemtl a"), None, "x.mtl: no such file, the materials of x.obj"),
        (obj("usemtl a", library="mtllib ../x.mtl"), None, "expected the materials beside it"),
        (obj("usemtl a", library="mtllib ..\\x.mtl"), None, "expected the materials beside it"),
        (obj("usemtl a"), "newmtl a\nmap_Kd no.png", "no.png: no such file, the texture of x.obj"),
        (obj("usemtl a"), "newmtl a\nmap_Kd textures\\no.png", "textures/no.png: no such file, the texture"),
        (
            obj("usemtl a"),
            "newmtl a\nmap_Kd C:\\no\\no.png",
            r"expected the texture beside it or in a folder below, found",
        ),
        (obj("usemtl a"), "newmtl a\nmap_Kd /etc/passwd", "expected the texture beside it"),
        (obj("usemtl a"), "newmtl a\nmap_Kd ../up/r.png", "expected the texture beside it"),
        (obj("usemtl a"), "newmtl a\nmap_Kd textures/../../r.png", "expected the texture beside it"),
        (obj("usemtl a"), "newmtl a\nmap_Kd ..\\up\\r.png", "expected the texture beside it"),
        (obj("usemtl a"), "newmtl a\nmap_Kd %2e%2e/up/r.png", "r.png: no such file, the texture"),
        (obj("usemtl a"), "newmtl a\nmap_Kd \0.png", "expected the name of a texture"),
        (obj("usemtl a"), f"newmtl a\nmap_Kd {'x' * 5000}.png", "x.obj: "),
        (obj("usemtl a"), "newmtl a\nmap_Kd x.obj", "not a readable image"),
        (obj("usemtl a"), "newmtl a\nmap_Kd textures", "no such file, the texture"),
        (obj("usemtl a"), "newmtl a\nmap_Kd r.png".encode("utf-16"), "x.mtl: expected UTF-8, found UTF-16 text"),
        (obj(""), TWO, "x.obj: expected usemtl lines, for there are 2 materials, found none"),
        (obj("usemtl a", library="\n".join(f"mtllib {n}.mtl" for n in range(2000))), None, "at most 1000 files"),
        (obj("usemtl a", library="mtllib " + " ".join(map(str, range(2000)))), None, "at most 1000 files"),
        (obj("usemtl c", library="mtllib no.mtl\nmtllib x.mtl x.mtl"), TWO, "no.mtl: no such file, the materials"),
    ],
)
def test_what_a_face_needs_and_is_not_there_is_one_line(
    text: str, materials: str | bytes | None, said: str, folder: Path
):
    picture(folder.parent / "up" / "r.png", RED)
    with pytest.raises(InputError, match=re.escape(said)) as caught:
        colours(folder, text, materials)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 900
    assert read_mesh(folder / "x.obj").colours is None, "textures matter where colours are asked for"


def test_a_missing_library_matters_where_a_face_needs_it(folder: Path):
    (folder / "x.obj").write_text(obj("", library="mtllib no.mtl"))
    found = read_coloured_mesh(folder / "x.obj")
    assert found.colours is None
    assert found.notes == (f"{folder / 'no.mtl'}: no such file, the materials of x.obj",)
    coloured = re.sub(r"(v \S+ \S+ \S+)", r"\1 1 0 0", obj("usemtl a", library="mtllib no.mtl"))
    assert colours(folder, coloured) == [(255, 0, 0)], "vertices have colours: nobody looks"


def test_white_vertices_stand_for_no_colour_where_there_is_a_texture(folder: Path):
    white = re.sub(r"(v \S+ \S+ \S+)", r"\1 1 1 1", obj("usemtl a"))
    assert colours(folder, white, TWO) == [RED]
    assert colours(folder, white, "newmtl a\nmap_Kd no.png\n") == [(255, 255, 255)]
    assert "no.png: no such file" in read_coloured_mesh(folder / "x.obj").notes[0]
    assert colours(folder, white.replace("mtllib x.mtl\n", "")) == [(255, 255, 255)]


def test_a_file_may_name_any_number_of_materials(folder: Path):
    """Each costs its own faces, not all."""
    count = 5000
    (folder / "x.mtl").write_text("".join(f"newmtl m{index}\nmap_Kd r.png\n" for index in range(count)))
    faces = [f"usemtl m{index}\nf 1/1 2/2 3/3" for index in range(count)]
    (folder / "x.obj").write_text(obj("usemtl m0") + "\n".join(faces))
    found = read_coloured_mesh(folder / "x.obj").colours
    assert found is not None
    assert found.tolist() == [list(RED)] * 3


def test_options_alone_name_nothing(tmp_path: Path):
    (tmp_path / "x.mtl").write_text("newmtl a\nmap_Kd -s 1 1 1\nnewmtl b\nmap_Kd\nmap_Kd " + "-clamp on " * 100_000)
    found = read_materials(tmp_path / "x.mtl")
    assert found["b"].texture is None
    assert found["a"].texture is not None
    assert found["a"].texture.name == "1", "a file may be called so"


# --- ply -------------------------------------------------------------------------------------------------------------


def ply(images: list[str], numbers: list[int] | None, *, uv: bool = True, comment: str = "comment TextureFile") -> str:
    """One triangle a number, or a single one."""
    count = len(numbers or [0])
    head = "ply\nformat ascii 1.0\n" + "".join(f"{comment} {image}\n" for image in images)
    head += f"element vertex {3 * count}\nproperty float x\nproperty float y\nproperty float z\n"
    head += f"element face {count}\nproperty list uchar int vertex_indices\n"
    head += "property list uchar float texcoord\n" if uv else ""
    head += "property int texnumber\n" if numbers else ""
    body = "".join(f"{index} 0 0\n{index} 1 0\n{index} 0 1\n" for index in range(count))
    for index, number in enumerate(numbers or [0]):
        body += f"3 {3 * index} {3 * index + 1} {3 * index + 2}"
        body += " 6 .1 .2 .9 .2 .1 .8" if uv else ""
        body += f" {number}\n" if numbers else "\n"
    return f"{head}end_header\n{body}"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (ply(["r.png"], None), [RED]),
        (ply(["r.png"], [0, 0]), [RED, RED]),
        (ply(["r.png"], [1, 1]), [RED, RED]),
        (ply(["r.png", "r.png"], None), [RED]),
        (ply(["r.png", "g.png"], [1, 0, -1, 1, 7]), [GREEN, RED, BLACK, GREEN, BLACK]),
        (ply(["textures\\b.png"], None), [BLUE]),
        (ply(["R.png"], None, comment="COMMENT texturefile"), [RED]),
        (ply(['"r.png"'], None, comment="comment  TextureFile "), [RED]),
        (ply(["C:\\scans\\r.png"], None, comment="obj_info TextureFile"), [RED]),
        (ply(["r.png"], None).replace("\n", "\r\n"), [RED]),
        (ply(["r.png"], None, uv=False), None),
        (ply([], None), None),
    ],
)
def test_textures_of_a_ply(text: str, expected: list[tuple[int, ...]] | None, folder: Path):
    (folder / "x.ply").write_bytes(text.encode())
    found = read_coloured_mesh(folder / "x.ply").colours
    assert (None if found is None else [tuple(row) for row in found[::3].tolist()]) == expected


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (ply(["r.png", "g.png"], None), "x.ply: expected one texture, or a texnumber of every face, found 2 textures"),
        (ply(["no.png"], None), "no.png: no such file, the texture of x.ply"),
        (ply(["../r.png"], None), "x.ply: expected the texture beside it"),
    ],
)
def test_textures_of_a_ply_that_are_not_there(text: str, said: str, folder: Path):
    (folder / "x.ply").write_text(text)
    with pytest.raises(InputError, match=re.escape(said)):
        read_coloured_mesh(folder / "x.ply")
