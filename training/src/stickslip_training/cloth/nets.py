"""The network that measures friction."""

from itertools import pairwise

import torch
from torch import nn

from stickslip_training.cloth.crop import HEIGHT, WIDTH

_SILHOUETTE_AT = 2  # number of the convolution that sees the silhouette: frames have its size there


class PosteriorNet(nn.Module):
    """Holder-registered crops (B, F, 72, 88) and directions of view (B, 3) to log p(m), (B, M), and log p(mu | m), (B,
    M, K).

    Every frame goes through the same four convolutions and keeps its places: friction shows in where an edge lies, to
    a part of a pixel. The third also sees the silhouette, which has its size. Frames are at fixed phases of the path of
    the holders, so each has a place of its own in the layer that joins them.
    """

    def __init__(self, *, materials: int, bins: int, frames: int, width: int = 96, dropout: float = 0.0) -> None:
        super().__init__()
        self.sizes = {"materials": materials, "bins": bins, "frames": frames, "width": width}
        channels = (1, width // 6, width // 3, width // 2, 2 * width // 3)
        layers: list[nn.Module] = []
        for number, (before, after) in enumerate(pairwise(channels)):
            kernel = 5 if number == 0 else 3
            seen = before + (number == _SILHOUETTE_AT)
            layers += [nn.Conv2d(seen, after, kernel, stride=2, padding=kernel // 2), nn.GroupNorm(8, after), nn.ReLU()]
        self.encoder = nn.Sequential(*layers, nn.Flatten())
        places = channels[-1] * -(-HEIGHT // 16) * -(-WIDTH // 16)
        self.frame = nn.Sequential(nn.Linear(places, width), nn.LayerNorm(width), nn.ReLU())
        self.joined = nn.Sequential(
            nn.Linear(frames * width + 3, 2 * width),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Linear(2 * width, 2 * width),
            nn.ReLU(),
        )
        self.material = nn.Linear(2 * width, materials)
        self.mu = nn.Linear(2 * width, materials * bins)
        self.silhouette = _silhouette_net()

    def features(
        self, crops: torch.Tensor, direction: torch.Tensor, silhouettes: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Return what material and mu are read off, (B, 2 width); `silhouettes` are found if they are not given."""
        clips, frames = crops.shape[:2]
        deviation, mean = torch.std_mean(crops, dim=(1, 2, 3), keepdim=True)
        x = (crops - mean) / (deviation + 1e-3)
        masks = (self.seen_silhouettes(crops) if silhouettes is None else silhouettes).flatten(0, 1)[:, None]
        early, late = self.encoder[: 3 * _SILHOUETTE_AT], self.encoder[3 * _SILHOUETTE_AT :]
        seen = torch.cat([early(x.reshape(clips * frames, 1, *crops.shape[2:])), masks], dim=1)
        features = self.frame(late(seen))
        return torch.as_tensor(self.joined(torch.cat([features.reshape(clips, -1), direction], dim=1)))

    def read(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return log p(m) and log p(mu | m) of features."""
        mu = self.mu(features).reshape(len(features), self.sizes["materials"], self.sizes["bins"])
        return torch.log_softmax(self.material(features), dim=1), torch.log_softmax(mu, dim=2)

    @torch.no_grad()
    def seen_silhouettes(self, crops: torch.Tensor) -> torch.Tensor:
        """Return the silhouettes that the network sees, 0 to 1, (B, F, 18, 22): the reader does not teach them."""
        return self.silhouettes(crops).sigmoid()

    def silhouettes(self, crops: torch.Tensor) -> torch.Tensor:
        """Return logits of the share that cloth covers of each 4 x 4 pixels of crops (B, F, 72, 88): (B, F, 18, 22).

        Mean and deviation over the frames of a clip are seen, too: a floor stays, and cloth moves.
        """
        deviation, mean = torch.std_mean(crops, dim=(1, 2, 3), keepdim=True)
        x = (crops - mean) / (deviation + 1e-3)
        still = [part.expand_as(x) for part in reversed(torch.std_mean(x, dim=1, keepdim=True))]
        logits = self.silhouette(torch.stack([x, *still], dim=2).flatten(0, 1))
        return torch.as_tensor(logits.reshape(*crops.shape[:2], *logits.shape[2:]))


def _silhouette_net() -> nn.Sequential:
    """Return the layers that find cloth; dilations let every place see most of the crop."""
    layers: list[nn.Module] = [nn.PixelUnshuffle(2)]
    sizes = [(12, 32, 1, 1), (32, 48, 2, 1), *((48, 48, 1, dilation) for dilation in (1, 2, 4, 1))]
    for before, after, stride, dilation in sizes:
        layers += [nn.Conv2d(before, after, 3, stride, dilation, dilation), nn.GroupNorm(8, after), nn.ReLU()]
    return nn.Sequential(*layers, nn.Conv2d(48, 1, 1))
