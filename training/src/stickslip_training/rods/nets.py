"""The network of Table 5.1 of the thesis, which estimates the strains of a rod from its centreline."""

import torch
from torch import nn

from stickslip_training.rods.dataset import POINTS


class CurvatureNet(nn.Module):
    """Centreline over L, (B, 150, 3), to strains (twist, bend1, bend2) times L, (B, 150, 3).

    The table is silent on four things. What was chosen, and why:

    * Convolutions are padded to keep the length: every one of the 150 points is then the middle of a filter, the clamp
      and the free end too, where the rod bears all of its weight and
      none.
    * Poolings are not padded: a maximum over a window that reaches beyond the end adds nothing to the one that does
      not. With stride 1 they shorten 150 points to 148, 147 and 146.
    * The second block of the name conv2 has weights of its own; with 128 channels in and not 64 it could not share.
    * Inputs and outputs are standardised by fixed numbers, buffers and so part of the state: mean and deviation at each
      point for the centreline, for each strain over all points for the output. Adadelta starts with steps of about
      1e-3, and the strains are of order 10.
    """

    def __init__(self) -> None:
        super().__init__()

        def convolution(channels_in: int, channels_out: int) -> list[nn.Module]:
            return [nn.Conv1d(channels_in, channels_out, kernel_size=3, padding="same"), nn.ReLU()]

        self.features = nn.Sequential(
            *convolution(3, 64),
            *convolution(64, 64),
            nn.MaxPool1d(3, stride=1),
            *convolution(64, 128),
            *convolution(128, 128),
            nn.MaxPool1d(2, stride=1),
            *convolution(128, 128),
            *convolution(128, 128),
            nn.MaxPool1d(2, stride=1),
        )
        self.head = nn.Sequential(
            nn.Flatten(), nn.Linear(128 * (POINTS - 4), 512), nn.ReLU(), nn.Linear(512, POINTS * 3)
        )
        self.input_mean: torch.Tensor
        self.input_scale: torch.Tensor
        self.output_mean: torch.Tensor
        self.output_scale: torch.Tensor
        self.register_buffer("input_mean", torch.zeros(POINTS, 3))
        self.register_buffer("input_scale", torch.ones(POINTS, 3))
        self.register_buffer("output_mean", torch.zeros(3))
        self.register_buffer("output_scale", torch.ones(3))

    def standardise(self, centerline: torch.Tensor, strains: torch.Tensor, noise: float) -> None:
        """Set the standardisation from the training rods, (rods, 150, 3) each, seen with `noise` (of L)."""
        spread = centerline.double().var(dim=0, correction=0) + noise**2
        self.input_mean.copy_(centerline.double().mean(dim=0))
        self.input_scale.copy_(_positive(spread.sqrt()))
        self.output_mean.copy_(strains.double().mean(dim=(0, 1)))
        self.output_scale.copy_(_positive(strains.double().std(dim=(0, 1), correction=0)))

    def forward(self, centerline: torch.Tensor) -> torch.Tensor:
        """Estimate the strains of a batch of centrelines."""
        x = (centerline - self.input_mean) / self.input_scale
        y = self.head(self.features(x.transpose(1, 2)))
        return torch.as_tensor(y.reshape(-1, POINTS, 3) * self.output_scale + self.output_mean)


def root_mean_square_loss(estimate: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Return the root of the mean square of all differences, the loss of the thesis."""
    return torch.sqrt(torch.mean(torch.square(estimate - truth)))


def _positive(scale: torch.Tensor) -> torch.Tensor:
    """Return `scale`, and 1 where it is 0: a number that is always the same (the clamp's position) stays 0."""
    return torch.where(scale > 1e-12, scale, torch.ones_like(scale))
