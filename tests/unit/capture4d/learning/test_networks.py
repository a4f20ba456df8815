"""Sizes of images and counts of parameters, by hand."""

import pytest
import torch

from capture4d.learning.networks import ImageDecoder, perceptron


@pytest.mark.parametrize(("outputs", "first", "doublings"), [(6, 8, 2), (3, 4, 1), (1, 5, 0)])
def test_images_have_the_size_that_is_asked_for(outputs: int, first: int, doublings: int) -> None:
    decoder = ImageDecoder(7, outputs=outputs, first=first, channels=8, doublings=doublings).eval()
    size = first * 2**doublings
    assert decoder(torch.zeros(2, 7)).shape == (2, outputs, size, size)
    assert decoder.mean.shape == (outputs, size, size)
    decoder.mean += 1.0
    decoder.layers[-1].weight.data.zero_()
    decoder.layers[-1].bias.data.zero_()
    assert (decoder(torch.randn(2, 7)) == 1.0).all()


def test_a_perceptron_has_two_hidden_layers() -> None:
    count = sum(parameter.numel() for parameter in perceptron(5, 7, 3).parameters())
    assert count == (5 + 1) * 7 + (7 + 1) * 7 + (7 + 1) * 3
