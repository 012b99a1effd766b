"""Which renderer this is: what enters a content key, besides what the task says."""

from __future__ import annotations

import hashlib
from importlib.resources import files
from importlib.resources.abc import Traversable

from stickslip_schemas.keys import content_key

from stickslip_blender.blender import import_bpy


def blender_version() -> dict[str, str]:
    """Return the versions of Blender: of the module and of the sources it was built from."""
    app = import_bpy().app
    return {"bpy": app.version_string, "blender_build": app.build_hash.decode()}


def build_digest() -> str:
    """Return the SHA-256 over this package's sources and Blender's version; no path, time or machine is in it."""
    sources = {
        name: hashlib.sha256(file.read_bytes()).hexdigest() for name, file in _sources(files("stickslip_blender"), "")
    }
    return content_key("build/blender", {"sources": sources, **blender_version()})


def _sources(folder: Traversable, prefix: str) -> list[tuple[str, Traversable]]:
    found: list[tuple[str, Traversable]] = []
    for item in folder.iterdir():
        if item.is_dir():
            found += _sources(item, f"{prefix}{item.name}/")
        elif item.name.endswith(".py"):
            found.append((prefix + item.name, item))
    return found
