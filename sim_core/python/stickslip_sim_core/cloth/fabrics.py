"""Fabrics: density, stiffness against stretching and against bending."""

import tomllib
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stickslip_sim_core.arrays import Floats, check_positive, check_range

DENSITY_BOUNDS = (1e-3, 100.0)
"""Of the mass per area [kg/m^2]."""

STRETCHING_MAX = 1e7
"""Of each number of the table [N/m]."""

RIGIDITY_BOUNDS = (1e-12, 10.0)
"""Of the stiffness against bending in each direction [N m]."""

DAMPING_MAX = 1e3
"""[1/s]"""


@dataclass(frozen=True, eq=False)
class Fabric:
    """Constitutive numbers of a cloth; the first axis of its rest plane is the warp.

    Raises:
        ValueError: A number breaks its rule.
    """

    name: str
    density: float
    """Mass per area [kg/m^2]."""

    stretching: Floats
    """(6, 4) [N/m]: k0 ... k3 of the energy per area k0 G00^2/2 + k1 G00 G11 + k2 G11^2/2 + k3
    G01^2, G being Green's strain. Row 0 holds at no strain, rows 1 ... 5 where the larger principal
    stretch is 1 + 1/6, at 0, 22.5, ..., 90 degrees from the warp; bilinear in between."""

    rigidity: Floats
    """(3, 3) [N m]: D of the energy per area H:D:H/2, H = (H11, H22, 2 H12) being the second
    derivatives.
    """

    damping: float = 0.0
    """Proportional to mass [1/s]: a free motion slows down by exp(-damping t)."""

    def __post_init__(self) -> None:
        check_range("density", self.density, *DENSITY_BOUNDS)
        check_range("damping", self.damping, 0.0, DAMPING_MAX)
        k, d = np.asarray(self.stretching, float), np.asarray(self.rigidity, float)
        if k.shape != (6, 4) or not ((k >= 0.0) & (k <= STRETCHING_MAX)).all():
            raise ValueError(
                f"stretching: must be (6, 4) numbers of 0 ... {STRETCHING_MAX:g} N/m, "
                f"got {k.tolist()}"
            )
        if not (k[:, 1] ** 2 < k[:, 0] * k[:, 2]).all():
            row = int(np.argmin(k[:, 0] * k[:, 2] - k[:, 1] ** 2))
            raise ValueError(
                f"stretching: must have k1^2 < k0 k2 in every row, "
                f"and row {row} is {k[row].tolist()}"
            )
        if (
            d.shape != (3, 3)
            or not np.isfinite(d).all()
            or np.abs(d - d.T).max() > 1e-12 * np.abs(d).max()
        ):
            raise ValueError(
                f"rigidity: must be a symmetric (3, 3) matrix of finite numbers, got {d.tolist()}"
            )
        for value in np.linalg.eigvalsh(d):
            check_range("rigidity, an eigenvalue", float(value), *RIGIDITY_BOUNDS)
        object.__setattr__(self, "stretching", k)
        object.__setattr__(self, "rigidity", d)

    def scaled(
        self, *, density: float = 1.0, stretching: float = 1.0, bending: float = 1.0
    ) -> "Fabric":
        """Return a fabric whose numbers are those of this one times factors.

        Raises:
            ValueError: A factor is not positive, or a product breaks its rule.
        """
        factors = {"density": density, "stretching": stretching, "bending": bending}
        for name, factor in factors.items():
            if not (np.isfinite(factor) and factor > 0.0):
                raise ValueError(f"{name}: must be a finite factor > 0, got {factor}")
        changed = "".join(
            f", {name} x {factor:g}" for name, factor in factors.items() if factor != 1.0
        )
        return Fabric(
            self.name + changed,
            self.density * density,
            self.stretching * stretching,
            self.rigidity * bending,
            self.damping,
        )


