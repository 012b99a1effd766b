"""Named, frozen sets of solver settings for cloth."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True)
class Preset:
    """Numbers by which the cloth solver steps."""

    name: str
    time_step: float
    """[s]"""

    tolerance: float = 1e-3
    """Largest residual force of a node, in weights of a node."""

    newton_max: int = 40
    krylov_max: int = 40
    krylov_tolerance: float = 0.02
    refactor_after: int = 10
    """GMRES iterations that a stale factor may cost before it is made anew."""

    halvings_max: int = 4
    """Times that a step which does not converge is halved."""


PRESETS: Mapping[str, Preset] = MappingProxyType(
    {
        preset.name: preset
        for preset in (
            Preset("certified", 0.02),
            Preset("fast", 0.04, tolerance=1e-2),
        )
    }
)
