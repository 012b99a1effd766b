"""Uploaded files: textures, and meshes and paths of scenes; specs name them by their digests."""

from sqlalchemy import insert, select
from stickslip_schemas.base import ARTIFACT, Sha256
from stickslip_schemas.documents.problems import FieldError
from stickslip_schemas.documents.responses import FileUpload, TextureEntry
from stickslip_schemas.format.pictures import UnfitPictureError, read_picture
from stickslip_schemas.kinds.cloth_scene import ClothSceneSpec
from stickslip_schemas.scene.files import UnfitFileError, check_scene_file, counts_of
from stickslip_schemas.scene.library import built_in_files
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_schemas.store import Store

from stickslip_services.access.asker import own, this_asker
from stickslip_services.database.database import Database
from stickslip_services.database.tables import uploads
from stickslip_services.errors import UnknownFileError


def store_texture(database: Database, store: Store, data: bytes) -> TextureEntry:
    """Store a picture file; raise UnfitPictureError where it cannot be a texture."""
    side = len(read_picture(data))
    return TextureEntry(texture=f"{ARTIFACT}{_store(database, store, data)}", side=side, bytes=len(data))


def store_file(database: Database, store: Store, data: bytes) -> FileUpload:
    """Store a file of a scene; raise UnfitFileError where it can be none."""
    counts = counts_of(data)
    return FileUpload(file=f"{ARTIFACT}{_store(database, store, data)}", counts=counts, bytes=len(data))


def _store(database: Database, store: Store, data: bytes) -> Sha256:
    """Store an artifact for the project of the asker."""
    row = {"project": this_asker().project, "digest": store.publish(data)}
    with database.write() as connection:
        if connection.scalar(select(uploads.c.digest).filter_by(**row)) is None:
            connection.execute(insert(uploads).values(row))
    return row["digest"]


def check_files(database: Database, store: Store, spec: JobSpec) -> None:
    """Raise UnknownFileError where a spec names files that are missing, damaged, or not what it needs.

    Those of other projects are as good as missing. Files of built-in scenes are stored first.
    """
    wrong = []
    with database.read() as connection:
        asked = select(uploads.c.digest).where(uploads.c.digest.in_(spec.artifacts.values()), own(uploads.c.project))
        uploaded = set(connection.scalars(asked))
    for pointer, digest in spec.artifacts.items():
        try:
            if (data := built_in_files().get(digest)) is not None:
                if not store.exists(digest):
                    store.publish(data)
            elif digest not in uploaded and not this_asker().sees_all:
                raise FileNotFoundError
            _check(spec, pointer, store.read(digest))
        except (UnfitPictureError, UnfitFileError) as error:
            rule = f"must name a file that fits: {error}"
        except OSError:
            rule = "must name a file that was uploaded; `stickslip upload FILE` does it"
        else:
            continue
        wrong.append(FieldError(pointer=pointer, rule=rule, value=f'"{ARTIFACT}{digest}"'))
    if isinstance(spec, ClothSceneSpec):
        for place, name in spec.scene.files():
            if not name.startswith(ARTIFACT):
                rule = "must be sha256: and the digest of an uploaded file; `stickslip submit` uploads files of scenes"
                wrong.append(FieldError(pointer="/".join(("/scene", *map(str, place))), rule=rule, value=f'"{name}"'))
    if wrong:
        raise UnknownFileError(wrong)


def _check(spec: JobSpec, pointer: str, data: bytes) -> None:
    """Raise UnfitPictureError or UnfitFileError where a file is not what the spec needs at a pointer."""
    words = pointer.split("/")[1:]
    if isinstance(spec, ClothSceneSpec) and words[0] == "scene" and words[1] != "looks":
        check_scene_file(spec.stage, tuple(words[1:]), data)
    else:
        read_picture(data)
