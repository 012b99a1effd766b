from dataclasses import replace

import pytest
import torch
from stickslip_training.engine import fit as module
from stickslip_training.engine.fit import (
    FitSettings,
    Learner,
    cosine_rate,
    fit,
    load_tensors,
    seeded,
)
from torch import nn

SETTINGS = FitSettings(steps=23, epoch=5, seed=3, averaging=0.9, clip=1.0, threads=1)


class Line(Learner):
    """y = 2 x - 1 from points that each step draws by itself, through dropout: torch's generator is
    at work, too.
    """

    def __init__(self, validates=True):
        with seeded(0):
            self.net = nn.Sequential(nn.Linear(1, 16), nn.Dropout(0.1), nn.Linear(16, 1))
        self.validates = validates

    def optimizer(self, parameters):
        return torch.optim.AdamW(parameters, lr=0.0)

    def learning_rate(self, step):
        return cosine_rate(0.1, step, 400, 5)

    def loss(self, net, step):
        x = torch.randn(32, 1, generator=torch.Generator().manual_seed(step))
        return (net(x) - (2 * x - 1)).square().mean()

    def validate(self, net):
        x = torch.linspace(-1, 1, 11)[:, None]
        return (net(x) - (2 * x - 1)).square().mean().item() if self.validates else None


@pytest.fixture(scope="module", autouse=True)
def imported():
    """Torch's first optimizer imports its compiler, which costs a second of CPU time."""
    Line().optimizer([torch.zeros(1)])


def equal(first, second):
    pairs = zip(first.state_dict().values(), second.state_dict().values(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.physics
def test_it_learns_and_keeps_the_best_weights():
    fitted = fit(Line(), replace(SETTINGS, steps=400, averaging=0.0))
    losses = [report.validation_loss for report in fitted.run.history]
    assert min(losses) < 0.02 < losses[0]
    assert fitted.run.history[losses.index(min(losses))].step == fitted.run.best_step
    assert Line().validate(fitted.net) == min(losses)
    assert not fitted.net.training


def test_without_validation_the_last_weights_are_kept():
    assert fit(Line(validates=False), SETTINGS).run.best_step == 23


def test_the_same_settings_give_the_same_weights_and_leave_the_generator_alone():
    torch.manual_seed(7)
    state = torch.get_rng_state()
    first = fit(Line(), SETTINGS)
    assert torch.equal(torch.get_rng_state(), state)
    torch.manual_seed(8)
    assert equal(first.net, fit(Line(), SETTINGS).net)
    assert not equal(first.net, fit(Line(), replace(SETTINGS, seed=4)).net)


@pytest.mark.parametrize("stop", [10, 12])
def test_resume_equals_uninterrupted_to_the_bit(tmp_path, stop):
    straight = fit(Line(), SETTINGS, out=tmp_path / "straight")
    fit(Line(), replace(SETTINGS, steps=stop), out=tmp_path / "stopped")
    resumed = fit(Line(), SETTINGS, out=tmp_path / "stopped", resume=True)
    assert equal(resumed.net, straight.net)
    assert resumed.run.best_step == straight.run.best_step
    lines = [
        [(report.step, report.train_loss, report.validation_loss) for report in fitted.run.history]
        for fitted in (straight, resumed)
    ]
    assert lines[0] == lines[1]
    ends = [load_tensors(tmp_path / name / "checkpoint.pt") for name in ("straight", "stopped")]
    assert all(torch.equal(ends[0]["net"][name], ends[1]["net"][name]) for name in ends[0]["net"])


def test_a_checkpoint_within_an_epoch_is_as_good(tmp_path, monkeypatch):
    class Killed(Line):
        def loss(self, net, step):
            if step == 13:
                raise KeyboardInterrupt
            return super().loss(net, step)

    monkeypatch.setattr(module, "_CHECKPOINT_SECONDS", 0.0)  # after every step
    with pytest.raises(KeyboardInterrupt):
        fit(Killed(), SETTINGS, out=tmp_path)
    assert load_tensors(tmp_path / "checkpoint.pt")["state"]["step"] == 13
    assert equal(fit(Line(), SETTINGS, out=tmp_path, resume=True).net, fit(Line(), SETTINGS).net)


def test_a_resumed_run_must_be_the_same(tmp_path):
    fit(Line(), SETTINGS, out=tmp_path, identity={"data": "a"})
    for changed, identity, message in (
        (
            replace(SETTINGS, seed=9),
            {"data": "a"},
            "seed must be that of the run that is resumed, 3, and is 9",
        ),
        (SETTINGS, {"data": "b"}, "data must be that of the run that is resumed, a, and is b"),
    ):
        with pytest.raises(ValueError, match=message):
            fit(Line(), changed, out=tmp_path, identity=identity, resume=True)
    with pytest.raises(ValueError, match="there is nothing to resume"):
        fit(Line(), SETTINGS, out=tmp_path / "nowhere", resume=True)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 0}, "steps must be more than 0"),
        ({"epoch": 0}, "epoch must be more than 0"),
        ({"clip": -1.0}, "clip must be more than 0"),
        ({"averaging": 1.0}, "averaging must be from 0"),
        ({"device": "toaster"}, "device must be one that torch can use here, and is toaster"),
    ],
)
def test_settings_are_checked(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(SETTINGS, **changes)
