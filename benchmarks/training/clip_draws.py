"""Draws of the clips of a test set: run, viewpoint, textures, and seeds of light and creases.

They follow from a seed and the runs alone, so the labels of a set are known before anything is
simulated or rendered.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from stickslip_schemas.kinds.cloth_drag import VIEWPOINTS, ClothDragRender
from stickslip_schemas.spec.jobs import Quality
from stickslip_schemas.spec.names import Texture

About = dict[str, Any]
"""Facts about a run, as `cloth_runs.py` writes them."""

HELD_OUT_TEXTURES = 4
"""Textures at the end of the list that no network is trained on."""


@dataclass(frozen=True, kw_only=True)
class ClipDraws:
    """Settings of the clips of one floor."""

    seed: int
    clips: int
    """Shadings; the clips are so many times the textures."""
    textures: int = 2
    only: list[int] | None = None
    """Numbers of the runs; None for all."""
    instants: list[int] = field(default_factory=lambda: [60, 80, 130, 150, 210, 220])
    quality: str = "draft"
    held_out_textures: bool = False
    held_out_viewpoints: bool = False
    lighting: str = "drawn"
    substrate: str = "matt"
    finish: dict[str, Any] | None = None
    """Of a floor of one's own."""


@dataclass(frozen=True)
class Look:
    """One shading to render, with several textures."""

    run: int
    textures: list[Texture]
    document: ClothDragRender


def looks(draws: ClipDraws, about: Sequence[About]) -> Iterator[Look]:
    """Yield the look of each shading: runs and viewpoints in turn, all else at random."""
    runs = draws.only or list(range(len(about)))
    every = list(Texture)
    held_out = draws.held_out_textures
    textures = every[-HELD_OUT_TEXTURES:] if held_out else every[:-HELD_OUT_TEXTURES]
    viewpoints = VIEWPOINTS[3:] if draws.held_out_viewpoints else VIEWPOINTS[:3]
    random = np.random.default_rng(draws.seed)
    for clip in range(draws.clips):
        run = runs[clip % len(runs)]
        # The order of these draws is part of what a seed means.
        order = random.permutation(len(textures))[: draws.textures]
        chosen = [textures[index] for index in order]
        document = {
            "material": about[run]["material"],
            "texture": chosen[0],
            "viewpoint": viewpoints[clip % len(viewpoints)],
            "lighting": draws.lighting,
            "substrate": draws.substrate,
            "finish": draws.finish,
            "quality": Quality(draws.quality),
            "rig": "drag",
            "rig_digest": "0" * 64,
            "instants": tuple(draws.instants),
            "light_seed": int(random.integers(2**31)),
            "crease_seed": int(random.integers(2**31)),
        }
        yield Look(run, chosen, ClothDragRender.model_validate(document))


def label(look: Look, texture: Texture, draws: ClipDraws, about: Sequence[About]) -> About:
    """Return the true values of one clip, as its file has them."""
    return {
        "run": look.run,
        "viewpoint": look.document.viewpoint,
        "texture": texture.value,
        "substrate": draws.substrate,
        "finish": draws.finish,
        **about[look.run],
    }
