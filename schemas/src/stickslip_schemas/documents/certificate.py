"""The certificate: measurements of one build and one preset on the physical protocols.

Its digest is over everything but `environment` and the densely drawn curves: the same build and
preset on another day give the same certificate.
"""

from collections.abc import Iterable
from itertools import chain
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from stickslip_schemas.base import Bool, Document, Float, Sha256, canonical_json, content_key

Numbers = tuple[Float | None, ...]

# The day, the machine and the points of pictures say nothing about the solver.
_NOT_CONTENT: Any = {
    "environment": True,
    "protocols": {"__all__": {"curves": {"__all__": {"dense_x", "dense_master"}}}},
}


class CurveReport(Document):
    """A measured curve beside its master curve; null if there is nothing to measure."""

    parameters: dict[str, Float]
    # One value for each point of the curve.
    x: Numbers
    measured: Numbers
    master: Numbers
    errors: Numbers = Field(description="measured over master less one; null is infinite")
    limit: Numbers = Field(
        default=(), description="extrapolated to cells of no size, of a protocol on three meshes"
    )
    order: Numbers = Field(
        default=(),
        description=(
            "power of the cell's size with which errors fall; null: none was found, and 2 was taken"
        ),
    )
    limit_errors: Numbers = Field(
        default=(), description="limit over master less one; null is infinite"
    )
    cells: tuple[Numbers, ...] = Field(
        default=(),
        description=(
            "by mesh, the coarsest first, and point: cells along the sheet; the last is that of x"
        ),
    )
    errors_by_mesh: tuple[Numbers, ...] = Field(
        default=(), description="errors with these cells; the last are `errors`"
    )
    dense_x: Numbers = Field(
        default=(), description="where the master curve is drawn densely; for pictures only"
    )
    dense_master: Numbers = ()

    @model_validator(mode="after")
    def _one_length(self) -> Self:
        # All columns belong to the same points of the curve.
        lengths = {len(self.x), len(self.measured), len(self.master), len(self.errors)}
        if len(lengths) > 1:
            raise ValueError(
                "x, measured, master and errors must have one length, and theirs are "
                f"{sorted(lengths)}"
            )
        # The extrapolation to cells of no size has the same points, and ends with the finest mesh.
        refined_columns = (
            *self.cells,
            *self.errors_by_mesh,
            self.limit,
            self.order,
            self.limit_errors,
        )
        refined = {len(column) for column in refined_columns}
        if self.cells and (refined != lengths or self.errors_by_mesh[-1:] != (self.errors,)):
            raise ValueError(
                "limit, order, cells and errors_by_mesh must have the length of x, and end with "
                "errors"
            )
        if len(self.cells) != len(self.errors_by_mesh) or bool(self.limit) != bool(self.cells):
            raise ValueError(
                "cells and errors_by_mesh must have the same meshes, and limit must come with them"
            )
        if len(self.dense_x) != len(self.dense_master):
            raise ValueError("dense_x and dense_master must have one length")
        return self


class ProtocolReport(Document):
    """A protocol that was run: `ProtocolResult.as_dict` of sim_core, or how it broke off."""

    protocol: str = Field(pattern=r"^[a-z0-9][a-z0-9-]{0,62}$")
    x: str
    y: str
    tolerance: Float = Field(ge=0, description="largest |relative error| that passes")
    error: Float | None = Field(ge=0, description="largest |relative error|; null is infinite")
    limit_tolerance: Float | None = Field(
        default=None,
        ge=0,
        description="largest |relative error| of a limit that passes; null without three meshes",
    )
    limit_error: Float | None = Field(
        default=None, ge=0, description="largest |relative error| of a limit"
    )
    passed: Bool
    settings: dict[str, Any]
    build_hash: Sha256 = Field(description="of the compiled core")
    curves: tuple[CurveReport, ...]
    message: str = Field(default="", description="why it broke off, where it did")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        # What the report claims must follow from its numbers: nobody can pass by saying so.
        largest = _largest_error(curve.errors for curve in self.curves)
        if self.error != largest:
            raise ValueError(
                f"error must be the largest of the curves' errors, {largest}, and it is "
                f"{self.error}"
            )
        within = self.error is not None and self.error <= self.tolerance
        if self.limit_tolerance is not None:
            largest = _largest_error(curve.limit_errors for curve in self.curves)
            if self.limit_error != largest:
                raise ValueError(
                    f"limit_error must be the largest of the limits' errors, {largest}"
                )
            within = (
                within and self.limit_error is not None and self.limit_error <= self.limit_tolerance
            )
        elif self.limit_error is not None or any(curve.limit for curve in self.curves):
            raise ValueError("limit_tolerance must be given with limits")
        # A step above the tolerance of its preset is no measurement.
        converged = self.settings.get("unconverged_steps", 0) == 0
        if self.passed != (within and converged and not self.message):
            raise ValueError(
                "passed must say whether the errors are within their tolerances and all steps "
                "have converged"
            )
        return self


def _largest_error(curves: Iterable[Numbers]) -> float | None:
    """Return the largest |error| of all curves; None if one is infinite, or there is none."""
    errors = list(chain.from_iterable(curves))
    if not errors or None in errors:
        return None
    return max(abs(error) for error in errors if error is not None)


class Certificate(Document):
    """How well a build and a preset follow the master curves."""

    format: Literal["stickslip-certificate/1"] = "stickslip-certificate/1"
    preset: str = Field(pattern=r"^[a-z0-9][a-z0-9-]{0,62}$")
    numbers: dict[str, Any] = Field(description="the settings that the preset stands for")
    sim_core: Sha256 = Field(
        description="build of the solver that was measured (`Builds.sim_core`)"
    )
    protocol_sources: Sha256 = Field(
        description="digest of the sources that measured and of the master curves"
    )
    extent: Literal["full", "quick"] = Field(
        description="quick: few points, to try things out; certifies nothing"
    )
    protocols: tuple[ProtocolReport, ...] = Field(min_length=1)
    passed: Bool
    environment: dict[str, str] = Field(
        description="where and how it was made; not part of the content"
    )

    @property
    def digest(self) -> str:
        return content_key("certificate", self.model_dump(mode="json", exclude=_NOT_CONTENT))

    @property
    def certifies(self) -> bool:
        """True if data of this build and preset may be made."""
        return self.passed and self.extent == "full"

    def canonical(self) -> bytes:
        return canonical_json(self.model_dump(mode="json")).encode()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        names = [protocol.protocol for protocol in self.protocols]
        if len(set(names)) != len(names):
            raise ValueError(f"every protocol must be there once, and they are {names}")
        if self.passed != all(protocol.passed for protocol in self.protocols):
            raise ValueError("passed must say whether all protocols passed")
        if len({protocol.build_hash for protocol in self.protocols}) > 1:
            raise ValueError("all protocols must have been run with one build")
        return self
