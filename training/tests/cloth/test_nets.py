import pytest
import torch
from stickslip_training.cloth.crop import HEIGHT, WIDTH
from stickslip_training.cloth.model import PosteriorNet


def test_posterior_net_answers_with_a_joint_histogram_whatever_the_exposure():
    torch.manual_seed(0)
    net = PosteriorNet(materials=3, bins=64, frames=9).eval()
    crops, direction = torch.rand(2, 9, HEIGHT, WIDTH), torch.rand(2, 3)
    material, mu = net.read(net.features(crops, direction))
    assert material.exp().sum(dim=1).tolist() == pytest.approx([1, 1])
    assert mu.exp().sum(dim=2).flatten().tolist() == pytest.approx([1] * 6)
    again = net.read(net.features(0.5 * crops + 0.2, direction))
    torch.testing.assert_close(again[1], mu, atol=0.05, rtol=0.05)
    parameters = sum(parameter.numel() for parameter in net.parameters())
    assert parameters * 4 < 5e6  # bytes


def test_posterior_net_sees_order_and_place():
    torch.manual_seed(0)
    net = PosteriorNet(materials=3, bins=64, frames=9).eval()
    crops, direction = torch.rand(1, 9, HEIGHT, WIDTH), torch.rand(1, 3)
    mu = net.read(net.features(crops, direction))[1]
    assert not torch.allclose(net.read(net.features(crops.flip(1), direction))[1], mu)
    assert not torch.allclose(net.read(net.features(crops.roll(1, dims=3), direction))[1], mu)
