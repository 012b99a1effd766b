"""Upload of textures, and of files of scenes."""

from typing import Any

from fastapi import APIRouter, Request
from starlette.concurrency import run_in_threadpool
from stickslip_schemas.documents.problems import FieldError, ProblemCode
from stickslip_schemas.documents.responses import FileUpload, TextureEntry
from stickslip_schemas.format.pictures import UnfitPictureError
from stickslip_schemas.scene.files import UnfitFileError

from stickslip_services.api.bodies import whole_body
from stickslip_services.api.problems import ProblemError
from stickslip_services.api.routes.common import BODY_PROBLEMS, ContextDep, problem_responses
from stickslip_services.catalog.uploads import store_file, store_texture

router = APIRouter(tags=["uploads"])

MEDIA_TYPES = {"image/png": b"\x89PNG", "image/jpeg": b"\xff\xd8\xff"}
"""Accepted media types, and the first bytes of such files."""

_PICTURE: dict[str, Any] = {"schema": {"type": "string", "format": "binary"}}
_BODY = {"requestBody": {"required": True, "content": dict.fromkeys(MEDIA_TYPES, _PICTURE)}}


@router.post("/v1/textures", status_code=201, responses=problem_responses(*BODY_PROBLEMS), openapi_extra=_BODY)
async def post_texture(request: Request, context: ContextDep) -> TextureEntry:
    """Upload a texture: a square PNG or JPEG file, opaque, of 64 to 4096 pixels a side. It may be sent twice.

    A picture that no job names is deleted by `stickslip gc` after a day.
    """
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type not in MEDIA_TYPES:
        detail = f"Content-Type must be {' or '.join(MEDIA_TYPES)}, and it is {media_type[:100]!r}"
        raise ProblemError(415, ProblemCode.malformed_body, detail)
    data = await whole_body(request)
    try:
        if not data.startswith(MEDIA_TYPES[media_type]):
            raise UnfitPictureError(
                f"a texture must be a whole PNG or JPEG file, and of its Content-Type, {media_type}"
            )
        return await run_in_threadpool(store_texture, context.database, context.store, data)
    except UnfitPictureError as error:
        raise _refused(error, data) from error


@router.post(
    "/v1/files",
    status_code=201,
    responses=problem_responses(*BODY_PROBLEMS),
    openapi_extra={"requestBody": {"required": True, "content": {"application/octet-stream": _PICTURE}}},
)
async def post_file(request: Request, context: ContextDep) -> FileUpload:
    """Upload a file that a scene names: a mesh (OBJ, NPZ), a start (OBJ, NPZ) or a path (CSV, NPZ), of at most 16 MiB.

    A file that no job names is deleted by `stickslip gc` after a day.
    """
    data = await whole_body(request)
    try:
        return await run_in_threadpool(store_file, context.database, context.store, data)
    except UnfitFileError as error:
        raise _refused(error, data) from error


def _refused(error: Exception, data: bytes) -> ProblemError:
    field = FieldError(pointer="", rule=str(error), value=f'"{len(data)} bytes"')
    return ProblemError(422, ProblemCode.validation_failed, str(error), fields=[field])
