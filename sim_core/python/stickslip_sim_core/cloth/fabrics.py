"""Fabrics: density, stretching stiffness and bending stiffness."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stickslip_sim_core.arrays import Floats, check_positive, check_range

DENSITY_BOUNDS = (1e-3, 100.0)
"""Bounds of the mass per area [kg/m^2]."""

STRETCHING_MAX = 1e7
"""Largest number in the stretching table [N/m]."""

RIGIDITY_BOUNDS = (1e-12, 10.0)
"""Bounds of the eigenvalues of the bending stiffness [N m]."""

SOFTENING_BOUNDS = (20.0, 1e6)
"""Bounds of the curvature of softening [1/m]. 618 fabrics have 160 to 1,090 [Feng et al. 2022]."""

DAMPING_MAX = 1e3
"""Largest damping [1/s]."""


@dataclass(frozen=True, eq=False)
class Fabric:
    """Constitutive numbers of a cloth. The first axis of its rest plane is the warp.

    Raises:
        ValueError: A number breaks its rule.
    """

    name: str
    density: float
    """Mass per area [kg/m^2]."""

    stretching: Floats
    """Table of the coefficients k0 ... k3 of the stretching energy: (6, 4) [N/m].

    The energy per area is k0 G00^2/2 + k1 G00 G11 + k2 G11^2/2 + k3 G01^2, with Green's strain G.
    Row 0 holds at no strain. Rows 1 ... 5 hold at a larger principal stretch of 1 + 1/6, whose
    direction is 0, 22.5, ..., 90 degrees from the warp. Coefficients are bilinear in between.
    """

    rigidity: Floats
    """Bending stiffness D of the energy per area H:D:H/2: (3, 3) [N m].

    H = (H11, H22, 2 H12) has the second derivatives.
    """

    damping: float = 0.0
    """Damping proportional to mass [1/s]: a free motion slows down by exp(-damping t)."""

    softening: float | None = None
    """Curvature k_s = D/|b| [1/m] with which bending softens; None: the stiffness is constant.

    The moment is M = (D - |b| k) k up to k_s/2, and D k/2 beyond, where it would begin to fall. In
    a plate k is the curvature of the energy, k^2 = H:D:H / sqrt(D11 D22): the law is that of the
    curvature k along the warp and the weft if both are equally stiff, and the stiffer of the two
    softens at a smaller curvature.
    """

    def __post_init__(self) -> None:
        check_range("density", self.density, *DENSITY_BOUNDS)
        check_range("damping", self.damping, 0.0, DAMPING_MAX)
        if self.softening is not None:
            check_range("softening", self.softening, *SOFTENING_BOUNDS)
        k = np.asarray(self.stretching, float)
        d = np.asarray(self.rigidity, float)
        if k.shape != (6, 4) or not ((k >= 0.0) & (k <= STRETCHING_MAX)).all():
            raise ValueError(
                f"stretching: must be (6, 4) numbers of 0 ... {STRETCHING_MAX:g} N/m, "
                f"got {k.tolist()}"
            )
        # Otherwise some strain would have no energy, or a negative one.
        if not (k[:, 1] ** 2 < k[:, 0] * k[:, 2]).all():
            row = int(np.argmin(k[:, 0] * k[:, 2] - k[:, 1] ** 2))
            raise ValueError(
                f"stretching: must have k1^2 < k0 k2 in every row, "
                f"and row {row} is {k[row].tolist()}"
            )
        # Products of measured numbers may be symmetric up to rounding only.
        if (
            d.shape != (3, 3)
            or not np.isfinite(d).all()
            or np.abs(d - d.T).max() > 1e-12 * np.abs(d).max()
        ):
            raise ValueError(
                f"rigidity: must be a symmetric (3, 3) matrix of finite numbers, got {d.tolist()}"
            )
        # The eigenvalues bound the stiffness in every direction, also between warp and weft.
        for value in np.linalg.eigvalsh(d):
            check_range("rigidity, an eigenvalue", float(value), *RIGIDITY_BOUNDS)
        # A frozen dataclass allows no plain assignment.
        object.__setattr__(self, "stretching", k)
        object.__setattr__(self, "rigidity", d)

    def scaled(
        self,
        *,
        density: float = 1.0,
        stretching: float = 1.0,
        bending: float = 1.0,
        bending_ratio: float = 1.0,
        bending_twist: float = 1.0,
        softening: float = 1.0,
    ) -> "Fabric":
        """Return a fabric whose numbers are the numbers of this one times factors.

        Args:
            density: Factor of the mass per area.
            stretching: Factor of the stretching stiffness.
            bending: Factor of all of the bending stiffness.
            bending_ratio: Factor of the rigidity along the warp over that along the weft. Their
                product stays.
            bending_twist: Factor of the rigidity of twist.
            softening: Factor of the curvature of softening. It changes nothing without softening.

        Raises:
            ValueError: A factor is not positive, or a product breaks its rule.
        """
        factors = {
            "density": density,
            "stretching": stretching,
            "bending": bending,
            "bending_ratio": bending_ratio,
            "bending_twist": bending_twist,
            "softening": softening,
        }
        for name, factor in factors.items():
            if not (np.isfinite(factor) and factor > 0.0):
                raise ValueError(f"{name}: must be a finite factor > 0, got {factor}")
        # The name states the factors, so that messages about the new fabric are clear.
        changed = "".join(
            f", {name} x {factor:g}" for name, factor in factors.items() if factor != 1.0
        )
        # S D S stays positive definite, and with it warp, weft and twist have their factors.
        roots = np.array([bending_ratio**0.25, bending_ratio**-0.25, bending_twist**0.5])
        return Fabric(
            self.name + changed,
            self.density * density,
            self.stretching * stretching,
            self.rigidity * bending * np.outer(roots, roots),
            self.damping,
            None if self.softening is None else self.softening * softening,
        )


def custom_fabric(
    name: str,
    density: float,
    *,
    stretching: ArrayLike | str | None = None,
    young: float | None = None,
    poisson: float | None = None,
    thickness: float | None = None,
    bending: ArrayLike | None = None,
    damping: float = 0.0,
) -> Fabric:
    """Return a fabric from measured numbers.

    Give a stretching table with bending, or Young's modulus with the thickness.

    Args:
        name: Name of the fabric in messages.
        density: Mass per area [kg/m^2].
        stretching: Table (6, 4) [N/m], as `Fabric.stretching`, or the name of a measured fabric
            that has it. It excludes `young`.
        young: Young's modulus [Pa] of an isotropic fabric with `poisson` and `thickness`.
        poisson: Poisson's ratio, in [0, 0.5]. None is 0.
        thickness: Thickness [m], for `young`.
        bending: D [N m]: (3,) of warp, weft and twist (D11, D22, D66), or (3, 3). None takes
            the D of a plate with `young`, E h^3 / (12 (1 - poisson^2)).
        damping: Damping proportional to mass [1/s].

    Raises:
        ValueError: A number breaks its rule, is missing, or excludes another.
    """
    # Both would determine the table, and they might disagree.
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
        table = plate.stretching
        rigidity = plate.rigidity
    else:
        # A table says nothing about the thickness, so bending cannot follow from it.
        measured = fabric(stretching).stretching if isinstance(stretching, str) else stretching
        table = np.asarray(measured, float)
        if bending is None:
            raise ValueError("bending: must be given with stretching")
    if bending is not None:
        # Measured bending replaces the bending of the plate.
        numbers = np.asarray(bending, float)
        rigidity = np.diag(numbers) if numbers.shape == (3,) else numbers
    return Fabric(name, float(density), table, rigidity, float(damping))


def fabric_of_card(name: str, card: Mapping[str, Any]) -> Fabric:
    """Return a fabric from the numbers of its card: `custom_fabric`, and its softening.

    Raises:
        ValueError: A number breaks its rule, is missing, or excludes another.
    """
    numbers = dict(card)
    softening = numbers.pop("softening", None)
    return replace(custom_fabric(name, **numbers), softening=softening)


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
        rigidity: Bending stiffness D of a plate, E h^3 / (12 (1 - poisson^2)) [N m].
        poisson: Poisson's ratio, in [0, 0.5].
        name: Name of the fabric in messages.

    Raises:
        ValueError: A number breaks its rule.
    """
    check_positive(density=density, stretching=stretching, rigidity=rigidity)
    check_range("poisson", poisson, 0.0, 0.5)
    # Plane stress: a sheet is free to become thinner. Shear strain enters the energy as G01 and as
    # G10, so k3 is twice the shear modulus Y / (2 (1 + poisson)).
    tension = stretching / (1.0 - poisson**2)
    row = [tension, poisson * tension, tension, stretching / (1.0 + poisson)]
    plate = rigidity * np.array(
        [[1.0, poisson, 0.0], [poisson, 1.0, 0.0], [0.0, 0.0, 0.5 * (1.0 - poisson)]]
    )
    # All rows are the same: the stiffness depends neither on strain nor on its direction.
    return Fabric(name, float(density), np.tile(row, (6, 1)), plate)


