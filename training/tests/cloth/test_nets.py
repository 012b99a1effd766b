import pytest
import torch
from stickslip_training.cloth.crop import HEIGHT, WIDTH
from stickslip_training.cloth.nets import BaselineNet, ConditionalNet, Extractor, PosteriorNet


def test_the_extractor_is_that_of_table_4_3():
    net = Extractor()
    kinds = [type(layer).__name__ for layer in net]
    block = ["Conv2d", "ReLU"]
    pool = ["MaxPool2d"]
    assert kinds == 2 * block + pool + 2 * block + pool + block + pool + block + ["AdaptiveAvgPool2d", "Flatten"]
    channels = [layer.out_channels for layer in net if isinstance(layer, torch.nn.Conv2d)]
    assert channels == [64, 64, 128, 128, 256, 512]
    maps = torch.zeros(1, 3, 224, 224, device="meta")
    for layer in list(net.to("meta"))[:-2]:
        maps = layer(maps)
    assert maps.shape == (1, 512, 28, 28)


def test_the_two_models_of_the_thesis():
    clips, material = torch.rand(2, 3, 3, 32, 32), torch.tensor([1, 9])
    assert BaselineNet(10)(clips).shape == (2, 10)
    net = ConditionalNet(16, 10).eval()
    first, second = net(clips, material), net(clips, torch.tensor([2, 9]))
    assert first.shape == (2, 16)
    assert not torch.allclose(first[0], second[0])
    assert torch.equal(first[1], second[1])
    with pytest.raises(ValueError, match="material must be given"):
        net(clips)


def test_posterior_net_answers_with_a_joint_histogram_whatever_the_exposure():
    torch.manual_seed(0)
    net = PosteriorNet(materials=3, bins=64, frames=9).eval()
    crops, direction = torch.rand(2, 9, HEIGHT, WIDTH), torch.rand(2, 3)
    material, mu = net(crops, direction)
    assert material.exp().sum(dim=1).tolist() == pytest.approx([1, 1])
    assert mu.exp().sum(dim=2).flatten().tolist() == pytest.approx([1] * 6)
    again = net(0.5 * crops + 0.2, direction)
    torch.testing.assert_close(again[1], mu, atol=0.05, rtol=0.05)
    parameters = sum(parameter.numel() for parameter in net.parameters())
    assert parameters * 4 < 5e6  # bytes


def test_posterior_net_sees_order_and_place():
    torch.manual_seed(0)
    net = PosteriorNet(materials=3, bins=64, frames=9).eval()
    crops, direction = torch.rand(1, 9, HEIGHT, WIDTH), torch.rand(1, 3)
    mu = net(crops, direction)[1]
    assert not torch.allclose(net(crops.flip(1), direction)[1], mu)
    assert not torch.allclose(net(crops.roll(1, dims=3), direction)[1], mu)
