"""Named, frozen sets of solver settings for cloth."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any

import numpy as np

STEP_ERROR = 2e-4
"""Step error of `certified` [m]. Checks also judge presets with fixed steps by it."""


@dataclass(frozen=True)
class SolverSettings:
    """Settings of the cloth solver.

    Raises:
        ValueError: A number breaks its rule.
    """

    name: str
    time_step: float
    """Length of a step if `step_error` does not choose it [s], at most 1."""

    tolerance: float = 1e-4
    """Largest residual force of a node in a converged step, at most 1.

    Its unit is the weight of 25 mm^2 of the cloth.
    """

    newton_max: int = 40
    """Most iterations of Newton's method in a step that is not halved any more, 1 ... 1000."""

    krylov_tolerance: float = 0.005
    """Residual over right-hand side at which GMRES stops, at most 1."""

    refactor_after: int = 10
    """Extra GMRES iterations that a stale factor may cost, compared with a fresh one, 0 ... 10,000.

    Beyond them all of the matrix is factorised again.
    """

    newton_before_halving: int = 10
    """Iterations of Newton's method after which a step is halved rather than pursued, 1 ... 1000.
    """

    halvings_max: int = 6
    """Number of times that a step which does not converge is halved, 0 ... 20."""

    second_order: bool = False
    """Whether vertices that touch nothing move with second order in time.

    Otherwise steps damp a swing, as implicit Euler does.
    """

    step_error: float | None = STEP_ERROR
    """Distance of a vertex from its predicted position by which scenes choose steps [m].

    None: all steps have the length `time_step`.
    """

    longest_step: float = 0.125
    """Longest step that `step_error` may choose [s], at most 1."""

    finest: int = 64
    """Most parts, a power of two, into which `step_error` may cut the longest step.

    Steps that do not converge are halved further.
    """

    newton_per_second: int = 50_000
    """Most iterations of Newton's method in a second of scene time, 1 ... 1,000,000.

    Beyond it a run ends as not valid. The default is about four times 512 steps of 25 iterations.
    """

    unconverged_share_max: float = 0.002
    """Share of unconverged steps above which a simulation is not valid, 0 ... 1."""

    def numbers(self) -> dict[str, Any]:
        """Return all numbers of the preset, by name."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def __post_init__(self) -> None:
        if not self.name:
            raise ValueError("name: must not be empty")
        for name in ("time_step", "tolerance", "krylov_tolerance", "step_error", "longest_step"):
            value = getattr(self, name)
            if name == "step_error" and value is None:
                continue
            if not (np.isfinite(value) and 0.0 < value <= 1.0):
                raise ValueError(f"{name}: must be above 0 and at most 1, got {value}")
        for name, low, high in (
            ("newton_max", 1, 1000),
            ("refactor_after", 0, 10_000),
            ("newton_before_halving", 1, 1000),
            ("halvings_max", 0, 20),
            ("newton_per_second", 1, 1_000_000),
        ):
            value = getattr(self, name)
            # True and False are integers in Python.
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise ValueError(f"{name}: must be an integer, {low} ... {high}, got {value}")
        if isinstance(self.finest, bool) or self.finest not in [2**power for power in range(13)]:
            raise ValueError(f"finest: must be a power of two, 1 ... 4096, got {self.finest}")
        if not 0.0 <= self.unconverged_share_max <= 1.0:
            raise ValueError(
                f"unconverged_share_max: must be 0 ... 1, got {self.unconverged_share_max}"
            )


# These presets end their iterations on purpose, so they may neither halve steps nor fail for it.
_CUT_OFF: dict[str, Any] = {"halvings_max": 0, "step_error": None, "unconverged_share_max": 1.0}

PRESETS: Mapping[str, SolverSettings] = MappingProxyType(
    {
        settings.name: settings
        for settings in (
            SolverSettings("certified", 0.02, second_order=True),
            SolverSettings(
                "fast", 0.04, tolerance=2e-4, step_error=4e-4, finest=16, second_order=True
            ),
            # For comparisons of frames.
            SolverSettings(
                "fine",
                0.01,
                tolerance=5e-5,
                step_error=2e-5,
                longest_step=0.0625,
                second_order=True,
            ),
            # Steps have the lengths of the thesis's Table 4.2. Two of the presets imitate its
            # inaccurate solver: iterations that end early leave a residual.
            SolverSettings("thesis-high", 0.0005, step_error=None),
            SolverSettings("thesis-low-small-dt", 0.0005, newton_max=2, **_CUT_OFF),
            SolverSettings("thesis-low-big-dt", 0.001, newton_max=1, **_CUT_OFF),
        )
    }
)


def preset_named(preset: str | SolverSettings) -> SolverSettings:
    """Return the settings of this name, or the given settings as they are.

    Raises:
        ValueError: The name is unknown.
    """
    if isinstance(preset, SolverSettings):
        return preset
    if preset not in PRESETS:
        raise ValueError(f"preset: must be one of {', '.join(PRESETS)}, got {preset!r}")
    return PRESETS[preset]
