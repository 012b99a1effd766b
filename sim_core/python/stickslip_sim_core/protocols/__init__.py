"""Physical protocols: what a build of the core measures, against the master curves. See docs/protocols.md."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from stickslip_sim_core.protocols import bend_twist, rod_cantilever, rod_lateral_buckling
from stickslip_sim_core.protocols.result import Curve, ProtocolResult

PROTOCOLS: Mapping[str, Callable[..., ProtocolResult]] = MappingProxyType(
    {
        "bend-twist": bend_twist.run,
        "rod-cantilever": rod_cantilever.run,
        "rod-lateral-buckling": rod_lateral_buckling.run,
    }
)


def run(name: str, **settings: Any) -> ProtocolResult:
    """Run the protocol `name`, one of PROTOCOLS, with its own settings.

    Raises:
        ValueError: There is no such protocol, or a setting breaks its rule.
        TypeError: The protocol has no such setting.
    """
    if name not in PROTOCOLS:
        raise ValueError(f"protocol: must be one of {', '.join(PROTOCOLS)}, got {name!r}")
    return PROTOCOLS[name](**settings)


__all__ = ["PROTOCOLS", "Curve", "ProtocolResult", "run"]
