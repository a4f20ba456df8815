import dataclasses
import pickle
import shutil

import numpy as np
import pytest

from capture4d.captures.capture import read_capture, read_scan
from capture4d.captures.evaluation import material_points
from capture4d.captures.truth import read_truth_frame, read_truth_model
from capture4d.errors import InputError
from capture4d.files.atomic import read_json
from capture4d.files.records import load_garment, load_rig
from capture4d.geometry.mesh import boundary_loops, face_areas
from capture4d.geometry.ray_casting import surface_distances
from capture4d.mesh_files.meshes import write_mesh
from capture4d.types import Mesh
from data_synth.mesh_sequence import open_sequence
from data_synth.scan_stage import paint_like, run
from data_synth.scanner.border_paint import paint_borders
from data_synth.scanner.config import FusionConfig, RigConfig, ScanConfig, ScannerConfig, StereoConfig
from tests.shapes import tube_faces

BLUE, YELLOW, RED = (47, 98, 201), (255, 210, 0), (229, 51, 42)
SMALL = ScanConfig(
    height_m=0.3,
    border_paint_m=0.02,
    scanner=ScannerConfig(rig=RigConfig(cameras=12, image_size=160), fusion=FusionConfig(garment_voxel_m=0.005)),
)


def skirt(bulge=0.0, rows=9, around=24):
    """An open, slightly conical tube, 6 units tall."""
    s = np.linspace(0, 1, rows)[:, None]
    angle = 2 * np.pi * np.arange(around) / around
    radius = 2 - 0.5 * s + bulge * np.sin(np.pi * s)
    vertices = np.stack([radius * np.sin(angle), 6 * s + 0 * angle, radius * np.cos(angle)], axis=2).reshape(-1, 3)
    return Mesh(vertices.astype(np.float32), tube_faces(around, rows))


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    folder = tmp_path_factory.mktemp("meshes")
    for index, bulge in enumerate((0.0, 0.2, 0.4)):
        write_mesh(folder / f"skirt_{10 * index + 5}.obj", skirt(bulge))
    return folder


@pytest.fixture(scope="module")
def capture(sequence, tmp_path_factory):
    output = tmp_path_factory.mktemp("captures") / "skirt"
    run(sequence, output, SMALL)
    return output


def test_a_sequence_becomes_an_ordinary_capture_with_truth(capture):
    description = read_capture(capture)
    assert description.frame_ids == (5, 15, 25)
    assert description.garment_colour == BLUE
    assert set(description.boundary_colours) == {"border_0", "border_1"}
    model = read_truth_model(description)
    assert model is not None
    assert np.ptp(model.fine.vertices[:, 1]) == pytest.approx(0.3, rel=1e-5)
    for frame_id, bulge in zip((5, 15, 25), (0.0, 0.2, 0.4), strict=True):
        truth = read_truth_frame(description, frame_id)
        np.testing.assert_allclose(truth.vertices, 0.05 * skirt(bulge).vertices, atol=1e-6)
        scan = read_scan(description, frame_id)
        assert len(truth.labels) == len(scan.mesh.vertices) > 2000
        distance = surface_distances(model.fine.with_vertices(truth.vertices), scan.mesh.vertices)
        assert np.median(distance) < 0.0005
        band = np.minimum(scan.mesh.vertices[:, 1], 0.3 - scan.mesh.vertices[:, 1])
        assert (truth.labels[band < 0.014] == 2).mean() > 0.95
        assert (truth.labels[band > 0.026] == 1).all()


def test_the_template_is_the_first_mesh_and_maps_to_itself(capture):
    description = read_capture(capture)
    garment, model = description.template, read_truth_model(description)
    assert set(garment.loops) == set(model.loops)
    truth = read_truth_frame(description, 25)
    points = material_points(truth.vertices, model.fine.faces, model.template_faces, model.template_barycentric)
    np.testing.assert_array_equal(points, truth.vertices)


