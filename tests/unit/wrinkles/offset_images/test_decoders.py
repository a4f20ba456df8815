"""The paper's networks have its printed counts and sizes; losses, drawing, kernels and patches have oracles."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import nn

from capture4d.errors import InputError
from capture4d.learning.networks import ImageDecoder
from capture4d.types import Body, Garment
from tests.unit.wrinkles.offset_images.test_layout import bent, bound
from wrinkles.offset_images.canvas import Canvas, OffsetSampler, drawn_values
from wrinkles.offset_images.frames import OffsetFrames
from wrinkles.offset_images.kernels import fit_kernels
from wrinkles.offset_images.layout import OffsetLayout, encode
from wrinkles.offset_images.losses import edge_length_loss, grid_loss
from wrinkles.offset_images.networks import PcaFullyConnected, patch_decoder, strip_decoder, whole_decoder
from wrinkles.offset_images.patches import OffsetFilter, cut_windows, even_labels, kink_deg, stitched, strip_window

__all__ = ["bound"]


@pytest.mark.parametrize(
    ("make", "inputs", "count", "shape"),
    [
        (lambda: whole_decoder(90), 90, 3_785_322, (6, 256, 256)),
        (lambda: whole_decoder(90, shuffled=2), 90, 3_803_088, (6, 256, 256)),
        (lambda: patch_decoder(90), 90, 3_960_195, (3, 160, 160)),
        (lambda: strip_decoder(36), 36, 2_161_667, (3, 64, 256)),
        (lambda: patch_decoder(90, 80, channels=128, shuffled=2), 90, None, (3, 80, 80)),
        (lambda: whole_decoder(9, 16, shuffled=3), 9, None, (6, 16, 16)),
    ],
    ids=["whole", "pixel shuffle", "patch", "necktie", "small patch", "tiny"],
)
def test_decoders_have_the_printed_sizes(make, inputs: int, count: int | None, shape: tuple[int, ...]):
    with torch.device("meta"):
        network = make()
        assert network(torch.zeros(2, inputs)).shape == (2, *shape)
    assert count is None or sum(each.numel() for each in network.parameters()) == count
    assert isinstance(network.last, nn.Conv2d)


def test_the_necktie_of_the_print_has_fewer_parameters():
    """8 x 8 x 64 reaches neither the size nor the count of the paper: it is 8 x 32 x 64."""
    with torch.device("meta"):
        printed = ImageDecoder(36, outputs=3, first=8, channels=64, doublings=3, hidden=(128,))
        assert printed(torch.zeros(1, 36)).shape == (1, 3, 64, 64)
    assert round(sum(each.numel() for each in printed.parameters()) / 1e6, 2) < 0.6


def test_both_readings_of_the_norm():
    made, truth = torch.zeros(1, 3, 2, 2), torch.zeros(1, 3, 2, 2)
    made[0, 0, 0, 0], made[0, 1, 0, 0], made[0, 2, 1, 1] = 3, 4, 100
    mask = torch.zeros(1, 2, 2, dtype=torch.bool)
    mask[0, 0] = True
    assert grid_loss(made, truth, mask, "l2") == pytest.approx(5 / 2)
    assert grid_loss(made, truth, mask, "l2_squared") == pytest.approx(25 / 2)
    assert grid_loss(made, truth, mask, "l1") == pytest.approx(7 / 2)


def test_edge_lengths_do_not_see_the_cloth_move_and_see_it_stretch():
    points = torch.randn(1, 5, 3, dtype=torch.float64)
    edges = torch.tensor([[0, 1], [1, 2], [3, 4]])
    rotation = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))[0]
    assert edge_length_loss(points @ rotation.T + 7, points, edges) == pytest.approx(0, abs=1e-12)
    lengths = (points[0, edges[:, 0]] - points[0, edges[:, 1]]).norm(dim=1)
    assert edge_length_loss(1.5 * points, points, edges) == pytest.approx(float(0.5 * lengths.mean()))


@pytest.fixture
def drawn(bound: tuple[Garment, Body]) -> tuple[OffsetLayout, np.ndarray]:
    """A layout, and rough offsets of two frames, centimetres."""
    garment, body = bound
    layout = OffsetLayout.create(garment, 64)
    cloth = garment.template.vertices[layout.vertex].astype(float)
    smooth = [100 * encode(layout.anchors(bent(body, angle)), cloth) for angle in (0.2, 0.9)]
    noise = np.random.default_rng(0).standard_normal((2, len(layout.vertex), 3))
    return layout, np.stack(smooth) + 0.1 * noise


def test_matrices_draw_and_sample_what_the_layout_does(drawn: tuple[OffsetLayout, np.ndarray]):
    layout, offsets = drawn
    values = torch.from_numpy(drawn_values(layout, offsets))
    images = Canvas.create(layout).draw(values)
    slow = np.stack([layout.draw(each).transpose(2, 0, 1) for each in offsets])
    np.testing.assert_allclose(images.numpy(), slow, atol=1e-4)
    np.testing.assert_array_equal(Canvas.create(layout).mask.numpy(), layout.mask.transpose(2, 0, 1))


def test_a_window_is_a_part_of_the_image_and_gives_its_cloth_back(drawn: tuple[OffsetLayout, np.ndarray]):
    layout, offsets = drawn
    values = torch.from_numpy(drawn_values(layout, offsets))
    whole = Canvas.create(layout).draw(values)
    everything = OffsetSampler(layout)(whole)
    labels = even_labels(layout, 8)
    assert {layout.image[layout.faces[labels == label]].min() for label in range(4)} == {0}
    windows = cut_windows(layout, labels, 32, 4)
    assert len(windows) == 8
    parts = []
    for window in windows:
        part = Canvas.create(layout, window).draw(values)
        rows, columns = (slice(start, start + 32) for start in (window.top, window.left))
        torch.testing.assert_close(part, whole[:, 3 * window.image :, rows, columns][:, :3])
        sampler = OffsetSampler(layout, window)
        torch.testing.assert_close(sampler(part), everything[:, sampler.pixels], atol=1e-4, rtol=1e-5)
        parts.append((sampler, sampler(part)))
    torch.testing.assert_close(stitched(layout, parts), everything, atol=1e-4, rtol=1e-5)


def test_pixels_of_two_patches_are_averaged(drawn: tuple[OffsetLayout, np.ndarray]):
    layout, _ = drawn
    labels = even_labels(layout, 4)
    samplers = [OffsetSampler(layout, window) for window in cut_windows(layout, labels, 64, 0)]
    parts = [(each, torch.full((1, len(each.pixels), 3), float(k))) for k, each in enumerate(samplers)]
    found = stitched(layout, parts)[0, :, 0].numpy()
    touching = [set(labels[(layout.faces == pixel).any(axis=1)]) for pixel in range(len(layout.vertex))]
    np.testing.assert_allclose(found, [np.mean(list(each)) for each in touching], atol=1e-6)
    assert any(len(each) == 2 for each in touching)


def test_the_context_is_cloth_around_a_patch(drawn: tuple[OffsetLayout, np.ndarray]):
    layout, _ = drawn
    labels = even_labels(layout, 8)
    texels = [
        [int(Canvas.create(layout, window).mask.sum()) for window in cut_windows(layout, labels, 48, context)]
        for context in (0, 2, 6)
    ]
    assert all(less < more for few, many in pairwise(texels) for less, more in zip(few, many, strict=True))


def test_what_does_not_fit_is_refused(drawn: tuple[OffsetLayout, np.ndarray]):
    layout, _ = drawn
    labels = even_labels(layout, 2)
    with pytest.raises(InputError, match=r"longer than the 16 texels of a window, found \d+ texels in label 0"):
        cut_windows(layout, labels, 16, 0)
    with pytest.raises(InputError, match="windows of at most 64 texels, as the images have, found 80"):
        cut_windows(layout, labels, 80, 0)
    with pytest.raises(InputError, match="a label for each of"):
        cut_windows(layout, labels[1:], 32, 0)
    with pytest.raises(InputError, match="found one with front and back"):
        strip_window(layout, 16, 64, 4)


def test_kinks_are_the_angle_that_a_fold_between_patches_has():
    """Two quads that meet in an edge of length 1, the second turned by 30 degrees."""
    turn = np.radians(30)
    vertices = np.array([[0, 0, 0], [0, 1, 0], [-1, 0, 0], [-1, 1, 0],
                         [np.cos(turn), 0, np.sin(turn)], [np.cos(turn), 1, np.sin(turn)]])  # fmt: skip
    faces = np.array([[2, 0, 1], [2, 1, 3], [0, 4, 5], [0, 5, 1]], np.int32)
    assert kink_deg(vertices[None], faces, np.array([0, 0, 1, 1])) == pytest.approx(30)
    assert kink_deg(vertices[None], faces, np.array([0, 1, 1, 1])) == pytest.approx(15)
    assert np.isnan(kink_deg(vertices[None], faces, np.zeros(4, int)))


def test_the_filter_keeps_what_was_learned_and_takes_off_what_was_not():
    torch.manual_seed(0)
    frames = torch.randn(5, 40, 3)
    known = OffsetFilter.learned(frames, 2048)
    torch.testing.assert_close(known(frames), frames, atol=1e-4, rtol=1e-4)
    other = torch.randn(1, 40, 3)
    once = known(other)
    torch.testing.assert_close(known(once), once, atol=1e-4, rtol=1e-4)
    assert (once - frames.mean(dim=0)).norm() < 0.5 * (other - frames.mean(dim=0)).norm()


def some_frames(count: int) -> OffsetFrames:
    """Offsets that are smooth in three numbers of a pose, and a constant fourth one."""
    rng = np.random.default_rng(1)
    pose = np.column_stack([rng.uniform(-1, 1, (count, 3)), np.ones(count)]).astype(np.float32)
    wave = np.stack([np.sin(2 * pose @ rng.standard_normal(4)) for _ in range(60)], axis=1)
    offsets = torch.from_numpy((3 + wave).astype(np.float32)).unflatten(1, (20, 3))
    axes = torch.eye(3).expand(count, 20, 3, 3)
    return OffsetFrames(torch.from_numpy(pose), offsets, torch.randn(count, 20, 3), axes, offsets)


def test_kernels_leave_a_frame_out_exactly():
    """The first guess of a frame is that of a regression of the same width and ridge on all the others."""
    frames = some_frames(30)
    kernels, guessed = fit_kernels(frames)
    error = (guessed - frames.offsets).norm(dim=2).mean()
    spread = (frames.offsets - frames.offsets.mean(dim=0)).norm(dim=2).mean()
    assert (kernels.offsets(frames.pose) - frames.offsets).norm(dim=2).mean() < error < 0.5 * spread
    alike = np.exp(-0.5 * np.square((kernels.poses[:, None] - kernels.poses) / kernels.width).sum(axis=2))
    alike += kernels.line * (kernels.poses / kernels.width) @ (kernels.poses / kernels.width).T
    wanted = (frames.offsets.flatten(1).numpy() - kernels.mean) @ kernels.basis.T
    # alike @ answers + ridge answers = wanted, for the ridge that was chosen
    ridge = np.median((wanted - alike @ kernels.answers) / kernels.answers)
    kept = np.arange(30) != 7
    own = np.linalg.solve(alike[np.ix_(kept, kept)] + ridge * np.eye(29), wanted[kept])
    left_out = kernels.mean + alike[7, kept] @ own @ kernels.basis
    np.testing.assert_allclose(guessed[7].flatten().numpy(), left_out, atol=2e-3)


def test_a_guess_moves_where_offsets_start_and_not_the_cloth():
    frames = some_frames(4)
    base = torch.randn(4, 20, 3)
    moved = frames.over(base)
    before = frames.points + torch.einsum("fpca,fpa->fpc", frames.axes, frames.offsets)
    torch.testing.assert_close(moved.points + torch.einsum("fpca,fpa->fpc", moved.axes, moved.offsets), before)
    torch.testing.assert_close(moved.offsets, frames.offsets - base)


def test_coefficients_are_those_that_give_the_offsets_back():
    frames = some_frames(12)
    network = PcaFullyConnected.analysed(4, frames.offsets, components=128)
    known = network.coefficients(frames.offsets)
    back = (network.mean + known @ network.basis).unflatten(1, (-1, 3))
    torch.testing.assert_close(back, frames.offsets, atol=1e-4, rtol=1e-4)
    assert known[:, 0].std() == pytest.approx(1, rel=1e-3)
    lengths = network.basis.norm(dim=1)  # one scale for all: a squared error of coefficients is one of offsets
    torch.testing.assert_close(lengths, lengths[0].expand_as(lengths))
