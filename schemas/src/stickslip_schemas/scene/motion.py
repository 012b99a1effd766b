"""Motions of holders and bodies, and the values that all parts of a scene share."""

from itertools import pairwise
from pathlib import PurePosixPath
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from stickslip_schemas.base.document import Document, Float
from stickslip_schemas.base.keys import ARTIFACT, is_sha256

Length = Annotated[Float, Field(gt=0, le=100)]
Place = Annotated[Float, Field(ge=-100, le=100)]
Vector = tuple[Place, Place, Place]
Angle = Annotated[Float, Field(ge=-6.2832, le=6.2832, description="at most a full turn [rad]")]
Turn = tuple[Angle, Angle, Angle]
Time = Annotated[Float, Field(ge=0, le=10_000)]


def _below_the_scene(name: str) -> str:
    """Return the name of a file: a reference to an artifact, or a path that stays in the folder of the scene."""
    if name.startswith(ARTIFACT):
        if not is_sha256(name.removeprefix(ARTIFACT)):
            raise ValueError("a reference to a file must be sha256: and 64 hexadecimal digits")
        return name
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or ":" in name:
        raise ValueError("a file must be in the folder of the scene or below, with / between folders")
    return name


FileName = Annotated[str, Field(min_length=1, max_length=1000), AfterValidator(_below_the_scene)]
"""A file of a scene: a path relative to the scene's folder, or `sha256:` and a digest once it is uploaded."""


def _by_name(value: Any) -> Any:
    """Return a mapping in the order of its names: canonical JSON has no other order."""
    return (
        dict(sorted(value.items())) if isinstance(value, dict) and all(isinstance(key, str) for key in value) else value
    )


BY_NAME = BeforeValidator(_by_name)
"""Puts a mapping into the order of its names."""


class Key(Document):
    """Where something is at an instant, since the start."""

    time: Time = Field(description="[s]")
    move: Vector = Field(default=(0.0, 0.0, 0.0), description="displacement since the start [m]")
    turn: Turn = Field(default=(0.0, 0.0, 0.0), description="rotation since the start, as a rotation vector [rad]")


class Spin(Document):
    """A rotation about an axis that begins at a time, gains its speed evenly, and then keeps it."""

    axis: Vector = (0.0, 0.0, 1.0)
    speed: Annotated[Float, Field(ge=-1000, le=1000)] = Field(description="[rad/s]")
    begin: Time = Field(default=0.0, description="when it begins [s]")
    ramp: Time = Field(default=0.0, description="time in which it gains its speed [s]")

    @model_validator(mode="after")
    def _points_somewhere(self) -> Self:
        if not any(self.axis):
            raise ValueError(f"axis must not be 0, and it is {list(self.axis)}")
        return self


class Motion(Document):
    """A rigid motion: through keyframes, a spin, or a path from a file."""

    keys: tuple[Key, ...] | None = Field(default=None, min_length=1, max_length=1000)
    spin: Spin | None = None
    path: FileName | None = Field(
        default=None,
        description="a CSV file with the columns time, x, y, z, rx, ry, rz, or an NPZ file with time (K), move (K, 3) "
        "and turn (K, 3): [s], [m], [rad], since the start",
    )
    interpolation: Literal["smooth", "linear"] = Field(
        default="smooth",
        description="smooth: without overshoot, at rest at the first and the last key; linear: at even speed between",
    )
    ramp: Time = Field(default=0.0, description="time in which a linear motion changes its speed at each key [s]")
    about: Vector | None = Field(
        default=None, description="point that turns are about [m]; by default the middle of what moves, at the start"
    )

    @model_validator(mode="after")
    def _is_one_motion(self) -> Self:
        given = [name for name in ("keys", "spin", "path") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"a motion must have one of keys, spin and path, and it has {', '.join(given) or 'none'}")
        if self.ramp and (self.spin is not None or self.interpolation == "smooth"):
            raise ValueError(
                f"ramp is of linear keys and paths, and this motion is not linear; ramp is {self.ramp:g} s"
            )
        for before, after in pairwise(self.keys or ()):
            if not before.time < after.time:
                raise ValueError(f"keys must ascend in time, and {after.time:g} s comes after {before.time:g} s")
        return self