def test_the_result_depends_on_nothing_but_seed_and_settings(sequence, capture, tmp_path):
    first = run(sequence, capture, SMALL).digest  # complete: only digests are computed
    assert run(sequence, tmp_path / "again", SMALL).digest == first
    (tmp_path / "again" / "scans" / "000015.ply").unlink()
    assert run(sequence, tmp_path / "again", SMALL).digest == first
    one_frame = dataclasses.replace(SMALL, frames=1)
    seeds = [run(sequence, tmp_path / f"seed{seed}", dataclasses.replace(one_frame, seed=seed)) for seed in (0, 1)]
    assert seeds[0].digest != seeds[1].digest
    with pytest.raises(InputError, match="overwrite"):
        run(sequence, capture, one_frame)


def test_a_given_template_is_mapped_to_the_first_mesh(sequence, tmp_path):
    template = skirt(rows=5, around=12)
    write_mesh(tmp_path / "template.obj", template)
    run(sequence, tmp_path / "out", dataclasses.replace(SMALL, frames=1), template=tmp_path / "template.obj")
    description = read_capture(tmp_path / "out")
    model = read_truth_model(description)
    points = material_points(model.fine.vertices, model.fine.faces, model.template_faces, model.template_barycentric)
    garment = load_garment(tmp_path / "out" / "template.npz")
    assert np.linalg.norm(points - garment.template.vertices, axis=1).max() < 0.004
    for name, loop in garment.loops.items():
        ours, theirs = garment.template.vertices[loop][:, 1], model.fine.vertices[model.loops[name]][:, 1]
        assert ours.mean() == pytest.approx(theirs.mean(), abs=1e-5)
    write_mesh(tmp_path / "other.obj", Mesh(template.vertices + np.float32(5), template.faces))
    with pytest.raises(InputError, match=r"other\.obj"):
        run(sequence, tmp_path / "out2", SMALL, template=tmp_path / "other.obj")


def test_sequences_without_one_topology_are_scanned_without_truth(tmp_path):
    write_mesh(tmp_path / "in" / "a1.ply", skirt())
    write_mesh(tmp_path / "in" / "a2.ply", skirt(rows=11))
    run(tmp_path / "in", tmp_path / "out", SMALL)
    assert read_truth_model(read_capture(tmp_path / "out")) is None


def test_z_up_npz_sequences(tmp_path):
    mesh = skirt()
    z_up = mesh.vertices[:, [0, 2, 1]] * [1, -1, 1]
    np.savez(tmp_path / "sequence.npz", vertices=np.stack([z_up, z_up]).astype(np.float32), faces=mesh.faces)
    run(tmp_path / "sequence.npz", tmp_path / "out", dataclasses.replace(SMALL, up="z", frames=1))
    model = read_truth_model(read_capture(tmp_path / "out"))
    np.testing.assert_allclose(model.fine.vertices, 0.05 * mesh.vertices, atol=1e-6)


def test_every_nth_mesh_keeps_its_time(sequence, tmp_path):
    run(sequence, tmp_path / "out", dataclasses.replace(SMALL, step=2, fps=50.0))
    description = read_capture(tmp_path / "out")
    assert description.frame_ids == (5, 25)
    assert read_scan(description, 25).time_s == pytest.approx(20 / 50)


def test_what_is_lost_is_made_again(sequence, capture, tmp_path):
    digest = read_json(capture / "stage.json")["digest"]
    again = tmp_path / "again"
    shutil.copytree(capture, again)
    scan, truth = again / "scans" / "000015.ply", again / "truth" / "000005.npz"
    scan.write_bytes(scan.read_bytes()[:-100])
    truth.unlink()
    assert run(sequence, again, SMALL).digest == digest
    (again / "truth" / "model.npz").unlink()
    assert run(sequence, again, SMALL).digest == digest


