"""Offsets from a body: exact round trips, images whose error falls with resolution, networks of the printed sizes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from capture4d.body.skinning import PosedBody, with_pose, with_shape
from capture4d.errors import InputError
from capture4d.learning.networks import ImageDecoder
from capture4d.types import Body, Garment, Mesh, PoseSequence
from tests.unit.wrinkles.conftest import sleeve, wrinkled
from wrinkles.offset_images.canvas import OffsetSampler
from wrinkles.offset_images.config import OffsetTrainingConfig
from wrinkles.offset_images.frames import offset_frames, pose_joints, vertex_errors_cm
from wrinkles.offset_images.layout import Anchors, OffsetLayout, decode, encode, worn_part
from wrinkles.offset_images.losses import grid_loss, normal_loss
from wrinkles.offset_images.networks import FullyConnected, PcaFullyConnected
from wrinkles.offset_images.training import OffsetLesson, predict, train_offsets


def limb() -> Body:
    """A tube of half the sleeve's width, with a joint half way up."""
    mesh = sleeve(24, 18)
    vertices = mesh.vertices * np.array([0.5, 1, 0.5], np.float32)
    bend = np.clip((vertices[:, 1] - 0.15) / 0.2, 0, 1)
    return Body(
        Mesh(vertices, mesh.faces, mesh.uv),
        np.zeros((1, len(vertices), 3), np.float32),
        np.array([[0, 0, 0], [0, 0.25, 0]], np.float32),
        np.zeros((1, 2, 3), np.float32),
        ("root", "elbow"),
        np.array([-1, 0], np.int32),
        np.column_stack([1 - bend, bend]).astype(np.float32),
    )


def turned(angle: float) -> np.ndarray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def bent(body: Body, angle: float) -> PosedBody:
    root = turned(0.3 * angle)[[2, 0, 1]][:, [2, 0, 1]]
    rotations = np.stack([root, turned(angle)]).astype(float)
    return with_pose(with_shape(body, np.zeros(1)), rotations, np.array([0.1, 0.2, 0.3]))


def upright(body: Body) -> PosedBody:
    return with_pose(with_shape(body, np.zeros(1)), np.stack([np.eye(3), np.eye(3)]), np.zeros(3))


@pytest.fixture
def bound(garment: Garment) -> tuple[Garment, Body]:
    from capture4d.body.binding import bind

    body = limb()
    at, weights, skin_weights = bind(garment.template.vertices, garment.template.faces, upright(body))
    embedded = replace(
        garment, embedding_faces=at, embedding_barycentric=weights, skin_weights=skin_weights.astype(np.float32)
    )
    return embedded, body


@pytest.mark.parametrize("space", ["local", "body_local", "root_offset", "root_position"])
def test_encoding_and_decoding_is_exact(bound: tuple[Garment, Body], space: str):
    garment, body = bound
    layout = OffsetLayout.create(garment, 64)
    anchors = layout.anchors(bent(body, 0.8), space)  # pyright: ignore
    cloth = np.random.default_rng(0).standard_normal((len(layout.vertex), 3))
    np.testing.assert_allclose(decode(anchors, encode(anchors, cloth)), cloth, atol=1e-9)
    np.testing.assert_allclose(
        anchors.axes.transpose(0, 2, 1) @ anchors.axes, np.broadcast_to(np.eye(3), anchors.axes.shape), atol=1e-9
    )


