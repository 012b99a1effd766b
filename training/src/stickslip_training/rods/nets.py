"""Networks that estimate the strains of a rod from its centreline: of Table 5.1, and local-global [thesis, 5.6.1]."""

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
            nn.Flatten(),
            nn.Linear(128 * (POINTS - 4), 512),
            nn.ReLU(),
            nn.Linear(512, POINTS * 3),
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


_COORDINATES = 3 * POINTS
_STRIDE = 6
_KERNEL = 18
_PLACES = (POINTS + 2 * _STRIDE - _KERNEL) // _STRIDE + 1
"""Places along the rod of the local features: windows of 18 points, every 6, that reach over the ends by 6."""


class LocalGlobalNet(nn.Module):
    """Centreline over L, (B, 150, 3), to strains (twist, bend1, bend2) times L, (B, 150, 3).

    Three kinds of features go side by side into a residual network:

    * global: the principal components of whole centrelines, each divided by the deviation that rods and noise give it,
      so that what noise hides is small;
    * local: a convolution over windows of the rod, of which curvature is seen, kept in their order along the rod;
    * the noise: the logarithm of the third differences, which a smooth curve hardly has.

    It answers with amplitudes of the principal components of strains: nothing that no rod does comes out. The
    components are those of the training rods; they are buffers, and so part of the state.
    """

    def __init__(
        self, *, width: int = 384, blocks: int = 4, centerline_modes: int = 128, strain_modes: int = 96, local: int = 16
    ) -> None:
        super().__init__()
        self.sizes = {
            "width": width,
            "blocks": blocks,
            "centerline_modes": centerline_modes,
            "strain_modes": strain_modes,
            "local": local,
        }
        self.windows = nn.Conv1d(3, local, _KERNEL, stride=_STRIDE, padding=_STRIDE)
        self.mix = nn.Conv1d(local, local, 1)
        self.pool = nn.Linear(centerline_modes + 1 + local * _PLACES, width)
        self.blocks = nn.ModuleList(_Block(width) for _ in range(blocks))
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, strain_modes)
        nn.init.zeros_(self.head.weight)
        self.centerline_mean: torch.Tensor
        self.centerline_modes: torch.Tensor
        self.strain_mean: torch.Tensor
        self.strain_modes: torch.Tensor
        self.register_buffer("centerline_mean", torch.zeros(_COORDINATES))
        self.register_buffer("centerline_modes", torch.zeros(_COORDINATES, centerline_modes))
        self.register_buffer("strain_mean", torch.zeros(_COORDINATES))
        self.register_buffer("strain_modes", torch.zeros(strain_modes, _COORDINATES))

    def standardise(self, centerline: torch.Tensor, strains: torch.Tensor, noise: float) -> None:
        """Set the principal components from training rods, (rods, 150, 3) each, seen with white `noise` (of L)."""
        mean, variance, modes = _principal(centerline, self.sizes["centerline_modes"])
        self.centerline_mean.copy_(mean)
        self.centerline_modes.copy_(modes / torch.sqrt(variance + noise**2))
        mean, variance, modes = _principal(strains, self.sizes["strain_modes"])
        self.strain_mean.copy_(mean)
        self.strain_modes.copy_((modes * variance.sqrt()).T)

    def forward(self, centerline: torch.Tensor) -> torch.Tensor:
        """Estimate the strains of a batch of centrelines."""
        rods = len(centerline)
        whole = (centerline.reshape(rods, -1) - self.centerline_mean) @ self.centerline_modes
        windows = self.mix(nn.functional.gelu(self.windows(_SCALE * centerline.transpose(1, 2))))
        rough = torch.diff(centerline, n=3, dim=1).square().mean(dim=(1, 2)).sqrt()
        noise = 0.5 * torch.log(rough + 1e-6) + 2.5
        x = self.pool(torch.cat([whole, noise[:, None], windows.reshape(rods, -1)], dim=1))
        for block in self.blocks:
            x = block(x)
        strains = self.head(self.norm(x)) @ self.strain_modes + self.strain_mean
        return torch.as_tensor(strains.reshape(rods, POINTS, 3))


_SCALE = 20.0  # of positions over L in a window, to numbers of order 1


class _Block(nn.Module):
    """x + two layers of normalised x; the identity before training."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.first = nn.Linear(width, width)
        self.second = nn.Linear(width, width)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.as_tensor(x + self.second(nn.functional.gelu(self.first(self.norm(x)))))


def relative_loss(estimate: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Return the mean over rods of the relative RMS error, of |kappa| plus half that of the strains.

    Relative to the RMS of |kappa|, and rod by rod, as errors are judged: a mean of squares over all rods would be that
    of the few worst. The twist counts 0.3 among the strains: a centreline shows it less.
    """
    scale = truth[..., 1:].square().sum(dim=-1).mean(dim=1)
    weights = torch.tensor([0.3, 1.0, 1.0], device=truth.device)
    strains = ((estimate - truth).square() * weights).sum(dim=-1).mean(dim=1)
    bending = (_bending(estimate) - _bending(truth)).square().mean(dim=1)
    return (torch.sqrt(bending / scale + _TINY) + 0.5 * torch.sqrt(strains / scale + _TINY)).mean()


_TINY = 1e-8  # a square root has no slope at 0


def _bending(strains: torch.Tensor) -> torch.Tensor:
    return torch.sqrt(strains[..., 1].square() + strains[..., 2].square() + 1e-6)


def _principal(fields: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return mean (450,), variances (count,) and components (450, count) of fields (rods, 150, 3)."""
    flat = fields.double().reshape(len(fields), -1)
    mean = flat.mean(dim=0)
    variance, modes = torch.linalg.eigh((flat - mean).T @ (flat - mean) / len(flat))
    return mean, variance.flip(0)[:count].clamp(min=0.0), modes.flip(1)[:, :count]
