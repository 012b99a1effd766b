import pytest
import torch
from stickslip_training.rods.curvature import CurvatureNet, root_mean_square_loss


def test_it_is_the_network_of_table_5_1():
    net = CurvatureNet()
    assert net(torch.zeros(2, 150, 3)).shape == (2, 150, 3)
    convolutions = 3 * (3 * 64 + 64 * 64 + 64 * 128 + 3 * 128 * 128) + 2 * 64 + 4 * 128
    heads = (146 * 128 + 1) * 512 + (512 + 1) * 450
    assert (
        sum(parameter.numel() for parameter in net.parameters())
        == convolutions + heads
        == 9_985_154
    )
    kinds = [type(layer).__name__ for layer in net.features]
    block = ["Conv1d", "ReLU"] * 2 + ["MaxPool1d"]
    assert kinds == 3 * block
    assert [
        (layer.kernel_size, layer.stride)
        for layer in net.features
        if isinstance(layer, torch.nn.MaxPool1d)
    ] == [
        (3, 1),
        (2, 1),
        (2, 1),
    ]
    assert net.features(torch.zeros(1, 3, 150)).shape == (1, 128, 146)


def test_inputs_and_outputs_are_standardised_by_its_state():
    generator = torch.Generator().manual_seed(0)
    centerline = torch.randn(40, 150, 3, generator=generator) * 0.1 + 0.5
    centerline[:, 0] = 0.0  # the clamp
    strains = torch.randn(40, 150, 3, generator=generator) * torch.tensor([1.0, 2.0, 5.0]) + 7.0
    net = CurvatureNet()
    net.standardise(centerline, strains, noise=0.0)
    x = (centerline - net.input_mean) / net.input_scale
    assert x.mean().abs() < 1e-5
    assert x[:, 1:].std() == pytest.approx(1.0, abs=0.02)
    assert torch.equal(x[:, 0], torch.zeros(40, 3))
    assert torch.allclose(net.output_scale, torch.tensor([1.0, 2.0, 5.0]), rtol=0.05)
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.zero_()
    assert torch.allclose(net(centerline)[0, 0], strains.mean(dim=(0, 1)), atol=1e-5)
    assert {"input_mean", "input_scale", "output_mean", "output_scale"} <= set(net.state_dict())


def test_the_loss_is_the_root_of_the_mean_square():
    estimate = torch.tensor([[[3.0, 0.0, 0.0]]])
    assert root_mean_square_loss(estimate, torch.zeros(1, 1, 3)).item() == pytest.approx(3.0**0.5)