@pytest.mark.parametrize("space", ["local", "body_local", "root_offset", "root_position"])
def test_the_part_of_the_body_under_a_garment_anchors_it_as_the_whole_does(bound: tuple[Garment, Body], space: str):
    """A cuff, cut off the sleeve: normals at its borders know the faces beyond."""
    garment, body = bound
    mesh = garment.template
    assert mesh.uv is not None
    assert garment.embedding_faces is not None
    assert garment.embedding_barycentric is not None
    cuff = mesh.vertices[mesh.faces].mean(axis=1)[:, 1] > 0.35
    used, faces = np.unique(mesh.faces[cuff], return_inverse=True)
    worn = replace(
        garment, loops={}, template=Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32), mesh.uv[cuff]),
        embedding_faces=garment.embedding_faces[used], embedding_barycentric=garment.embedding_barycentric[used],
        skin_weights=None,
    )  # fmt: skip
    layout = OffsetLayout.create(worn, 64)
    near, part = worn_part(layout, body)
    assert len(part.template.faces) < 0.7 * len(body.template.faces)
    whole, small = (
        each.anchors(bent(skin, 0.8), space)  # pyright: ignore
        for each, skin in ((layout, body), (near, part))
    )
    np.testing.assert_allclose(small.points, whole.points, atol=1e-9)
    np.testing.assert_allclose(small.axes, whole.axes, atol=1e-6)


@pytest.mark.parametrize("space", ["local", "body_local"])
def test_local_offsets_do_not_see_the_body_turn(bound: tuple[Garment, Body], space: str):
    garment, body = bound
    layout = OffsetLayout.create(garment, 64)
    before = layout.anchors(upright(body), space)  # pyright: ignore
    turn = turned(1.0)
    posed = with_pose(with_shape(body, np.zeros(1)), np.stack([turn, np.eye(3)]), np.ones(3))
    rolled = layout.anchors(posed, space)  # pyright: ignore
    cloth = garment.template.vertices[layout.vertex].astype(float)
    np.testing.assert_allclose(encode(rolled, cloth @ turn.T + 1), encode(before, cloth), atol=1e-6)
    # on a coaxial tube the cloth lies 5 cm out along the normal
    offset = encode(before, cloth)
    assert np.abs(np.median(offset, axis=0) - [0, 0, 0.05]).max() < 2e-3


def test_tangents_of_the_body_run_along_its_own_uvs(bound: tuple[Garment, Body]):
    """Around the tube; the cloth's own UVs, turned by a quarter, run along it, and a body needs some."""
    garment, body = bound
    uv = garment.template.uv
    assert uv is not None
    quarter = np.stack([uv[..., 1], 2 - uv[..., 0]], axis=-1).astype(np.float32)
    layout = OffsetLayout.create(replace(garment, template=replace(garment.template, uv=quarter)), 64)
    middle = np.abs(garment.template.vertices[layout.vertex, 1] - 0.25) < 0.15
    for space, axis in (("body_local", [1, 0, 1]), ("local", [0, 1, 0])):
        tangents = layout.anchors(upright(body), space).axes[middle, :, 0]  # pyright: ignore
        assert np.linalg.norm(tangents * axis, axis=1).min() > 0.97
    bare = replace(body, template=replace(body.template, uv=None))
    with pytest.raises(InputError, match="UV"):
        layout.anchors(upright(bare), "body_local")


@pytest.mark.parametrize(("depth", "cusps"), [(0.2, 0), (0.5, 4), (4.5, 0)])
def test_constant_offsets_of_an_ellipse_make_a_swallowtail(depth: float, cusps: int):
    """Simple offsets, complex shapes (Jin et al., Fig. 6): inwards by more than the smallest radius of curvature, here
    0.25, and less than the largest, 2, the curve turns back four times."""
    angle = np.linspace(0, 2 * np.pi, 4001)
    points = np.stack([np.cos(angle), 0.5 * np.sin(angle), 0 * angle], axis=1)
    along = np.stack([-np.sin(angle), 0.5 * np.cos(angle), 0 * angle], axis=1)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    up = np.broadcast_to([0.0, 0, 1], points.shape)
    anchors = Anchors(points, np.stack([along, up, np.cross(along, up)], axis=2))
    curve = decode(anchors, np.broadcast_to([0, 0, -depth], points.shape))
    forwards = np.einsum("pc,pc->p", np.diff(curve, axis=0), along[:-1]) > 0
    assert (forwards[1:] != forwards[:-1]).sum() == cusps


