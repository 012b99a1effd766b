"""The networks that measure friction: one of ours, and the two of the thesis [thesis, 4.4]."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import nn

from stickslip_training.cloth.crop import HEIGHT, WIDTH


class PosteriorNet(nn.Module):
    """Holder-registered crops (B, F, 72, 88) and directions of view (B, 3) to log p(m), (B, M), and log p(mu | m), (B,
    M, K); with `quantities`, the bins of each, also to histograms of these: see `fabric`.

    Every frame goes through the same four convolutions and keeps its places: what tells friction is where an edge lies,
    to a part of a pixel. Frames are phase-locked to the stage, so each has a place of its own in the layer that joins
    them.
    """

    def __init__(
        self, *, materials: int, bins: int, frames: int, width: int = 96, quantities: Sequence[int] = ()
    ) -> None:
        super().__init__()
        self.sizes = {"materials": materials, "bins": bins, "frames": frames, "width": width}
        self.quantity_bins = list(quantities)
        channels = (1, 16, 32, 48, 64)
        layers: list[nn.Module] = []
        for before, after in pairwise(channels):
            kernel = 5 if before == 1 else 3
            layers += [
                nn.Conv2d(before, after, kernel, stride=2, padding=kernel // 2),
                nn.GroupNorm(8, after),
                nn.ReLU(),
            ]
        self.encoder = nn.Sequential(*layers, nn.Flatten())
        places = channels[-1] * -(-HEIGHT // 16) * -(-WIDTH // 16)
        self.frame = nn.Sequential(nn.Linear(places, width), nn.LayerNorm(width), nn.ReLU())
        self.joined = nn.Sequential(
            nn.Linear(frames * width + 3, 2 * width),
            nn.ReLU(),
            nn.Dropout(0.1),
            nn.Linear(2 * width, 2 * width),
            nn.ReLU(),
        )
        self.material = nn.Linear(2 * width, materials)
        self.mu = nn.Linear(2 * width, materials * bins)
        self.quantities = nn.ModuleList(nn.Linear(2 * width, count) for count in quantities)

    def features(self, crops: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
        """Return what material and mu are read off, (B, 2 width)."""
        clips, frames = crops.shape[:2]
        deviation, mean = torch.std_mean(crops, dim=(1, 2, 3), keepdim=True)
        x = (crops - mean) / (deviation + 1e-3)
        features = self.frame(self.encoder(x.reshape(clips * frames, 1, *crops.shape[2:])))
        return torch.as_tensor(self.joined(torch.cat([features.reshape(clips, -1), direction], dim=1)))

    def read(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return log p(m) and log p(mu | m) of features."""
        mu = self.mu(features).reshape(len(features), self.sizes["materials"], self.sizes["bins"])
        return torch.log_softmax(self.material(features), dim=1), torch.log_softmax(mu, dim=2)

    def read_quantities(self, features: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return log p(q), (B, bins), of each quantity."""
        return tuple(torch.log_softmax(head(features), dim=1) for head in self.quantities)

    def forward(self, crops: torch.Tensor, direction: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return log p(m) and log p(mu | m)."""
        return self.read(self.features(crops, direction))


class Extractor(nn.Sequential):
    """Pictures (N, 3, H, W) to features (N, 512) [thesis, Table 4.3].

    The table is silent on four things. Convolutions are padded to keep the size. Poolings, 3 x 3 with stride 2, are
    padded by 1, so that 224 becomes 112, 56 and 28. Weights are drawn so that features keep their size from layer to
    layer [He et al. 2015]: with torch's default they shrink. How the last map of 512 x 28 x 28 enters the LSTM is not
    said; flattened it would take 411 million weights for 256 units. It is averaged over its places.
    """

    def __init__(self) -> None:
        def convolution(before: int, after: int) -> list[nn.Module]:
            return [nn.Conv2d(before, after, 3, padding=1), nn.ReLU()]

        super().__init__(
            *convolution(3, 64),
            *convolution(64, 64),
            nn.MaxPool2d(3, stride=2, padding=1),
            *convolution(64, 128),
            *convolution(128, 128),
            nn.MaxPool2d(3, stride=2, padding=1),
            *convolution(128, 256),
            nn.MaxPool2d(3, stride=2, padding=1),
            *convolution(256, 512),
            nn.AdaptiveAvgPool2d(1),
            nn.Flatten(),
        )
        for layer in self:
            if isinstance(layer, nn.Conv2d) and layer.bias is not None:
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)


class BaselineNet(nn.Module):
    """Clips (B, F, 3, H, W), 0 to 1, to logits (B, classes) [thesis, Eq. 4.2]: `Extractor`, two LSTM, two dense layers.

    256 units in each LSTM and in the first dense layer, and a dropout of 0.5 between the dense ones, are ours: the text
    gives no number. The classes are the materials, or the values of mu.
    """

    def __init__(self, classes: int, *, units: int = 256, extra: int = 0) -> None:
        super().__init__()
        self.extractor = Extractor()
        self.lstm = nn.LSTM(512 + extra, units, num_layers=2, batch_first=True)
        self.head = nn.Sequential(nn.Linear(units, units), nn.ReLU(), nn.Dropout(0.5), nn.Linear(units, classes))

    def features(self, clips: torch.Tensor) -> torch.Tensor:
        """Return the features of every frame, (B, F, 512)."""
        return torch.as_tensor(self.extractor(clips.flatten(0, 1)).reshape(*clips.shape[:2], -1))

    def classes(self, features: torch.Tensor) -> torch.Tensor:
        """Return the logits of features (B, F, n): of the last state of the second LSTM."""
        return torch.as_tensor(self.head(self.lstm(features)[0][:, -1]))

    def forward(self, clips: torch.Tensor) -> torch.Tensor:
        """Return logits."""
        return self.classes(self.features(clips))


class ConditionalNet(BaselineNet):
    """Clips and the codes of their materials (B,) to logits of the values of mu [thesis, Eq. 4.3].

    The material, one-hot, goes through a dense layer with softmax and joins the features of each frame. The layer has
    as many units as there are materials: the text gives no number.
    """

    def __init__(self, classes: int, materials: int, *, units: int = 256) -> None:
        super().__init__(classes, units=units, extra=materials)
        self.condition = nn.Sequential(nn.Linear(materials, materials), nn.Softmax(dim=1))
        self.materials = materials

    def forward(self, clips: torch.Tensor, material: torch.Tensor | None = None) -> torch.Tensor:
        """Return logits."""
        if material is None:
            raise ValueError("material must be given: the answer is for a known material")
        one_hot = nn.functional.one_hot(material, self.materials).to(clips.dtype)
        repeated = self.condition(one_hot)[:, None].expand(-1, clips.shape[1], -1)
        return self.classes(torch.cat([repeated, self.features(clips)], dim=2))
