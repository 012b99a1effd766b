"""Uploads: textures and files of scenes, which specs name by digest.

One gate for all of them: the size of a file is limited while it arrives (`api/bodies.py`), and its
contents are decoded by another process (`catalog/inspector.py`).
"""

from typing import IO

from sqlalchemy import insert, select
from stickslip_schemas.base import ARTIFACT, Sha256
from stickslip_schemas.documents.responses import FileUpload, TextureEntry
from stickslip_schemas.store import Store

from stickslip_services.access.principals import current_principal
from stickslip_services.catalog.inspector import INSPECTOR
from stickslip_services.database.database import Database
from stickslip_services.database.tables import uploads


def store_texture(database: Database, store: Store, file: IO[bytes]) -> TextureEntry:
    """Store a picture file; raise UnfitFileError if it cannot be a texture."""
    side = INSPECTOR.inspect(file, {"inspection": "texture"})
    digest, size = _store(database, store, file)
    return TextureEntry(texture=f"{ARTIFACT}{digest}", side=side, bytes=size)


def store_scene_file(database: Database, store: Store, file: IO[bytes]) -> FileUpload:
    """Store a file of a scene; raise UnfitFileError if no scene can use it."""
    counts = INSPECTOR.inspect(file, {"inspection": "scene_file"})
    digest, size = _store(database, store, file)
    return FileUpload(file=f"{ARTIFACT}{digest}", counts=counts, bytes=size)


def _store(database: Database, store: Store, file: IO[bytes]) -> tuple[Sha256, int]:
    """Store an artifact for the project of the principal; return its digest and size [bytes]."""
    # Only a file that was inspected is read into the coordinator, and at most two at a time.
    file.seek(0)
    data = file.read()
    row = {"project": current_principal().project, "digest": store.publish(data)}
    # The row gives the project the right to name the file in its specs.
    with database.write() as connection:
        known = connection.scalar(select(uploads.c.digest).filter_by(**row))
        if known is None:
            connection.execute(insert(uploads).values(row))
    return row["digest"], len(data)
