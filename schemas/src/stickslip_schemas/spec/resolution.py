"""Sizes of pictures: what a spec may ask for, and how much of it fits into memory."""

from typing import Annotated, Any

from pydantic import BeforeValidator, Field, Strict

from stickslip_schemas.base import WHOLE

LEAST_SIDE = 64
"""Of a picture [px]: in a smaller one the band of 4 px along an edge would be all of the cloth."""
LARGEST_SIDE = 1920
"""Of a picture [px]: that of full HD, the largest of the usual cameras of robots."""

CLIP_PIXELS_MAX = 2**27
"""Pixels of all frames of a clip: its shading takes 24 bytes of memory for each, 3.2 GB in all."""

_RULE = (
    f"must be [width, height], two whole numbers from {LEAST_SIDE} to {LARGEST_SIDE} pixels, for "
    "example [640, 480]"
)


def _check_pair(value: Any) -> Any:
    """Raise ValueError with one rule for all that can be wrong with a size."""
    sides = value if isinstance(value, list | tuple) else ()
    in_range = [_is_side(side) for side in sides]
    if in_range != [True, True]:
        raise ValueError(_RULE)
    return value


def _is_side(side: Any) -> bool:
    # True is an integer of Python, and no number of pixels.
    is_number = isinstance(side, int | float) and not isinstance(side, bool)
    # The range comes first: an infinite number has no whole part.
    return is_number and LEAST_SIDE <= side <= LARGEST_SIDE and side == int(side)


Side = Annotated[int, Strict(), Field(ge=LEAST_SIDE, le=LARGEST_SIDE), WHOLE]
Resolution = Annotated[tuple[Side, Side], BeforeValidator(_check_pair)]
"""Width and height of a picture [px]."""

DEFAULT_RESOLUTION = (224, 224)
"""Width and height of a picture if the spec says nothing [px]."""


def is_default(size: tuple[int, int]) -> bool:
    """Return whether a size is the default.

    Documents leave it out then, so that specs and renders of the default keep their content keys.
    """
    return tuple(size) == DEFAULT_RESOLUTION


def resolution_field(description: str, **more: Any) -> Any:
    """Return the field of a size that documents leave out if it is the default."""
    return Field(default=DEFAULT_RESOLUTION, exclude_if=is_default, description=description, **more)


def enclosing(sizes: Any) -> tuple[int, int]:
    """Return the smallest size that holds pictures of all sizes [px]."""
    widths, heights = zip(*sizes, strict=True)
    return max(widths), max(heights)
