"""Lamps of the drop-and-drag stage, drawn from a seed.

One lamp follows the cloth along the stage [thesis, 4.2.3], so that the cloth is lit alike wherever it is.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from stickslip_schemas.spec.appearance import LampNumbers

# azimuth, elevation [degree], power: what `drawn` trains on, and what no training light has.
_RANGES: dict[str, tuple[tuple[float, float], ...]] = {
    "drawn": ((-75.0, 15.0), (42.0, 62.0), (0.8, 1.25)),
    "held-out": ((25.0, 80.0), (25.0, 40.0), (0.6, 0.8)),
}
LIGHTS = tuple(_RANGES)
"""Named ranges that lights are drawn from."""


@dataclass(frozen=True)
class Light:
    """The lamp of one clip."""

    azimuth: float
    """Seen from the cloth, from +x towards +y [degree]."""
    elevation: float
    """Above the floor [degree]."""
    power: float
    """Over the nominal power."""

    @property
    def numbers(self) -> list[float]:
        """What a dataset's label holds: azimuth, elevation, power."""
        return list(astuple(self))


def drawn_light(name: str, seed: int, custom: LampNumbers | None = None) -> Light:
    """Draw a lamp from a named range, or from a custom one."""
    if custom is not None:
        ranges: tuple[tuple[float, float], ...] = (custom.azimuth, custom.elevation, custom.power)
    elif name in _RANGES:
        ranges = _RANGES[name]
    else:
        raise ValueError(f"light must be one of {', '.join(LIGHTS)}; got {name!r}")
    uniform = np.random.Generator(np.random.PCG64(seed)).uniform
    return Light(*(float(uniform(low, high)) for low, high in ranges))