def test_borders_keep_their_paint_when_the_faces_change():
    """Loops are ordered by their vertices; in the second mesh the other loop is cut finer and comes first."""
    first = skirt()
    second_loop = boundary_loops(first.faces)[1]
    middles = (first.vertices[second_loop] + first.vertices[np.roll(second_loop, -1)]) / 2
    finer = split_border(first, second_loop, middles)
    moved = finer.with_vertices(finer.vertices + np.float32(0.5))
    scanner = ScannerConfig(fusion=FusionConfig(garment_voxel_m=0.2))
    config = ScanConfig(border_paint_m=0.5, border_colours=("#ffd200", "#e5332a"), scanner=scanner)
    for mesh in (first, moved):
        sheet = paint_like(mesh, first, config)
        height = sheet.posed(mesh.vertices).vertices[:, 1] - mesh.vertices[:, 1].min()
        yellow = height[(sheet.colours == YELLOW).all(axis=1)]
        red = height[(sheet.colours == RED).all(axis=1)]
        if mesh is first:
            low_is_yellow = yellow.max() < 3
        assert (yellow.max() < 3) == low_is_yellow
        assert (red.min() > 3) == low_is_yellow
    assert len(boundary_loops(moved.faces)[0]) == 48, "the first loop is another one now"


def split_border(mesh, loop, middles):
    """The mesh with every edge of a border loop cut in two."""
    after = dict(zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True))
    number = {vertex: len(mesh.vertices) + index for index, vertex in enumerate(loop.tolist())}
    faces = []
    for face in mesh.faces.tolist():
        for corner in range(3):
            a, b, c = face[corner], face[(corner + 1) % 3], face[(corner + 2) % 3]
            cut = number[a] if after.get(a) == b else number[b] if after.get(b) == a else None
            if cut is not None:
                faces += [(a, cut, c), (cut, b, c)]
                break
        else:
            faces.append(tuple(face))
    return Mesh(np.concatenate([mesh.vertices, middles]).astype(np.float32), np.array(faces, np.int32))


def test_an_npz_is_unpacked_once(tmp_path, monkeypatch):
    mesh = skirt()
    np.savez(tmp_path / "sequence.npz", vertices=np.stack([mesh.vertices] * 3), faces=mesh.faces)
    sequence = open_sequence(tmp_path / "sequence.npz")
    monkeypatch.setattr(np, "load", None)
    for frame_id in sequence.frame_ids:
        np.testing.assert_array_equal(sequence.read(frame_id).vertices, mesh.vertices)


def test_worker_processes_scan_as_one_does(tmp_path):
    """Each reads the sequence itself, whatever its kind: only its path travels."""
    mesh = skirt()
    np.savez(tmp_path / "sequence.npz", vertices=np.stack([mesh.vertices] * 3), faces=mesh.faces)
    sequence = open_sequence(tmp_path / "sequence.npz")
    assert len(pickle.dumps(sequence)) < mesh.vertices.nbytes
    first, second = (run(tmp_path / "sequence.npz", tmp_path / str(n), SMALL, workers=n).digest for n in (1, 2))
    assert first == second


def test_meshes_that_have_changed_are_read_again(tmp_path):
    """Within one process, as a notebook runs it."""
    one = dataclasses.replace(SMALL, frames=1)
    write_mesh(tmp_path / "in" / "a1.ply", skirt())
    run(tmp_path / "in", tmp_path / "out", one)
    write_mesh(tmp_path / "in" / "a1.ply", skirt(0.5))
    run(tmp_path / "in", tmp_path / "out", one, overwrite=True)
    model = read_truth_model(read_capture(tmp_path / "out"))
    np.testing.assert_allclose(model.fine.vertices, 0.05 * skirt(0.5).vertices, atol=1e-6)


def test_an_open_template_does_not_fit_closed_meshes(tmp_path):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)
    write_mesh(tmp_path / "in" / "a1.ply", Mesh(corners, faces))
    write_mesh(tmp_path / "open.ply", Mesh(corners, faces[:3]))
    with pytest.raises(InputError, match=r"open\.ply: expected a closed template"):
        run(tmp_path / "in", tmp_path / "out", SMALL, template=tmp_path / "open.ply")


