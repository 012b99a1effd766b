"""A rasteriser: what a camera sees of a mesh, without light.

Cycles gives the light. Albedo at texture edges, silhouettes, depth and other ground truth are geometry, and cost far
less here. The compiled part is `_raster`; raster/raster.hpp says where samples lie and how textures are looked up.
"""

from stickslip_blender.raster.visibility import (
    GRID,
    Albedo,
    Seen,
    Textures,
    Window,
    decoded,
    fans,
    projected,
    see,
    see_albedo,
    window_about,
)

__all__ = [
    "GRID",
    "Albedo",
    "Seen",
    "Textures",
    "Window",
    "decoded",
    "fans",
    "projected",
    "see",
    "see_albedo",
    "window_about",
]
