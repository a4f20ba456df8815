"""What the losses see, and what they do not."""

import pytest
import torch

from wrinkles.normal_maps.losses import data_loss, gan_loss, temporal_loss

EVERYWHERE = torch.ones(1, 1, 16, 16, dtype=torch.bool)


def blob(row: int) -> torch.Tensor:
    image = torch.zeros(1, 3, 16, 16)
    image[:, :, row : row + 3, 4:7] = 1
    return image


def test_the_printed_temporal_loss_does_not_see_a_blob_move():
    assert temporal_loss(blob(3), blob(9), EVERYWHERE, "printed") == 0
    assert temporal_loss(blob(3), blob(9), EVERYWHERE, "l1") == pytest.approx(18 / 256)
    assert temporal_loss(blob(3), blob(9), EVERYWHERE, "l2") == pytest.approx(18 / 256)
    assert temporal_loss(blob(3), blob(9), EVERYWHERE, "none") == 0


def test_its_gradient_is_one_constant_with_the_sign_of_the_net_change():
    generated = (blob(3) + 0.5).requires_grad_()
    temporal_loss(generated, blob(9), EVERYWHERE, "printed").backward()
    torch.testing.assert_close(generated.grad, torch.full_like(generated, 1 / (3 * 256)))


def test_channels_do_not_make_up_for_each_other():
    up = torch.zeros(1, 3, 16, 16)
    up[:, 0], up[:, 1] = 0.3, -0.3
    assert temporal_loss(up, torch.zeros_like(up), EVERYWHERE, "printed") == pytest.approx(0.2)


@pytest.mark.parametrize("kind", ["printed", "l1", "l2", "data"])
def test_masked_texels_count_for_nothing(kind: str):
    torch.manual_seed(0)
    generated, truth = torch.randn(2, 3, 8, 8), torch.randn(2, 3, 8, 8)
    valid = torch.rand(2, 1, 8, 8) > 0.4
    spoiled = torch.where(valid, generated, 1e6)

    def loss(image: torch.Tensor) -> torch.Tensor:
        return data_loss(image, truth, valid) if kind == "data" else temporal_loss(image, truth, valid, kind)  # pyright: ignore

    torch.testing.assert_close(loss(spoiled), loss(generated))
    nothing = torch.zeros_like(valid)
    assert torch.isfinite(data_loss(generated, truth, nothing))


def test_a_mean_over_known_texels():
    valid = torch.zeros(1, 1, 4, 4, dtype=torch.bool)
    valid[0, 0, 1, 2] = True
    assert data_loss(torch.full((1, 3, 4, 4), 0.25), torch.zeros(1, 3, 4, 4), valid) == pytest.approx(0.25)


def test_a_sure_judge_pays_little_and_a_wrong_one_much():
    sure = torch.full((1, 1, 3, 3), 8.0)
    assert gan_loss(sure, real=True) < 1e-3
    assert gan_loss(sure, real=False) == pytest.approx(8, abs=0.01)
