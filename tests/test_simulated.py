"""A run of cloth as a function of PyTorch has the Jacobian of a fit."""

import numpy as np
import pytest
import torch
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.observations import Vertices
from stickslip_sim_core.scenes import cloth_drag
from stickslip_sim_core.scenes.family import SceneFamily
from stickslip_training.simulated import simulated
from torch import Tensor

NAMES = ("mu", "bending")
VALUES = torch.tensor([0.3, 1.2], dtype=torch.float64)
FRAMES = (18, 21, 23)
NOISE = 5e-4

pytestmark = [
    pytest.mark.physics,
    # PyTorch's own forward mode warns of its scripts, once in a process.
    pytest.mark.filterwarnings("ignore:.torch.jit.script. is:DeprecationWarning"),
]


@pytest.fixture(scope="module")
def drags() -> SceneFamily:
    return cloth_drag.family("gray-interlock", 0.3, mesh=7, frames=24, preset="fast")


@pytest.fixture(scope="module")
def observed(drags: SceneFamily) -> Vertices:
    positions = drags.scene(mu=0.4).run().positions[list(FRAMES)]
    return Vertices(FRAMES, positions, np.arange(49), NOISE)


def positions_of(drags: SceneFamily, values: Floats) -> tuple[Floats, Floats]:
    around = drags.with_values(dict(zip(NAMES, values.tolist(), strict=True)))
    run = around.differentiated(NAMES).run()
    return run.positions, np.stack([run.sensitivities[name].positions for name in NAMES])


def test_gradient_and_products_are_those_of_the_jacobian_of_a_fit(
    drags: SceneFamily, observed: Vertices
) -> None:
    run = (
        drags.with_values(dict(zip(NAMES, VALUES.tolist(), strict=True)))
        .differentiated(NAMES)
        .run()
    )
    compared = observed.compare(run, [run.sensitivities[name].positions for name in NAMES])
    residual, J = compared.residual, compared.jacobian

    def residual_of(values: Tensor) -> Tensor:
        positions = simulated(lambda at: positions_of(drags, at), values)[list(FRAMES)]
        return ((positions - torch.from_numpy(observed.positions)) / NOISE).flatten()

    values = VALUES.clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(0.5 * residual_of(values).square().sum(), values)
    expected = J.T @ residual
    assert np.abs(expected).min() > 0.0
    np.testing.assert_allclose(gradient.numpy(), expected, rtol=1e-10)
    for number in range(len(NAMES)):
        unit = torch.eye(len(NAMES), dtype=torch.float64)[number]
        _, product = torch.func.jvp(residual_of, (VALUES,), (unit,))
        np.testing.assert_allclose(product.numpy(), J[:, number], rtol=1e-10, atol=1e-12)
