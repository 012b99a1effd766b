"""Physical protocols: measurements of a build of the core, against master curves. See docs/protocols.md."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from stickslip_sim_core.protocols.cantilever import Cantilever
from stickslip_sim_core.protocols.capstan import Capstan
from stickslip_sim_core.protocols.certification import CERTIFICATION, SCENE_PROTOCOLS, Certification
from stickslip_sim_core.protocols.heavy_fold import HeavyFold
from stickslip_sim_core.protocols.inclined_plane import InclinedPlane
from stickslip_sim_core.protocols.lateral_buckling import LateralBuckling
from stickslip_sim_core.protocols.protocol import Protocol
from stickslip_sim_core.protocols.pull_out import PullOut
from stickslip_sim_core.protocols.result import Curve, ProtocolResult
from stickslip_sim_core.protocols.rods import BendTwist, RodCantilever, RodLateralBuckling, RodProtocol
from stickslip_sim_core.protocols.stacked_incline import StackedIncline
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
            LateralBuckling,
            InclinedPlane,
            StackedIncline,
            PullOut,
            HeavyFold,
            Capstan,
        )
    }
)

ROD_PROTOCOLS = frozenset(name for name, protocol in PROTOCOLS.items() if issubclass(protocol, RodProtocol))
"""Protocols of the rod solver, which has no presets."""


def run(name: str, preset: str | None = None, **settings: Any) -> ProtocolResult:
    """Run the protocol `name`, one of PROTOCOLS, with its own settings.

    Args:
        name: The protocol.
        preset: The cloth solver's preset; None: "certified". Protocols of rods ignore it.
        settings: The fields of the protocol.

    Raises:
        ValueError: `name` is unknown, or a setting breaks its rule.
        TypeError: A setting is unknown.
    """
    if name not in PROTOCOLS:
        raise ValueError(f"protocol: must be one of {', '.join(PROTOCOLS)}, got {name!r}")
    if preset is not None and name not in ROD_PROTOCOLS:
        settings["preset"] = preset
    return PROTOCOLS[name](**settings).run()


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
