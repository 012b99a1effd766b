"""Several processes that train one network: each computes a share of every batch, and the gradients are averaged.

    torchrun --standalone --nproc-per-node 4 -m stickslip_training.cli cloth train RUNS --out DIR

The whole network is in every process. A step ends with one all-reduce of all gradients: these networks are small.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import distributed, nn

T = TypeVar("T")


@dataclass(frozen=True)
class Rank:
    """Which of the processes this is."""

    number: int = 0
    count: int = 1

    @property
    def is_first(self) -> bool:
        """Whether this process validates, writes files and prints."""
        return self.number == 0

    @property
    def seeds(self) -> tuple[int, ...]:
        """What enters the seeds of a share; nothing where one process trains alone."""
        return () if self.count == 1 else (self.number,)


def current_rank() -> Rank:
    """Return which of the processes this is; the only one outside of `joined`."""
    if distributed.is_available() and distributed.is_initialized():
        return Rank(distributed.get_rank(), distributed.get_world_size())
    return Rank()


@contextmanager
def joined(device: str) -> Iterator[str]:
    """Join the processes that torchrun started, if it did, within the block; yield the device of this process."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield device
        return
    if device == "cuda":
        device = f"cuda:{os.environ['LOCAL_RANK']}"
        torch.cuda.set_device(device)
    distributed.init_process_group("nccl" if device.startswith("cuda") else "gloo")
    try:
        yield device
    finally:
        distributed.destroy_process_group()


def of_first(value: T) -> T:
    """Return the value of the first process in all of them."""
    if current_rank().count == 1:
        return value
    shared = [value]
    distributed.broadcast_object_list(shared, src=0)
    return shared[0]


def weights_of_first(net: nn.Module) -> None:
    """Give the weights of the first process's network to those of all."""
    if current_rank().count > 1:
        for tensor in net.state_dict().values():
            distributed.broadcast(tensor, src=0)


def averaged(net: nn.Module, loss: torch.Tensor) -> torch.Tensor:
    """Replace every gradient by its mean over the processes, and return the mean of the losses."""
    count = current_rank().count
    if count == 1:
        return loss
    gradients = [weight.grad for weight in net.parameters() if weight.grad is not None]
    if len(gradients) < len(list(net.parameters())):
        raise ValueError("every weight must have a gradient where several processes train")
    flat = torch.cat([*(gradient.flatten() for gradient in gradients), loss.detach().reshape(1)])
    distributed.all_reduce(flat)
    flat /= count
    means = torch.split(flat[:-1], [gradient.numel() for gradient in gradients])
    for gradient, mean in zip(gradients, means, strict=True):
        gradient.copy_(mean.view_as(gradient))
    return flat[-1]
