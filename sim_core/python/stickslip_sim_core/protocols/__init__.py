"""Physical protocols: measurements of a build of the core against master curves.

docs/protocols.md describes them.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from stickslip_sim_core.cloth.presets import PRESETS, SolverSettings
from stickslip_sim_core.protocols.cantilever import Cantilever
from stickslip_sim_core.protocols.capstan import Capstan
from stickslip_sim_core.protocols.edge import Edge
from stickslip_sim_core.protocols.gripper import Gripper
from stickslip_sim_core.protocols.heavy_fold import HeavyFold
from stickslip_sim_core.protocols.inclined_plane import InclinedPlane, StackedIncline
from stickslip_sim_core.protocols.lateral_buckling import LateralBuckling
from stickslip_sim_core.protocols.motion import Fall, Impact, SlideToRest
from stickslip_sim_core.protocols.oscillation import ShakenFloor, Swing
from stickslip_sim_core.protocols.protocol import Protocol
from stickslip_sim_core.protocols.pull_out import PullOut
from stickslip_sim_core.protocols.result import Curve, ProtocolResult
from stickslip_sim_core.protocols.rods import (
    BendTwist,
    RodCantilever,
    RodLateralBuckling,
    RodProtocol,
)
from stickslip_sim_core.protocols.soft_cantilever import SoftCantilever
from stickslip_sim_core.protocols.static_friction import KineticSlide, StaticOnset
from stickslip_sim_core.protocols.stick_slip import StickSlip

PROTOCOLS: Mapping[str, type[Protocol]] = MappingProxyType(
    {
        protocol.name: protocol
        for protocol in (
            BendTwist,
            RodCantilever,
            RodLateralBuckling,
            StickSlip,
            Cantilever,
            SoftCantilever,
            LateralBuckling,
            InclinedPlane,
            StackedIncline,
            PullOut,
            HeavyFold,
            Capstan,
            Edge,
            Gripper,
            Fall,
            SlideToRest,
            StaticOnset,
            KineticSlide,
            Impact,
            Swing,
            ShakenFloor,
        )
    }
)

ROD_PROTOCOLS = frozenset(
    name for name, protocol in PROTOCOLS.items() if issubclass(protocol, RodProtocol)
)
"""Names of the protocols of the rod solver, which has no presets."""


def run(name: str, preset: str | None = None, **settings: Any) -> ProtocolResult:
    """Run the protocol `name`, one of PROTOCOLS, with its own settings.

    Args:
        name: The protocol.
        preset: Preset of the cloth solver. None is "certified". Protocols of rods ignore it.
        settings: Fields of the protocol.

    Raises:
        ValueError: `name` is unknown, or a setting breaks its rule.
        TypeError: A setting is unknown.
    """
    if name not in PROTOCOLS:
        raise ValueError(f"protocol: must be one of {', '.join(PROTOCOLS)}, got {name!r}")
    if preset is not None and name not in ROD_PROTOCOLS:
        settings["preset"] = preset
    return PROTOCOLS[name](**settings).run()


QUICK: Mapping[str, Mapping[str, Any]] = {
    "bend-twist": {"phi": (6.0, 10.0), "poisson": (0.5,), "elements": 256},
    "rod-cantilever": {"gamma": (1.0, 100.0), "elements": 512},
    "inclined-plane": {"friction": (0.3,)},
    "lateral-buckling": {"aspect": (0.2,), "poisson": (0.3,)},
    "stick-slip": {"friction": (0.1, 0.3), "phases": False},
    "cantilever": {"gamma": (1.0, 100.0), "unstructured": 1},
    "soft-cantilever": {"gamma": (10.0,), "softening": (16.0,), "unstructured": 0},
    "capstan": {"friction": (0.3,), "bending": (0.05,)},
    "heavy-fold": {"friction": (0.3,), "cells": 80},
    "stacked-incline": {"friction": (0.3,), "sheets": (2,), "unstructured": 0},
    "fall": {"durations": (0.3,)},
    "slide-to-rest": {"friction": (0.3,)},
    "static-onset": {"friction": (0.5,)},
    "kinetic-slide": {"friction": (0.35,)},
    "impact": {"heights": (0.005,)},
    "gripper": {"friction": (0.3,)},
    "edge": {"radii": (2.0,), "friction": (0.3,), "edges": (0,)},
    "swing": {"durations": (1.0,)},
    "shaken-floor": {"frequencies": (33.0,)},
    "pull-out": {"friction": (0.3,), "loads": (1.0,), "unstructured": 0},
}


@dataclass(frozen=True)
class Certification:
    """Protocols and settings of the certificate of a preset."""

    protocols: tuple[str, ...]
    """Names in PROTOCOLS, in the order of running. Quick protocols come first."""

    solver: str
    """Module whose build the certificate vouches for."""

    numbers: Callable[[], Mapping[str, Any]] = dict
    """Function that returns the settings of the preset.

    The values have JSON's types. Constants of the solver belong to its build.
    """

    quick: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: QUICK)
    """Settings by protocol for a first look. A certificate made with them certifies nothing."""


_CLOTH = (
    "fall",
    "slide-to-rest",
    "static-onset",
    "kinetic-slide",
    "impact",
    "gripper",
    "inclined-plane",
    "lateral-buckling",
    "stick-slip",
    "cantilever",
    "soft-cantilever",
)
SCENE_PROTOCOLS = (
    *_CLOTH,
    "swing",
    "shaken-floor",
    "capstan",
    "edge",
    "heavy-fold",
    "stacked-incline",
    "pull-out",
)
"""Protocols that a certificate needs for a scene with contact of cloth with cloth or meshes."""


def _of_cloth(preset: SolverSettings) -> Certification:
    # The thesis's steps of 0.5 ms would take hours on the protocols of contact.
    touches = not preset.name.startswith("thesis-")
    names = SCENE_PROTOCOLS if touches else _CLOTH
    return Certification(names, "stickslip_sim_core.cloth", preset.numbers)


CERTIFICATION: Mapping[str, Certification] = MappingProxyType(
    {
        "rods": Certification(
            ("rod-lateral-buckling", "rod-cantilever", "bend-twist"), "stickslip_sim_core.rods"
        ),
        **{name: _of_cloth(preset) for name, preset in PRESETS.items()},
    }
)
"""Certifications by preset. "rods" stands for the rod solver, which has no presets."""

__all__ = [
    "CERTIFICATION",
    "PROTOCOLS",
    "ROD_PROTOCOLS",
    "SCENE_PROTOCOLS",
    "Certification",
    "Curve",
    "Protocol",
    "ProtocolResult",
    "run",
]
