"""The build of the renderer: the part of a content key that the task does not give."""

from functools import cache
from importlib import metadata

from stickslip_schemas.base import content_key
from stickslip_schemas.plan.builds import UNCOUNTED, digests, sources

from stickslip_blender.cycles.blender import blender_version, described
from stickslip_blender.raster._raster import BUILD_HASH

_LIBRARIES = ("numcodecs", "google-crc32c", "numpy", "pillow")


def roots(kind: str) -> tuple[str, ...]:
    """Return the modules that render a kind."""
    return ("stickslip_blender.actor", f"stickslip_blender.scenes.{kind}")


@cache
def build_digest(kind: str) -> str:
    """Return the SHA-256 over the sources that render a kind, and versions; no path, time or machine is part of it."""
    content = {
        "kind": kind,
        "sources": digests(sources(roots(kind), cut=UNCOUNTED)),
        "raster": BUILD_HASH,
        "libraries": {library: metadata.version(library) for library in _LIBRARIES},
        **blender_version(),
        **described(),
    }
    return content_key("build/render", content)
