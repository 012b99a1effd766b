"""Runs of a simulator as functions of PyTorch.

Derivatives by a few parameters come with a run of cloth. `simulated` hands them to PyTorch, so that
a loss of positions has a gradient by friction and stiffness, and networks can stand before and
behind the simulator.
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from stickslip_training.arrays import AnyFloats, Floats

Simulator: TypeAlias = Callable[[Floats], tuple[AnyFloats, AnyFloats]]
"""Function of the values (P,) of parameters that returns an array of a run, of any shape S, and
its derivatives by each parameter (P, *S).
"""


def simulated(simulator: Simulator, values: Tensor) -> Tensor:
    """Return the array of a run, with its derivatives by the parameters.

    Both modes of differentiation take one run: a gradient, and a product with the Jacobian
    (`torch.func.jvp`). Second derivatives are refused.

    Args:
        simulator: It is called once, with the values in double precision.
        values: Values of the parameters (P,).

    Raises:
        ValueError: The derivatives have another shape, or are not finite.
    """
    # PyTorch gives `apply` no types.
    apply: Callable[..., tuple[Tensor, Tensor]] = _Simulated.apply
    return apply(values, simulator)[0]


class _Simulated(torch.autograd.Function):
    # PyTorch fixes the names and the arguments of these functions.

    @staticmethod
    def forward(values: Tensor, simulator: Simulator) -> tuple[Tensor, Tensor]:
        array, by = simulator(values.detach().to("cpu", torch.float64).numpy().copy())
        _check(array, by, len(values))
        dtype, device = values.dtype, values.device
        return (
            torch.as_tensor(array, dtype=dtype, device=device),
            torch.as_tensor(by, dtype=dtype, device=device),
        )

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        by = output[1]
        ctx.mark_non_differentiable(by)
        ctx.save_for_backward(by)
        ctx.save_for_forward(by)

    @staticmethod
    # A run has no derivatives of its derivatives, and zeros in their place would be wrong.
    @once_differentiable
    def backward(ctx: Any, by_array: Tensor, _by_derivatives: Tensor) -> tuple[Tensor, None]:
        (by,) = ctx.saved_tensors
        return (by * by_array).flatten(start_dim=1).sum(dim=1), None

    @staticmethod
    def jvp(ctx: Any, change: Tensor, _simulator: None) -> tuple[Tensor, None]:
        (by,) = ctx.saved_tensors
        return torch.tensordot(change, by, dims=1), None


def _check(array: AnyFloats, by: AnyFloats, parameters: int) -> None:
    if by.shape != (parameters, *array.shape):
        raise ValueError(
            f"derivatives: must have the shape {(parameters, *array.shape)}, got {by.shape}"
        )
    # A gradient of NaN would spoil all weights of a network without a word.
    for name, numbers in (("array", array), ("derivatives", by)):
        if not torch.isfinite(torch.as_tensor(numbers)).all():
            raise ValueError(f"{name}: of a run must be finite")
