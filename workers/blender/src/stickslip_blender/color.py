"""Colors of silicone, drawn from a seed."""

from __future__ import annotations

import colorsys

import numpy as np

Color = tuple[float, float, float]


def silicone_color(seed: int) -> Color:
    """Draw a bright, saturated color, sRGB in [0, 1], rounded to 1/255.

    Hue uniform, HSV saturation in [0.55, 0.95], value in [0.7, 1].
    """
    hue, saturation, value = np.random.Generator(np.random.PCG64(seed)).random(3)
    color = colorsys.hsv_to_rgb(hue, 0.55 + 0.4 * saturation, 0.7 + 0.3 * value)
    red, green, blue = (round(channel * 255) / 255 for channel in color)
    return red, green, blue


def to_linear(color: Color) -> Color:
    """Decode sRGB [IEC 61966-2-1] to linear light, which is what Blender's shaders take."""
    red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in color)
    return red, green, blue
