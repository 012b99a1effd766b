import numpy as np
import pytest
import torch
from stickslip_training.rods.dataset import ReconstructionNoise
from stickslip_training.rods.local_global import (
    LocalGlobalTraining,
    draw_noise,
    load_local_global,
    save_local_global,
    train_local_global,
)
from stickslip_training.rods.nets import LocalGlobalNet, relative_loss

pytestmark = pytest.mark.physics

SMALL = {"width": 32, "blocks": 2, "local": 4}


def helices(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return centrelines and strains of rods that are helices of random radius and pitch: exact, without a solver."""
    generator = np.random.default_rng(seed)
    radius, pitch = generator.uniform([0.04, 0.1], [0.12, 0.4], (count, 2)).T[..., None]
    rate = 1.0 / np.hypot(radius, pitch)
    angle = rate * np.linspace(0, 1, 150)
    line = np.stack([radius * (np.cos(angle) - 1), radius * np.sin(angle), -pitch * angle], axis=-1)
    bend = np.broadcast_to(radius * rate**2, angle.shape)
    twist = np.broadcast_to(pitch * rate**2, angle.shape)
    return line.astype(np.float32), np.stack([twist, 0 * bend, bend], axis=-1).astype(np.float32)


@pytest.fixture(scope="module")
def trained() -> LocalGlobalNet:
    settings = LocalGlobalTraining(steps=300, batch_size=64, noise=(1e-4, 1e-3), **SMALL)
    return train_local_global(*helices(2000, 0), settings)


@pytest.mark.physics
def test_features_are_whitened_and_answers_are_the_mean_before_training():
    x, k = map(torch.from_numpy, helices(200, 1))
    net = LocalGlobalNet(width=16, blocks=1, centerline_modes=4, strain_modes=2, local=2)
    net.standardise(x, k, noise=0.0)
    whole = (x.reshape(200, -1) - net.centerline_mean) @ net.centerline_modes
    torch.testing.assert_close(whole[:, :2].var(dim=0, correction=0), torch.ones(2), rtol=1e-2, atol=0)
    with torch.no_grad():
        net.head.bias.zero_()
        torch.testing.assert_close(net(x), k.mean(dim=0).expand(200, -1, -1), rtol=1e-4, atol=1e-4)
    net.standardise(x, k, noise=1.0)  # what drowns in noise is small
    whole = (x.reshape(200, -1) - net.centerline_mean) @ net.centerline_modes
    assert whole[:, 3].std() < 0.1


def test_it_sees_both_ends_and_the_noise():
    x, k = map(torch.from_numpy, helices(50, 2))
    net = LocalGlobalNet(**SMALL, centerline_modes=8, strain_modes=8)
    net.standardise(x, k, noise=1e-3)
    torch.nn.init.normal_(net.head.weight)
    for place in (0, 149):
        moved = x[:1].clone()
        moved[0, place] += 0.1
        assert (net(moved) - net(x[:1])).abs().max() > 1e-3


def test_the_loss_is_relative_to_each_rod():
    truth = torch.zeros(2, 5, 3)
    truth[0, :, 2], truth[1, :, 2] = 1.0, 100.0
    assert relative_loss(truth, truth).item() == pytest.approx(1.5e-4, rel=0.01)
    assert relative_loss(1.1 * truth, truth).item() == pytest.approx(0.15, rel=0.01)
    twisted = truth.clone()
    twisted[:, :, 0] += 0.1 * truth[:, :, 2]  # of no effect on |kappa|
    assert relative_loss(twisted, truth).item() == pytest.approx(0.5 * 0.1 * 0.3**0.5, rel=0.01)
    turned = truth[..., [0, 2, 1]]  # bend1 for bend2
    assert relative_loss(turned, truth).item() == pytest.approx(0.5 * 2**0.5, rel=0.01)


def test_it_learns(trained: LocalGlobalNet):
    x, k = map(torch.from_numpy, helices(100, 3))
    with torch.inference_mode():
        error = torch.linalg.norm(trained(x) - k, dim=(1, 2)) / torch.linalg.norm(k, dim=(1, 2))
        mean = torch.linalg.norm(k.mean(dim=0) - k, dim=(1, 2)) / torch.linalg.norm(k, dim=(1, 2))
    assert error.median() < 0.1
    assert error.median() < 0.4 * mean.median()


@pytest.mark.physics
def test_the_same_run_gives_the_same_weights_and_reports():
    rods = helices(50, 4)
    settings = LocalGlobalTraining(steps=7, batch_size=8, **SMALL)
    heard: list[int] = []
    torch.manual_seed(5)
    first = train_local_global(*rods, settings, on_epoch=lambda report: heard.append(report.step), every=3)
    torch.manual_seed(6)
    second = train_local_global(*rods, settings)
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))
    assert heard == [3, 6, 7]


def test_saved_and_loaded(trained: LocalGlobalNet, tmp_path):
    x = torch.from_numpy(helices(3, 5)[0])
    save_local_global(tmp_path / "net.pt", trained, LocalGlobalTraining(**SMALL))
    with torch.inference_mode():
        assert torch.equal(load_local_global(tmp_path / "net.pt")(x), trained(x))


def test_noise_of_a_batch():
    generator = np.random.default_rng(0)
    errors = np.full((3, 150, 3), 5.0, dtype=np.float32)
    settings = LocalGlobalTraining(batch_size=200, noise=(1e-3, 1e-2), reconstructed=0.25)
    noise = draw_noise(settings, generator, ReconstructionNoise(errors))
    assert np.all(noise[:50] == 5.0)
    deviation = noise[50:].std(axis=(1, 2))
    assert 1e-3 * 0.85 < deviation.min() < 1.5e-3
    assert 7e-3 < deviation.max() < 1.15e-2
    assert abs(draw_noise(settings, generator, None)).max() < 0.1


def test_reconstruction_noise_keeps_mean_and_covariance(tmp_path):
    generator = np.random.default_rng(1)
    true = generator.normal(size=(400, 5, 3))
    mixing = generator.normal(size=(15, 15)) * 0.01
    error = (generator.normal(size=(400, 15)) @ mixing + 0.02).reshape(400, 5, 3)
    verdict = np.where(np.arange(400) < 300, "good", "poor")
    np.savez(tmp_path / "r.npz", true=true, reconstructed=true + error, verdict=verdict)
    noise = ReconstructionNoise.load(tmp_path / "r.npz")
    assert len(noise.errors) == 300
    drawn = noise.draw(20_000, generator).reshape(-1, 15)
    measured = noise.errors.reshape(-1, 15)
    np.testing.assert_allclose(drawn.mean(axis=0), measured.mean(axis=0), atol=1e-3)
    np.testing.assert_allclose(np.cov(drawn.T), np.cov(measured.T), atol=0.06 * np.cov(measured.T).max())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"steps": 0}, "steps must be more than 0 and finite, and is 0"),
        ({"noise": (0.1, 0.01)}, "noise must be two shares of L"),
        ({"reconstructed": 1.5}, "reconstructed must be from 0 to 1"),
    ],
)
def test_bad_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        LocalGlobalTraining(**settings)


def test_bad_rods():
    line, strains = helices(3, 6)
    with pytest.raises(ValueError, match="must be of the same rods"):
        train_local_global(line, strains[:2], LocalGlobalTraining(**SMALL))