@lru_cache
def fabric(name: str) -> Fabric:
    """Return one of the fabrics of [Wang et al. 2011].

    Stretching numbers are doubled, as in the authors' simulator. Negative ones are raised to 0, and
    the coupling is kept positive definite.

    Bending numbers k are coefficients of hinges. A plate with the same stiffness has D = k/4 on
    equilateral triangles. D against curvature along warp, weft and in between comes from the hinges
    across that direction. Without a coupling D12, D66 = D(45 degrees) - (D11 + D22)/4. D is the
    mean over the tabulated curvatures.

    Raises:
        ValueError: There is no such fabric.
    """
    table = _table()
    if name not in table:
        raise ValueError(f"fabric: must be one of {', '.join(table)}, got {name!r}")
    facts = table[name]
    k = 2.0 * np.maximum(np.array(facts["stretching"]), 0.0)
    # A measured coupling may exceed the limit of a positive energy. 0.95 leaves a margin.
    k[:, 1] = np.minimum(k[:, 1], 0.95 * np.sqrt(k[:, 0] * k[:, 2]))
    across_weft, between, across_warp = np.mean(facts["bending"], axis=1) / 4.0
    # The difference of measured numbers may be negative, and D must be positive definite.
    twist = max(between - 0.25 * (across_weft + across_warp), 0.1 * min(across_weft, across_warp))
    return Fabric(name, float(facts["density"]), k, np.diag([across_warp, across_weft, twist]))


def fabric_names() -> tuple[str, ...]:
    """Return the names that `fabric` accepts."""
    return tuple(_table())


@lru_cache
def _table() -> dict[str, dict[str, Any]]:
    text = files("stickslip_sim_core").joinpath("cloth", "fabrics.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)
