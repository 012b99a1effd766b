"""A trained network with its calibration, and its file."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch
from stickslip_schemas.store import write_durably

from stickslip_training.arrays import Floats, SingleFloats
from stickslip_training.cloth.clips import CHUNK, Clips
from stickslip_training.cloth.familiarity import Familiarity
from stickslip_training.cloth.nets import PosteriorNet
from stickslip_training.cloth.posterior import Bins, Posterior

WEIGHTS = Path(__file__).with_name("friction.safetensors")
"""A trained model that comes with the package; its card names its training data and its errors."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FrictionModel:
    """A trained network, what its answers mean and how they are calibrated."""

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
        seen = features(self.net, clips)
        return Posterior.of(*log_histograms(self.net, seen), self.materials, self.bins, self.temperature)

    def judge(self, clips: Clips) -> tuple[Floats, list[str | None]]:
        """Return the familiarity of every clip, (clips,), and why it has no answer, or None: see `familiarity`."""
        return self.familiarity.judge(silhouettes(self.net, clips))


def features(net: PosteriorNet, clips: Clips) -> SingleFloats:
    """Return the last features of clips, (clips, n)."""
    return _in_chunks(net, clips, net.features)


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
        parts = [of(clips.crops[some].to(device), clips.direction[some].to(device)).cpu() for some in chunks]
    return np.asarray(torch.cat(parts).numpy())


def log_histograms(net: PosteriorNet, seen: SingleFloats) -> tuple[SingleFloats, SingleFloats]:
    """Return log p(m), (clips, M), and log p(mu | m), (clips, M, K), of features (clips, n)."""
    with torch.inference_mode():
        material, mu = net.read(torch.from_numpy(seen).to(next(net.parameters()).device))
    return material.cpu().numpy(), mu.cpu().numpy()


def save_friction(path: Path, model: FrictionModel) -> None:
    """Write the model as safetensors, with its card; `load_friction` reads it."""
    tensors = {f"net.{name}": tensor.contiguous() for name, tensor in model.net.state_dict().items()}
    tensors |= {f"familiarity.{name}": torch.from_numpy(part) for name, part in vars(model.familiarity).items()}
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
    """Return the model of a file; raise ValueError where it holds none."""
    try:
        with safetensors.safe_open(path, "pt") as file:
            about = json.loads((file.metadata() or {})["friction"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        net = PosteriorNet(**about["sizes"])
        net.load_state_dict({name: tensors[f"net.{name}"] for name in net.state_dict()})
        known = {field.name: tensors[f"familiarity.{field.name}"].numpy() for field in fields(Familiarity)}
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
    except (safetensors.SafetensorError, KeyError, RuntimeError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} must be a model of `stickslip-train cloth train`: {error}") from error
