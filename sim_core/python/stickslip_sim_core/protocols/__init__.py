"""Physical protocols: what a build of the core measures, against the master curves. See docs/protocols.md."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from stickslip_sim_core.protocols import (
    bend_twist,
    cantilever,
    capstan,
    heavy_fold,
    inclined_plane,
    lateral_buckling,
    pull_out,
    rod_cantilever,
    rod_lateral_buckling,
    stacked_incline,
    stick_slip,
)
from stickslip_sim_core.protocols.certification import CERTIFICATION, SCENE_PROTOCOLS, Certification
from stickslip_sim_core.protocols.result import Curve, ProtocolResult

PROTOCOLS: Mapping[str, Callable[..., ProtocolResult]] = MappingProxyType(
    {
        "bend-twist": bend_twist.run,
        "rod-cantilever": rod_cantilever.run,
        "rod-lateral-buckling": rod_lateral_buckling.run,
        "stick-slip": stick_slip.run,
        "cantilever": cantilever.run,
        "lateral-buckling": lateral_buckling.run,
        "inclined-plane": inclined_plane.run,
        "stacked-incline": stacked_incline.run,
        "pull-out": pull_out.run,
        "heavy-fold": heavy_fold.run,
        "capstan": capstan.run,
    }
)

ROD_PROTOCOLS = frozenset({"bend-twist", "rod-cantilever", "rod-lateral-buckling"})
"""Those that know no presets."""


def run(name: str, preset: str | None = None, **settings: Any) -> ProtocolResult:
    """Run the protocol `name`, one of PROTOCOLS, with its own settings.

    Args:
        name: The protocol.
        preset: The solver's preset; None is the protocol's own choice. Protocols of rods take no notice of it.
        settings: See the protocol's `run`.

    Raises:
        ValueError: There is no such protocol, or a setting breaks its rule.
        TypeError: The protocol has no such setting.
    """
    if name not in PROTOCOLS:
        raise ValueError(f"protocol: must be one of {', '.join(PROTOCOLS)}, got {name!r}")
    if preset is not None and name not in ROD_PROTOCOLS:
        settings["preset"] = preset
    return PROTOCOLS[name](**settings)


__all__ = [
    "CERTIFICATION",
    "PROTOCOLS",
    "ROD_PROTOCOLS",
    "SCENE_PROTOCOLS",
    "Certification",
    "Curve",
    "ProtocolResult",
    "run",
]