def test_pixels_cover_both_images_and_seams_are_doubled(bound: tuple[Garment, Body]):
    layout = OffsetLayout.create(bound[0], 64)
    assert set(layout.image) == {0, 1}
    uses = np.bincount(layout.vertex)
    assert set(uses) == {1, 2}
    assert (uses == 2).sum() == 2 * 24  # two seams along the sleeve
    for image in range(2):
        assert layout.rasters[image].inside.sum() > 0.25 * 64 * 64
    values = np.random.default_rng(0).standard_normal((len(layout.garment.template.vertices), 3))
    np.testing.assert_allclose(layout.vertices(values[layout.vertex]), values, atol=1e-12)


def round_trip_error(garment: Garment, body: Body, size: int, corrections: int) -> float:
    """Mean error of the vertices of a wrinkled sleeve after a trip through images, metres."""
    truth = wrinkled(garment.template.vertices.astype(float), 0.004)
    layout = OffsetLayout.create(garment, size)
    anchors = layout.anchors(bent(body, 0.6))
    images = layout.draw(encode(anchors, truth[layout.vertex]), corrections=corrections)
    pixels = OffsetSampler(layout)(torch.from_numpy(images).permute(2, 0, 1)[None])[0].numpy()
    np.testing.assert_allclose(pixels, layout.sample(images), atol=1e-6)
    return float(np.linalg.norm(layout.vertices(decode(anchors, pixels.astype(float))) - truth, axis=1).mean())


def test_what_sampling_loses_is_drawn_in_advance(bound: tuple[Garment, Body]):
    errors = [round_trip_error(*bound, 64, corrections) for corrections in (0, 1, 3)]
    assert errors[1] < 0.6 * errors[0]
    assert errors[2] < 0.3 * errors[0]


def test_the_error_of_an_image_falls_with_its_resolution(bound: tuple[Garment, Body]):
    errors = [round_trip_error(*bound, size, 0) for size in (32, 64, 128)]
    assert errors[0] > 1.7 * errors[1] > 2.9 * errors[2]


def test_sampling_is_differentiable_and_lands_in_the_right_image(bound: tuple[Garment, Body]):
    layout = OffsetLayout.create(bound[0], 32)
    sampler = OffsetSampler(layout)
    images = torch.randn(1, 6, 32, 32, requires_grad=True)
    sampler(images)[0, torch.from_numpy(layout.image) == 0].sum().backward()
    assert images.grad is not None
    assert images.grad[:, :3].abs().sum() > 0
    assert images.grad[:, 3:].abs().sum() == 0
    points, axes = torch.randn(1, len(layout.vertex), 3), torch.eye(3).expand(1, len(layout.vertex), 3, 3)
    sampler.double()
    small = torch.randn(1, 6, 32, 32, dtype=torch.float64, requires_grad=True)
    placed = sampler.positions(sampler(small), points.double(), axes.double())
    weight = torch.randn_like(placed)
    (placed * weight).sum().backward()
    direction = torch.randn_like(small)
    with torch.no_grad():
        steps = [(sampler.positions(sampler(small + h * direction), points.double(), axes.double()) * weight).sum()
                 for h in (1e-4, -1e-4)]  # fmt: skip
    torch.testing.assert_close((small.grad * direction).sum(), (steps[0] - steps[1]) / 2e-4, rtol=1e-6, atol=1e-6)


def test_networks_have_the_known_numbers_of_parameters():
    def parameters(network: torch.nn.Module) -> int:
        return sum(each.numel() for each in network.parameters())

    with torch.device("meta"):
        decoder = ImageDecoder()
        assert decoder(torch.zeros(2, 90)).shape == (2, 6, 256, 256)
        assert parameters(decoder) == 3_785_322
        assert parameters(FullyConnected(90, 3000)) == 2_402_088
    offsets = torch.randn(140, 50, 3)
    assert parameters(PcaFullyConnected.analysed(90, offsets, components=128)) == 121_984


def test_components_reproduce_what_they_span():
    torch.manual_seed(0)
    offsets = torch.randn(6, 40, 3)
    network = PcaFullyConnected.analysed(9, offsets, components=128)
    assert network.basis.shape[0] == 5
    centred = offsets.flatten(1) - network.mean
    coefficients = centred @ torch.linalg.pinv(network.basis)
    torch.testing.assert_close(coefficients @ network.basis, centred, atol=1e-4, rtol=1e-4)