def test_bad_sequences_are_named(tmp_path):
    with pytest.raises(InputError, match="nothing"):
        open_sequence(tmp_path / "missing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="none"):
        open_sequence(tmp_path / "empty")
    write_mesh(tmp_path / "names" / "a_1.obj", skirt())
    write_mesh(tmp_path / "names" / "b_1.obj", skirt())
    with pytest.raises(InputError, match="frame number 1"):
        open_sequence(tmp_path / "names")
    for name in ("._a_1.obj", "Thumbs 3.db"):
        (tmp_path / "names" / name).write_bytes(b"")
    (tmp_path / "names" / "b_1.obj").rename(tmp_path / "names" / "a_2_v2.OBJ")
    write_mesh(tmp_path / "names" / "a_3_v2.obj", skirt())
    assert open_sequence(tmp_path / "names").frame_ids == (1, 2, 3), "as the scans of a capture"
    np.savez(tmp_path / "flat.npz", vertices=np.zeros((4, 3), np.float32), faces=np.zeros((1, 3), np.int32))
    with pytest.raises(InputError, match="shape"):
        open_sequence(tmp_path / "flat.npz")


def test_refinement_keeps_the_surface_and_paints_a_clean_band():
    mesh = skirt()
    sheet = paint_borders(mesh, width_m=0.5, garment_colour=BLUE, border_colours=[YELLOW, RED], max_edge_m=0.1)
    refined = sheet.posed(mesh.vertices)
    assert face_areas(refined.vertices, refined.faces).sum() == pytest.approx(
        face_areas(mesh.vertices, mesh.faces).sum(), rel=1e-5
    )
    height = refined.vertices[:, 1]
    yellow, red = ((sheet.colours == colour).all(axis=1) for colour in (YELLOW, RED))
    assert len(sheet.loops) == len(boundary_loops(mesh.faces)) == 2
    painted = yellow | red
    assert painted[np.minimum(height, 6 - height) < 0.4].all()
    assert not painted[np.minimum(height, 6 - height) > 0.51].any()
    assert len(np.unique(height[yellow] > 3)) == len(np.unique(height[red] > 3)) == 1
    moved = sheet.posed(skirt(0.3).vertices)
    assert surface_distances(skirt(0.3), moved.vertices).max() < 1e-5


def test_cloth_that_hangs_close_to_a_border_stays_unpainted():
    """Two skirts, one inside the other: the closed-off inner one is near the outer's border in space only."""
    outer = skirt()
    middle = Mesh((outer.vertices * [0.9, 0.5, 0.9] + [0, 0.3, 0]).astype(np.float32), outer.faces)
    both = Mesh(
        np.concatenate([outer.vertices, middle.vertices]),
        np.concatenate([outer.faces, middle.faces + np.int32(len(outer.vertices))]),
    )
    colours = [YELLOW, YELLOW, BLUE, BLUE]
    sheet = paint_borders(both, width_m=0.4, garment_colour=BLUE, border_colours=colours, max_edge_m=0.1)
    refined = sheet.posed(both.vertices)
    painted = (sheet.colours == YELLOW).all(axis=1)
    radius = np.hypot(refined.vertices[:, 0], refined.vertices[:, 2])
    height = refined.vertices[:, 1]
    inner = radius < (2 - 0.5 * height / 6) * 0.95
    assert painted.any()
    assert inner.any()
    assert not (painted & inner & (height < 3)).any()


def test_stereo_pods_scan_a_sequence_too(sequence, tmp_path):
    scanner = dataclasses.replace(
        SMALL.scanner,
        sensor="stereo",
        stereo=StereoConfig(pods=6, image_size=200, supersampling=1, speckle_window_px=30, baseline_m=0.08),
    )
    run(sequence, tmp_path / "take", dataclasses.replace(SMALL, frames=1, scanner=scanner))
    description = read_capture(tmp_path / "take")
    assert len(load_rig(tmp_path / "take" / "rig.json").names) == 12
    (frame_id,) = description.frame_ids
    scan, truth = read_scan(description, frame_id), read_truth_frame(description, frame_id)
    assert len(truth.labels) == len(scan.mesh.vertices) > 1000
    model = read_truth_model(description)
    error = surface_distances(Mesh(truth.vertices, model.fine.faces), scan.mesh.vertices)
    assert np.median(error) < 0.002
