"""Datasets, their versions and their files.

Certificates; and uploads of textures and of files of scenes.

`.../versions/N/files/` is the root of a Zarr store: any Zarr reader opens it at its URL.
"""

from collections.abc import Callable
from os import SEEK_END
from typing import IO, Annotated, TypeVar

from fastapi import APIRouter, Depends, Request, Response
from starlette.concurrency import run_in_threadpool
from stickslip_schemas.base import is_sha256
from stickslip_schemas.documents import responses
from stickslip_schemas.documents.certificate import Certificate
from stickslip_schemas.documents.problems import FieldError, ProblemCode
from stickslip_schemas.format.manifest import MANIFEST_NAME, SIGNATURE_NAME
from stickslip_schemas.scene.errors import UnfitFileError
from stickslip_schemas.store import Store

from stickslip_services.api.artifacts import picture_format, serve
from stickslip_services.api.bodies import (
    CERTIFICATE_BYTES,
    JsonBody,
    content_type,
    spooled_body,
    wrong_media_type,
)
from stickslip_services.api.problems import ProblemError
from stickslip_services.api.routes.common import (
    BODY_PROBLEMS,
    ContextDep,
    PageDep,
    StrictRoute,
    Version,
    json_content,
    problem_responses,
    reads,
    serves,
)
from stickslip_services.catalog.inputs import (
    find_certificate,
    list_certificates,
    register_certificate,
)
from stickslip_services.catalog.uploads import store_scene_file, store_texture
from stickslip_services.catalog.versions import find_dataset, find_file, find_version, list_datasets
from stickslip_services.database.database import Database
from stickslip_services.errors import NotFoundError
from stickslip_services.queue.context import Context
from stickslip_services.queue.jobs import is_preview

T = TypeVar("T")

router = APIRouter(route_class=StrictRoute)

_BINARY = {"schema": {"type": "string", "format": "binary"}}
_PICTURES = {"image/png": b"\x89PNG", "image/jpeg": b"\xff\xd8\xff"}
"""Accepted media types of textures, and the first bytes of such files."""
_PICTURE_BODY = {"requestBody": {"required": True, "content": dict.fromkeys(_PICTURES, _BINARY)}}
_FILE_BODY = {"requestBody": {"required": True, "content": {"application/octet-stream": _BINARY}}}


@router.get("/v1/datasets", responses=problem_responses())
def get_datasets(page: PageDep, context: ContextDep) -> responses.Page[responses.Dataset]:
    """List datasets, newest first."""
    with context.database.read() as connection:
        return list_datasets(connection, page)


@router.get("/v1/datasets/{dataset}", responses=problem_responses(404))
def get_dataset(dataset: str, context: ContextDep) -> responses.Dataset:
    """Return a dataset with its versions."""
    with context.database.read() as connection:
        return find_dataset(connection, dataset)


@router.get("/v1/datasets/{dataset}/versions/{version}", responses=problem_responses(404))
def get_version(dataset: str, version: Version, context: ContextDep) -> responses.DatasetVersion:
    """Return a version."""
    with context.database.read() as connection:
        return find_version(connection, dataset, version)


@router.get(
    "/v1/datasets/{dataset}/versions/{version}/manifest", **serves(json_content("Manifest"))
)
@router.head("/v1/datasets/{dataset}/versions/{version}/manifest", include_in_schema=False)
def get_manifest(dataset: str, version: Version, request: Request, context: ContextDep) -> Response:
    """Return the manifest: every file of the version with its digest, the spec and the builds."""
    return _serve(request, context, dataset, version, MANIFEST_NAME)


@router.get(
    "/v1/datasets/{dataset}/versions/{version}/files/{path:path}",
    **serves({"application/octet-stream": _BINARY}, 422),
)
@router.head("/v1/datasets/{dataset}/versions/{version}/files/{path:path}", include_in_schema=False)
def get_file(
    dataset: str, version: Version, path: str, request: Request, context: ContextDep
) -> Response:
    """Return a file of the version, or a range of it."""
    return _serve(request, context, dataset, version, path)


@router.get("/v1/previews/{digest}", **serves({"image/png": _BINARY, "image/webp": _BINARY}))
def get_preview(digest: str, request: Request, context: ContextDep) -> Response:
    """Return the picture of a sample."""
    # An artifact is served only if it is a preview of a sample that the principal sees: the store
    # holds files of all projects.
    with context.database.read() as connection:
        if not (is_sha256(digest) and is_preview(connection, digest)):
            raise NotFoundError(f"there is no preview {digest[:100]!r}")
    name = f"preview.{picture_format(context.store, digest)}"
    return serve(request, context.store, digest, name=name)


