"""Our own rasteriser: what a camera sees of a mesh, without light.

Cycles gives light; albedo at texture edges, silhouettes, depth and the rest are geometry, and far cheaper here. The
compiled part is `_raster`; raster/raster.hpp says where samples lie and how textures are looked up.
"""

from stickslip_blender.pixels import Window
from stickslip_blender.raster.albedo import Albedo, Textures, see_albedo
from stickslip_blender.raster.visibility import GRID, Seen, projected, see, window_about

__all__ = ["GRID", "Albedo", "Seen", "Textures", "Window", "projected", "see", "see_albedo", "window_about"]
