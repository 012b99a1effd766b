"""Two real processes train one network; this file is what they run, too."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from stickslip_training.engine.files import save_tensors
from stickslip_training.engine.fit import FitSettings, Learner, fit, seeded
from stickslip_training.engine.ranks import Rank, averaged, current_rank, joined
from torch import nn

pytestmark = pytest.mark.physics

SETTINGS = FitSettings(steps=23, epoch=5, seed=3, averaging=0.9, clip=0.05, threads=1)


class Line(Learner):
    """y = 2 x - 1 from points that each step draws; `dropout` makes torch's generator matter."""

    def __init__(self, dropout=0.0):
        with seeded(0):
            self.net = nn.Sequential(nn.Linear(1, 16), nn.Tanh(), nn.Dropout(dropout), nn.Linear(16, 1))
        self.rank = Rank()
        self.validations = 0

    def share(self, rank):
        self.rank = rank

    def optimizer(self, parameters):
        return torch.optim.SGD(parameters, lr=0.5)

    def loss(self, net, step):
        x = torch.randn(32, 1, generator=torch.Generator().manual_seed(step))[self.rank.number :: self.rank.count]
        return (net(x) - (2 * x - 1)).square().mean()

    def validate(self, net):
        self.validations += 1
        x = torch.linspace(-1, 1, 11)[:, None]
        return (net(x) - (2 * x - 1)).square().mean().item()


class Alone(Line):
    share = Learner.share


def run_in_each_process(folder):
    """Train, stop and go on, and keep what each process has."""
    with joined("cpu"):
        rank = current_rank()
        plain = Line()
        whole = fit(plain, SETTINGS, out=folder / "whole")
        dropped = fit(Line(0.2), SETTINGS, out=folder / "straight")
        fit(Line(0.2), replace(SETTINGS, steps=12), out=folder / "stopped")
        resumed = fit(Line(0.2), SETTINGS, out=folder / "stopped", resume=True)
        try:
            fit(Alone(), SETTINGS)
            refusal = ""
        except ValueError as error:
            refusal = str(error)
        save_tensors(
            folder / f"rank-{rank.number}.pt",
            {
                "whole": whole.net.state_dict(),
                "history": [(each.train_loss, each.validation_loss) for each in whole.history],
                "validations": plain.validations,
                "dropped": dropped.net.state_dict(),
                "resumed": resumed.net.state_dict(),
                "refusal": refusal,
            },
        )


@pytest.fixture(scope="module")
def processes(tmp_path_factory):
    """What two processes of torchrun ended with, and their folder."""
    folder = tmp_path_factory.mktemp("ranks")
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", __file__]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run([*command, str(folder)], capture_output=True, text=True, timeout=300, env=environment)
    assert done.returncode == 0, done.stderr[-3000:]
    return [torch.load(folder / f"rank-{number}.pt", weights_only=True) for number in range(2)], folder


def same(first, second):
    return all(torch.equal(first[name], second[name]) for name in first)


def test_both_processes_have_the_same_weights(processes):
    (first, second), _ = processes
    for name in ("whole", "dropped", "resumed"):
        assert same(first[name], second[name]), name
    assert first["history"] == second["history"]
    assert (first["validations"], second["validations"]) == (5, 0)


def test_two_halves_of_a_batch_teach_what_the_whole_one_does(processes):
    (first, _), _ = processes
    alone = fit(Line(), SETTINGS)
    for name, tensor in alone.net.state_dict().items():
        torch.testing.assert_close(first["whole"][name], tensor, rtol=1e-5, atol=1e-6)
    for (loss, validation), report in zip(first["history"], alone.history, strict=True):
        assert loss == pytest.approx(report.train_loss, rel=1e-5)
        assert validation == pytest.approx(report.validation_loss, rel=1e-5)
    start = Line().net.state_dict()
    assert all((first["whole"][name] - tensor).norm() > 1e-2 for name, tensor in start.items() if tensor.ndim > 1)


def test_resume_equals_uninterrupted_in_two_processes(processes):
    (first, _), folder = processes
    assert same(first["resumed"], first["dropped"])
    with pytest.raises(ValueError, match="processes must be that of the run that is resumed, 2, and is 1"):
        fit(Line(0.2), SETTINGS, out=folder / "stopped", resume=True)


def test_dropout_differs_between_processes(processes):
    """The mask of a step depends on the process: two with the same one would learn from less."""
    (first, _), _ = processes
    assert not same(first["dropped"], first["whole"])
    assert Rank(1, 2).seeds != Rank(0, 2).seeds
    assert Rank().seeds == ()


def test_a_model_for_one_process_is_refused(processes):
    for each in processes[0]:
        assert each["refusal"] == "one process must train this model, and there are 2"


def test_alone_nothing_is_averaged():
    net = nn.Linear(1, 1)
    loss = net(torch.ones(1, 1)).sum()
    assert averaged(net, loss) is loss
    with joined("cpu") as device:
        assert (device, current_rank()) == ("cpu", Rank(0, 1))


if __name__ == "__main__":
    run_in_each_process(Path(sys.argv[1]))
