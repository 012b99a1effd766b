"""Uploaded textures: pictures in the store, which specs name by their digests."""

from stickslip_schemas.base.keys import ARTIFACT
from stickslip_schemas.documents.problems import FieldError
from stickslip_schemas.documents.responses import TextureEntry
from stickslip_schemas.format.pictures import UnfitPictureError, read_picture
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_schemas.store import Store

from stickslip_services.errors import UnknownTextureError


def store_texture(store: Store, data: bytes) -> TextureEntry:
    """Store a picture file; raise UnfitPictureError where it cannot be a texture."""
    side = len(read_picture(data))
    return TextureEntry(texture=f"{ARTIFACT}{store.publish(data)}", side=side, bytes=len(data))


def check_textures(store: Store, spec: JobSpec) -> None:
    """Raise UnknownTextureError where a spec names pictures that are missing or damaged in the store."""
    wrong = []
    for pointer, digest in spec.artifacts.items():
        try:
            read_picture(store.read(digest))
        except UnfitPictureError as error:
            rule = f"must name a texture: {error}"
        except OSError:
            rule = "must name a texture that was uploaded; `stickslip upload FILE` does it"
        else:
            continue
        wrong.append(FieldError(pointer=pointer, rule=rule, value=f'"{ARTIFACT}{digest}"'))
    if wrong:
        raise UnknownTextureError(wrong)
