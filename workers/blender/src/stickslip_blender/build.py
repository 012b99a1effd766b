"""Which renderer this is: what enters a content key, besides what the task says."""

from __future__ import annotations

from functools import cache
from importlib import metadata

from stickslip_schemas.base.keys import content_key
from stickslip_schemas.plan.sources import UNCOUNTED, digests, sources

from stickslip_blender.blender import import_bpy
from stickslip_blender.device import described
from stickslip_blender.raster._raster import BUILD_HASH

_LIBRARIES = ("numcodecs", "google-crc32c", "numpy", "pillow")


def blender_version() -> dict[str, str]:
    """Return the versions of Blender: of the module and of the sources it was built from."""
    app = import_bpy().app
    return {"bpy": app.version_string, "blender_build": app.build_hash.decode()}


def roots(kind: str) -> tuple[str, ...]:
    """Return the modules that render a kind."""
    return ("stickslip_blender.actor", f"stickslip_blender.scenes.{kind}")


@cache
def build_digest(kind: str) -> str:
    """Return the SHA-256 over the sources that render a kind, and over versions; no path, time or machine is in it."""
    content = {
        "kind": kind,
        "sources": digests(sources(roots(kind), cut=UNCOUNTED)),
        "raster": BUILD_HASH,
        "libraries": {library: metadata.version(library) for library in _LIBRARIES},
        **blender_version(),
        **described(),
    }
    return content_key("build/render", content)