def _serve(
    request: Request, context: ContextDep, dataset: str, version: int, path: str
) -> Response:
    with context.database.read() as connection:
        row = find_version(connection, dataset, version)
    if path == SIGNATURE_NAME:  # it may be made, and replaced, at any time
        try:
            signature = context.store.read_shown(dataset, version, path)
        except FileNotFoundError:
            raise NotFoundError(f"version {version} is not signed") from None
        return Response(
            signature, headers={"Cache-Control": "no-store"}, media_type="application/octet-stream"
        )
    file = find_file(context.store, row, path)
    return serve(request, context.store, file.sha256, name=path, size=file.size)


@router.post("/v1/certificates", status_code=201, **reads("Certificate"))
def post_certificate(
    certificate: Annotated[
        Certificate, Depends(JsonBody(Certificate, max_bytes=CERTIFICATE_BYTES))
    ],
    context: ContextDep,
    response: Response,
) -> responses.CertificateEntry:
    """Register a certificate; it may be sent twice.

    The newest full certificate of a preset and build counts.
    """
    entry = register_certificate(context.database, context.store, certificate, context.clock())
    response.headers["Location"] = entry.href
    return entry


@router.get("/v1/certificates", responses=problem_responses())
def get_certificates(
    page: PageDep, context: ContextDep
) -> responses.Page[responses.CertificateEntry]:
    """List certificates, newest first."""
    with context.database.read() as connection:
        return list_certificates(connection, page)


@router.get("/v1/certificates/{digest}", **serves(json_content("Certificate")))
def get_certificate(digest: str, request: Request, context: ContextDep) -> Response:
    """Return a certificate."""
    with context.database.read() as connection:
        artifact = find_certificate(connection, digest).artifact
    return serve(request, context.store, artifact, name="certificate.json")


@router.post(
    "/v1/textures",
    status_code=201,
    responses=problem_responses(*BODY_PROBLEMS),
    openapi_extra=_PICTURE_BODY,
)
async def post_texture(request: Request) -> responses.TextureEntry:
    """Upload a texture: a square PNG or JPEG file, opaque, of 64 to 4096 pixels a side.

    It may be sent twice.

    A picture that no job names is deleted by `stickslip gc` after a day.
    """
    media_type = content_type(request)
    if media_type not in _PICTURES:
        raise wrong_media_type(" or ".join(_PICTURES), media_type)
    async with spooled_body(request) as file:
        magic = _PICTURES[media_type]
        if file.read(len(magic)) != magic:
            rule = (
                f"a texture must be a whole PNG or JPEG file, and of its Content-Type, {media_type}"
            )
            raise _refusal(rule, file)
        return await _store(request, store_texture, file)


@router.post(
    "/v1/files",
    status_code=201,
    responses=problem_responses(*BODY_PROBLEMS),
    openapi_extra=_FILE_BODY,
)
async def post_file(request: Request) -> responses.FileUpload:
    """Upload a file that a scene names, of at most 16 MiB: a mesh, a start or a path.

    Meshes are OBJ, PLY, STL or NPZ files, starts OBJ, PLY or NPZ files, paths CSV or NPZ files.

    A file that no job names is deleted by `stickslip gc` after a day.
    """
    async with spooled_body(request) as file:
        return await _store(request, store_scene_file, file)


async def _store(
    request: Request, store: Callable[[Database, Store, IO[bytes]], T], file: IO[bytes]
) -> T:
    """Store an upload when it is its turn; raise ProblemError if it is not fit for its use."""
    context: Context = request.app.state.context
    try:
        # Uploads wait here and not in a thread: all other routes share the same few threads.
        async with request.app.state.upload_turns:
            return await run_in_threadpool(store, context.database, context.store, file)
    except UnfitFileError as error:
        raise _refusal(str(error), file) from error


def _refusal(rule: str, file: IO[bytes]) -> ProblemError:
    size = file.seek(0, SEEK_END)
    field = FieldError(pointer="", rule=rule, value=f'"{size} bytes"')
    return ProblemError(422, ProblemCode.validation_failed, rule, fields=[field])