def custom_fabric(
    name: str,
    density: float,
    *,
    stretching: ArrayLike | None = None,
    young: float | None = None,
    poisson: float | None = None,
    thickness: float | None = None,
    bending: ArrayLike | None = None,
    damping: float = 0.0,
) -> Fabric:
    """Return a fabric from measured numbers.

    Give a stretching table with bending, or Young's modulus with the thickness.

    Args: name: For messages. density: Mass per area [kg/m^2]. stretching: (6, 4) [N/m], as
        `Fabric.stretching`; or `young`. young: Young's modulus [Pa], of an isotropic fabric with
        `poisson` and `thickness`. poisson: Poisson's ratio, in [0, 0.5]; None is 0. thickness: [m]
        bending: D [N m]: (3,) of warp, weft and twist (D11, D22, D66), or (3, 3). Without it, the
        plate's of `young`, E h^3 / (12 (1 - poisson^2)). damping: Proportional to mass [1/s].

    Raises:
        ValueError: A number breaks its rule, or there are too many or too few.
    """
    if (stretching is None) == (young is None):
        raise ValueError(
            "stretching, young: must be one of both, got "
            + ("both" if young is not None else "neither")
        )
    if young is not None:
        if thickness is None:
            raise ValueError("thickness: must be given with young")
        poisson = 0.0 if poisson is None else poisson
        check_range("young", young, 1.0, 1e13)
        check_range("thickness", thickness, 1e-6, 0.1)
        check_range("poisson", poisson, 0.0, 0.5)
        plate = isotropic(
            density,
            young * thickness,
            young * thickness**3 / (12.0 * (1.0 - poisson**2)),
            poisson,
            name=name,
        )
        table, rigidity = plate.stretching, plate.rigidity
    else:
        table = np.asarray(stretching, float)
        if bending is None:
            raise ValueError("bending: must be given with stretching")
    if bending is not None:
        numbers = np.asarray(bending, float)
        rigidity = np.diag(numbers) if numbers.shape == (3,) else numbers
    return Fabric(name, float(density), table, rigidity, float(damping))


def isotropic(
    density: float,
    stretching: float,
    rigidity: float,
    poisson: float = 0.0,
    name: str = "isotropic",
) -> Fabric:
    """Return an isotropic fabric.

    Args:
        density: Mass per area [kg/m^2].
        stretching: Y, Young's modulus times thickness [N/m].
        rigidity: D of plates, E h^3 / (12 (1 - poisson^2)) [N m].
        poisson: Poisson's ratio, in [0, 0.5].
        name: For messages.

    Raises:
        ValueError: A number breaks its rule.
    """
    check_positive(density=density, stretching=stretching, rigidity=rigidity)
    check_range("poisson", poisson, 0.0, 0.5)
    tension = stretching / (1.0 - poisson**2)
    row = [tension, poisson * tension, tension, stretching / (1.0 + poisson)]
    plate = rigidity * np.array(
        [[1.0, poisson, 0.0], [poisson, 1.0, 0.0], [0.0, 0.0, 0.5 * (1.0 - poisson)]]
    )
    return Fabric(name, float(density), np.tile(row, (6, 1)), plate)


@lru_cache
def fabric(name: str) -> Fabric:
    """Return one of the fabrics of [Wang et al. 2011].

    Its stretching numbers are doubled, as the authors' simulator does, negative ones are raised to
    0, and the coupling is kept positive definite. Its bending numbers k are coefficients of hinges:
    a plate as stiff has D = k/4 on equilateral triangles. D against curvature along warp, weft and
    in between comes from hinges across it; with no coupling D12, D66 = D(45 degrees) - (D11 +
    D22)/4. D is the mean over the tabulated curvatures.

    Raises:
        ValueError: There is no such fabric.
    """
    table = _table()
    if name not in table:
        raise ValueError(f"fabric: must be one of {', '.join(table)}, got {name!r}")
    facts = table[name]
    k = 2.0 * np.maximum(np.array(facts["stretching"]), 0.0)
    k[:, 1] = np.minimum(k[:, 1], 0.95 * np.sqrt(k[:, 0] * k[:, 2]))
    across_weft, between, across_warp = np.mean(facts["bending"], axis=1) / 4.0
    twist = max(between - 0.25 * (across_weft + across_warp), 0.1 * min(across_weft, across_warp))
    return Fabric(name, float(facts["density"]), k, np.diag([across_warp, across_weft, twist]))


def fabric_names() -> tuple[str, ...]:
    """Return the names that `fabric` knows."""
    return tuple(_table())


@lru_cache
def _table() -> dict[str, dict[str, Any]]:
    text = files("stickslip_sim_core").joinpath("cloth", "fabrics.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)
