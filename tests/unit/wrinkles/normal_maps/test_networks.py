"""Sizes as printed: parameters, receptive field, outputs."""

from typing import Literal

import numpy as np
import pytest
import torch

from capture4d.types import Mesh
from wrinkles.normal_maps.config import PRESETS, MapConfig, NetworkConfig
from wrinkles.normal_maps.inference import WrinkleModel
from wrinkles.normal_maps.networks import PatchDiscriminator, UNet, set_test_statistics

PAPER = NetworkConfig()
SMALL = NetworkConfig(filters=4, layers=5, output="residual", dropout=0.0)


def parameters(network: torch.nn.Module) -> int:
    return sum(each.numel() for each in network.parameters())


def receptive_field(network: torch.nn.Module) -> int:
    """Side of the input patch that one output of a chain of convolutions sees."""
    side = 1
    for layer in reversed([each for each in network.modules() if isinstance(each, torch.nn.Conv2d)]):
        side = (side - 1) * layer.stride[0] + layer.kernel_size[0]
    return side


def test_the_paper_s_networks_have_the_known_numbers_of_parameters():
    with torch.device("meta"):
        generator, discriminator = UNet(PAPER), PatchDiscriminator(PAPER)
    assert parameters(generator) == 54_413_955
    assert parameters(discriminator) == 2_768_705
    paper = PRESETS["paper"]
    assert paper.network == PAPER
    assert (paper.loss.gan, paper.loss.data, paper.loss.temporal, paper.loss.temporal_kind) == (1, 100, 50, "printed")


@pytest.mark.parametrize(("size", "patches"), [(256, 30), (512, 62)])
def test_the_discriminator_sees_patches_of_70_texels(size: int, patches: int):
    with torch.device("meta"):
        discriminator = PatchDiscriminator(PAPER)
        image = torch.zeros(1, 3, size, size)
        assert discriminator(image, image).shape == (1, 1, patches, patches)
    assert receptive_field(discriminator) == 70


def test_a_logit_depends_on_its_patch_and_on_nothing_else():
    discriminator = PatchDiscriminator(NetworkConfig(filters=4)).eval()
    image = torch.randn(1, 3, 128, 128, requires_grad=True)
    discriminator(image, image)[0, 0, 7, 7].backward()
    assert image.grad is not None
    touched = image.grad.abs().sum(dim=(0, 1)).nonzero()
    assert (touched.amax(dim=0) - touched.amin(dim=0) + 1).tolist() == [70, 70]


def test_the_generator_keeps_the_size_of_its_map():
    with torch.device("meta"):
        assert UNet(PAPER)(torch.zeros(2, 3, 256, 256)).shape == (2, 3, 256, 256)


def test_three_inner_layers_of_the_paper_s_decoder_drop_out():
    with torch.device("meta"):
        decoder = UNet(PAPER).up
    drops = [any(isinstance(each, torch.nn.Dropout) for each in layer) for layer in decoder]
    assert drops == [False, True, True, True, False, False, False, False]


def test_a_residual_generator_starts_near_its_input():
    torch.manual_seed(0)
    low = torch.nn.functional.normalize(torch.randn(1, 3, 64, 64), dim=1)
    made = UNet(SMALL)(low)
    assert (made - low).abs().mean() < 0.3
    assert not torch.equal(made, low)


def test_instance_statistics_leave_no_trace_and_running_ones_do_not_look_at_the_map():
    torch.manual_seed(0)
    network = UNet(SMALL)
    network(torch.randn(4, 3, 32, 32))
    before = {name: value.clone() for name, value in network.state_dict().items() if "num_batches" not in name}
    one, other = torch.randn(1, 3, 32, 32), torch.randn(1, 3, 32, 32)
    set_test_statistics(network, "running")
    together = network(torch.cat([one, other]))
    torch.testing.assert_close(together[:1], network(one))
    set_test_statistics(network, "instance")
    assert not torch.allclose(network(one), together[:1])
    for name, value in before.items():
        torch.testing.assert_close(network.state_dict()[name], value)


@pytest.mark.parametrize("output", ["residual", "absolute"])
def test_half_precision_changes_a_map_by_less_than_half_a_degree(output: Literal["residual", "absolute"], monkeypatch):
    torch.manual_seed(0)
    config = NetworkConfig(filters=32, layers=4, output=output, dropout=0.0)
    model = WrinkleModel(UNet(config), config, texels=32, maps=MapConfig(size=32), layout_digest="",
                         template=Mesh(np.zeros((1, 3), np.float32), np.zeros((0, 3), np.int32)))  # fmt: skip
    low = torch.nn.functional.normalize(torch.randn(3, 32, 32), dim=0)
    low[:, :5] = 0
    full, half = (model.generate(low, half_precision=each) for each in (False, True))
    for has, expected in ((True, half), (False, full)):  # 32 filters and more, by default where the processor has it
        monkeypatch.setattr("wrinkles.normal_maps.inference.has_bfloat16", lambda has=has: has)
        assert torch.equal(model.generate(low), expected)
    angle = torch.rad2deg(2 * torch.asin(((full - half).norm(dim=0) / 2).clamp(max=1)))[5:]
    assert 0 < angle.mean() < 0.5
    assert not half[:, :5].any()
    assert model.generator.down[0][0].weight.dtype == torch.float32
