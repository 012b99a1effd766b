"""Derivatives that come with a run, in both modes of PyTorch."""

import numpy as np
import pytest
import torch
from stickslip_training.simulated import simulated

# PyTorch's own forward mode warns of its scripts, once in a process.
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is:DeprecationWarning")

VALUES = torch.tensor([0.3, 2.0], dtype=torch.float64)


def spring(values):
    """Return x = a sin(b t) at five instants, and its derivatives by a and b."""
    a, b = values
    t = np.linspace(0.0, 1.0, 5)
    return a * np.sin(b * t), np.stack([np.sin(b * t), a * t * np.cos(b * t)])


def test_gradients_are_those_of_differences():
    values = VALUES.clone().requires_grad_(True)
    assert torch.autograd.gradcheck(
        lambda v: simulated(spring, v), (values,), check_forward_ad=True
    )


def test_loss_has_its_gradient():
    values = VALUES.clone().requires_grad_(True)
    loss = (simulated(spring, values) ** 2).sum() / 2
    loss.backward()
    array, by = spring(VALUES.numpy())
    np.testing.assert_allclose(values.grad.numpy(), by @ array, rtol=1e-12)


def test_product_with_the_jacobian_takes_one_run():
    runs = []

    def counted(values):
        runs.append(values)
        return spring(values)

    change = torch.tensor([0.5, -1.0], dtype=torch.float64)
    array, product = torch.func.jvp(lambda v: simulated(counted, v), (VALUES,), (change,))
    expected, by = spring(VALUES.numpy())
    np.testing.assert_allclose(array.numpy(), expected)
    np.testing.assert_allclose(product.numpy(), change.numpy() @ by)
    assert len(runs) == 1


def test_values_of_single_precision_reach_the_simulator_in_double():
    def checked(values):
        assert values.dtype == np.float64
        return spring(values)

    values = VALUES.float().requires_grad_(True)
    array = simulated(checked, values)
    assert array.dtype == torch.float32
    array.sum().backward()
    assert values.grad.dtype == torch.float32


def test_second_derivatives_are_refused():
    values = VALUES.clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(
        (simulated(spring, values) ** 2).sum(), values, create_graph=True
    )
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda array, by: (array, by.T), r"must have the shape \(2, 5\), got \(5, 2\)"),
        (lambda array, by: (array, by * np.nan), "derivatives: of a run must be finite"),
        (lambda array, by: (array + np.inf, by), "array: of a run must be finite"),
    ],
)
def test_wrong_runs_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        simulated(lambda values: change(*spring(values)), VALUES)
