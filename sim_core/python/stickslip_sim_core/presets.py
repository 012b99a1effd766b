"""Named, frozen sets of solver settings for cloth."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True)
class Preset:
    """Numbers by which the cloth solver steps."""

    name: str
    time_step: float
    """Longest step [s]; scenes shorten it so that frames fall on steps."""

    tolerance: float = 1e-4
    """Largest residual force of a node in a converged step, in weights of a node."""

    newton_max: int = 40
    """Iterations of Newton's method in a step that is not halved any more."""

    krylov_max: int = 40
    """Iterations of GMRES in one of those."""

    krylov_tolerance: float = 0.03
    """Residual over right-hand side at which GMRES stops."""

    refactor_after: int = 15
    """GMRES iterations that a stale factor may cost beyond those with a fresh one before it is made anew."""

    halvings_max: int = 6
    """Times that a step which does not converge is halved."""

    unconverged_share_max: float = 0.002
    """Share of unconverged steps above which a simulation is not valid."""


PRESETS: Mapping[str, Preset] = MappingProxyType(
    {
        preset.name: preset
        for preset in (
            Preset("certified", 0.02),
            Preset("fast", 0.04, tolerance=2e-4),
            # Table 4.2 of the thesis: steps of its lengths; a solver that is cut off early leaves its residual.
            Preset("thesis-high", 0.0005),
            Preset("thesis-low-small-dt", 0.0005, newton_max=2, halvings_max=0, unconverged_share_max=1.0),
            Preset("thesis-low-big-dt", 0.001, newton_max=1, halvings_max=0, unconverged_share_max=1.0),
        )
    }
)


def preset_named(preset: str | Preset) -> Preset:
    """Return the preset of this name; one that is a preset already is returned as it is.

    Raises:
        ValueError: There is none of this name.
    """
    if isinstance(preset, Preset):
        return preset
    if preset not in PRESETS:
        raise ValueError(f"preset: must be one of {', '.join(PRESETS)}, got {preset!r}")
    return PRESETS[preset]