def test_grid_loss_is_a_mean_of_lengths_over_the_mask():
    made, truth = torch.zeros(2, 6, 4, 4), torch.zeros(2, 6, 4, 4)
    made[:, 0], made[:, 1], made[:, 5] = 3, 4, 12
    mask = torch.zeros(2, 4, 4, dtype=torch.bool)
    mask[0, 1, 1] = mask[1, 2, 2] = True
    assert grid_loss(made, truth, mask, "l2") == pytest.approx((5 + 12) / 2)
    assert grid_loss(made, truth, mask, "l1") == pytest.approx((7 + 12) / 2)


def test_normal_loss_is_zero_for_a_moved_sheet_and_two_for_one_turned_over(garment: Garment):
    faces = torch.from_numpy(garment.template.faces).long()
    sheet = torch.from_numpy(garment.template.vertices)[None]
    assert normal_loss(sheet + 1, sheet, faces) == pytest.approx(0, abs=1e-6)
    assert normal_loss(sheet, sheet, faces.flip(1)) == pytest.approx(0, abs=1e-6)  # both turned over
    assert normal_loss(sheet * torch.tensor([-1.0, 1, -1]), sheet, faces) == pytest.approx(2, abs=1e-4)


def test_decoder_and_baselines_learn_a_bending_sleeve(bound: tuple[Garment, Body]):
    garment, body = bound
    layout = OffsetLayout.create(garment, 32, padding=2)
    angles = np.linspace(0, 1, 24)
    poses = PoseSequence(
        np.stack([np.stack([np.eye(3), turned(angle)]) for angle in angles]).astype(np.float32),
        np.zeros((24, 3), np.float32), np.zeros(1, np.float32), np.arange(24, dtype=np.int32), 60.0, ("root", "elbow"),
    )  # fmt: skip
    shaped = with_shape(body, np.zeros(1))
    vertices = []
    for rotations, angle in zip(poses.rotations, angles, strict=True):
        anchors = layout.anchors(with_pose(shaped, rotations, np.zeros(3)))
        height = garment.template.vertices[layout.vertex, 1:2]
        offset = np.array([0, 0, 1]) * (0.05 + 0.02 * angle * np.sin(20 * height))
        vertices.append(layout.vertices(decode(anchors, offset)))
    joints = pose_joints(poses, garment.skin_weights, count=1)  # pyright: ignore
    assert joints.tolist() == [1]
    frames = offset_frames(layout, body, poses, np.array(vertices, np.float32), joints)
    train, test = frames.rows(range(0, 24, 2)), frames.rows(range(1, 23, 2))
    mean = train.offsets.mean(dim=0).expand(len(test), -1, -1)
    sampler = OffsetSampler(layout)
    baseline = vertex_errors_cm(sampler.positions(mean, test.points, test.axes), test.vertices)
    torch.manual_seed(0)
    networks = [ImageDecoder(9, channels=32, doublings=2), PcaFullyConnected.analysed(9, train.offsets, components=4),
                FullyConnected(9, len(layout.vertex))]  # fmt: skip
    for network in networks:
        epochs = 60 if isinstance(network, ImageDecoder) else 250
        config = OffsetTrainingConfig(epochs=epochs, batch=6, patience=250)
        errors = train_offsets(network, OffsetLesson(layout, train, test), config)
        assert vertex_errors_cm(predict(network, sampler, test), test.vertices) == pytest.approx(min(errors), rel=1e-5)
        assert min(errors) < 0.6 * baseline, type(network).__name__


def test_garments_without_body_or_uvs_are_refused(garment: Garment, bound: tuple[Garment, Body]):
    with pytest.raises(InputError, match="bound to a body"):
        OffsetLayout.create(garment, 64)
    bare = replace(bound[0], template=Mesh(garment.template.vertices, garment.template.faces))
    with pytest.raises(InputError, match="expected UVs"):
        OffsetLayout.create(bare, 64)
