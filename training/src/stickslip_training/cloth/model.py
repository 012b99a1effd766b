"""The network that measures friction, trained and calibrated, and its file."""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch
from stickslip_schemas.store import write_durably
from torch import nn

from stickslip_training.arrays import Floats, SingleFloats
from stickslip_training.cloth.clips import CHUNK, Clips
from stickslip_training.cloth.crop import HEIGHT, WIDTH
from stickslip_training.cloth.familiarity import Familiarity
from stickslip_training.cloth.posterior import Bins, Posterior

WEIGHTS = Path(__file__).with_name("friction.safetensors")
"""A trained model that comes with the package; its card names its training data and its errors."""

_SILHOUETTE_AT = 2  # number of the convolution that sees the silhouette: frames have its size there


class PosteriorNet(nn.Module):
    """Network from holder-registered crops to log p(m) and log p(mu | m).

    Crops are (B, F, 72, 88), directions of view (B, 3), log p(m) is (B, M), and log p(mu | m) is
    (B, M, K).

    Every frame goes through the same four convolutions and keeps its places: friction shows in
    where an edge lies, to a part of a pixel. The third also sees the silhouette, which has its
    size. Frames are at fixed phases of the path of the holders, so each has a place of its own in
    the layer that joins them.
    """

    def __init__(
        self, *, materials: int, bins: int, frames: int, width: int = 96, dropout: float = 0.0
    ) -> None:
        super().__init__()
        self.sizes = {"materials": materials, "bins": bins, "frames": frames, "width": width}
        channels = (1, width // 6, width // 3, width // 2, 2 * width // 3)
        layers: list[nn.Module] = []
        for number, (before, after) in enumerate(pairwise(channels)):
            kernel = 5 if number == 0 else 3
            inputs = before + (number == _SILHOUETTE_AT)
            layers += [
                nn.Conv2d(inputs, after, kernel, stride=2, padding=kernel // 2),
                nn.GroupNorm(8, after),
                nn.ReLU(),
            ]
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

    @torch.no_grad()
    def standardize(
        self, crops: torch.Tensor, direction: torch.Tensor, silhouettes: torch.Tensor
    ) -> None:
        """Scale and shift each linear unit to mean 0 and deviation 1 over clips.

        After [Mishkin & Matas 2016].
        """

        def scaled(layer: nn.Module, _: Any, activation: torch.Tensor) -> torch.Tensor:
            assert isinstance(layer, nn.Linear)
            deviation, mean = torch.std_mean(activation, dim=0)
            layer.weight.div_(deviation[:, None])
            layer.bias.sub_(mean).div_(deviation)
            return (activation - mean) / deviation

        hooks = [
            layer.register_forward_hook(scaled)
            for layer in (self.frame[0], self.joined[0], self.joined[3])
        ]
        self.eval().features(crops, direction, silhouettes)
        for hook in hooks:
            hook.remove()
        self.train()

    def features(
        self, crops: torch.Tensor, direction: torch.Tensor, silhouettes: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Return the features from which material and mu are read, (B, 2 width).

        `silhouettes` are found if they are not given.
        """
        clips, frames = crops.shape[:2]
        deviation, mean = torch.std_mean(crops, dim=(1, 2, 3), keepdim=True)
        x = (crops - mean) / (deviation + 1e-3)
        masks = (self.seen_silhouettes(crops) if silhouettes is None else silhouettes).flatten(
            0, 1
        )[:, None]
        early = self.encoder[: 3 * _SILHOUETTE_AT]
        late = self.encoder[3 * _SILHOUETTE_AT :]
        encoded = torch.cat([early(x.reshape(clips * frames, 1, *crops.shape[2:])), masks], dim=1)
        features = self.frame(late(encoded))
        return torch.as_tensor(
            self.joined(torch.cat([features.reshape(clips, -1), direction], dim=1))
        )

    def read(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return log p(m) and log p(mu | m) of features."""
        mu = self.mu(features).reshape(len(features), self.sizes["materials"], self.sizes["bins"])
        return torch.log_softmax(self.material(features), dim=1), torch.log_softmax(mu, dim=2)

    @torch.no_grad()
    def seen_silhouettes(self, crops: torch.Tensor) -> torch.Tensor:
        """Return the silhouettes that the network sees, 0 to 1, (B, F, 18, 22).

        No gradient flows back: the reader does not teach the silhouettes.
        """
        return self.silhouettes(crops).sigmoid()

    def silhouettes(self, crops: torch.Tensor) -> torch.Tensor:
        """Return logits of the coverage by cloth, (B, F, 18, 22), of crops (B, F, 72, 88).

        A value stands for 4 x 4 pixels.

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
        layers += [
            nn.Conv2d(before, after, 3, stride, dilation, dilation),
            nn.GroupNorm(8, after),
            nn.ReLU(),
        ]
    return nn.Sequential(*layers, nn.Conv2d(48, 1, 1))


@dataclass(frozen=True, eq=False, kw_only=True)
class FrictionModel:
    """A trained network, the meaning of its answers, and their calibration."""

    net: PosteriorNet
    materials: tuple[str, ...]
    instants: tuple[float, ...]
    bins: Bins
    temperature: tuple[float, float]
    """Of the histograms of material and of mu: see `calibration`."""
    familiarity: Familiarity
    card: dict[str, Any]
    """Training runs, settings, measured errors and limits."""

    def estimate(self, clips: Clips) -> Posterior:
        return Posterior.of(
            *log_histograms(self.net, clips), self.materials, self.bins, self.temperature
        )

    def judge(self, clips: Clips) -> tuple[Floats, list[str | None]]:
        """Return the familiarity of every clip, (clips,), and the reason of a refusal.

        The reason is None if the clip has an answer: see `familiarity`.
        """
        return self.familiarity.judge(silhouettes(self.net, clips))


def log_histograms(net: PosteriorNet, clips: Clips) -> tuple[SingleFloats, SingleFloats]:
    """Return log p(m), (clips, M), and log p(mu | m), (clips, M, K), of clips.

    The scene is symmetric, so the mirror image x' of a clip x is a second reading of it:

        p(m, mu) = (p(m, mu | x) + p(m, mu | x')) / 2
    """

    def joint(crops: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
        pairs = [
            net.read(net.features(*reading))
            for reading in ((crops, direction), mirrored(crops, direction))
        ]
        return torch.stack([material[:, :, None] + mu for material, mu in pairs]).logsumexp(
            dim=0
        ) - math.log(2)

    log_p = torch.from_numpy(_in_chunks(net, clips, joint))
    material = log_p.logsumexp(dim=2)
    return material.numpy(), (log_p - material[:, :, None]).numpy()


def mirrored(crops: torch.Tensor, direction: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return crops (B, F, H, W) and directions of view (B, 3) as a mirror along y shows them."""
    return crops.flip(3), direction * direction.new_tensor([1.0, -1.0, 1.0])


def silhouettes(net: PosteriorNet, clips: Clips) -> SingleFloats:
    """Return the silhouettes that a network sees in clips, (clips, F, 18, 22), 0 to 1."""
    return _in_chunks(net, clips, lambda crops, _: net.seen_silhouettes(crops))


def _in_chunks(
    net: PosteriorNet, clips: Clips, of: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
) -> SingleFloats:
    device = next(net.parameters()).device
    net.eval()
    with torch.inference_mode():
        chunks = [slice(first, first + CHUNK) for first in range(0, len(clips), CHUNK)]
        parts = [
            of(clips.crops[chunk].to(device), clips.direction[chunk].to(device)).cpu()
            for chunk in chunks
        ]
    return np.asarray(torch.cat(parts).numpy())


def mean_model(models: Sequence[FrictionModel]) -> FrictionModel:
    """Return the first model with the mean weights of all [Wortsman et al. 2022].

    They must know the same materials.
    """
    first = models[0]
    states = [model.net.state_dict() for model in models]
    if len({(each.materials, str(each.net.sizes)) for each in models}) > 1:
        raise ValueError(
            "the models to start from must know the same materials, and be of the same sizes"
        )
    net = PosteriorNet(**first.net.sizes)
    mean: dict[str, torch.Tensor] = {}
    for name in states[0]:
        mean[name] = torch.stack([state[name] for state in states]).mean(dim=0)
    net.load_state_dict(mean)
    return replace(first, net=net.eval())


def save_friction(path: Path, model: FrictionModel) -> None:
    """Write the model as safetensors, with its card; `load_friction` reads it."""
    tensors = {
        f"net.{name}": tensor.contiguous() for name, tensor in model.net.state_dict().items()
    }
    tensors |= {
        f"familiarity.{name}": torch.from_numpy(part)
        for name, part in vars(model.familiarity).items()
    }
    about = {
        "sizes": model.net.sizes,
        "materials": model.materials,
        "instants": model.instants,
        "bins": asdict(model.bins),
        "temperature": model.temperature,
        "card": model.card,
    }
    write_durably(path, safetensors.torch.save(tensors, {"friction": json.dumps(about)}))


def load_friction(path: str | Path = WEIGHTS) -> FrictionModel:
    """Return the model of a file; raise ValueError if it holds none."""
    try:
        with safetensors.safe_open(path, "pt") as file:
            about = json.loads((file.metadata() or {})["friction"])
            names = list(file.keys())
            tensors = {name: file.get_tensor(name) for name in names}
        net = PosteriorNet(**about["sizes"])
        net.load_state_dict({name: tensors[f"net.{name}"] for name in net.state_dict()})
        known = {
            field.name: tensors[f"familiarity.{field.name}"].numpy()
            for field in fields(Familiarity)
        }
        of_material, of_mu = about["temperature"]
        return FrictionModel(
            net=net.eval(),
            materials=tuple(about["materials"]),
            instants=tuple(about["instants"]),
            bins=Bins(**about["bins"]),
            temperature=(of_material, of_mu),
            familiarity=Familiarity(**known),
            card=about["card"],
        )
    except (
        safetensors.SafetensorError,
        KeyError,
        RuntimeError,
        TypeError,
        json.JSONDecodeError,
    ) as error:
        raise ValueError(
            f"{path} must be a model of `stickslip-train cloth train`: {error}"
        ) from error
