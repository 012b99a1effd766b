"""Datasets, their versions and their files.

`.../versions/N/files/` is the root of a Zarr store: any Zarr reader opens it at its URL.
"""

from typing import Any

from fastapi import APIRouter, Request, Response
from stickslip_schemas.base import is_sha256
from stickslip_schemas.documents.responses import Dataset, DatasetVersion, Page
from stickslip_schemas.format.manifest import MANIFEST_NAME, SIGNATURE_NAME

from stickslip_services.api.files import picture_format, serve
from stickslip_services.api.routes.common import ContextDep, PageDep, Version, file_responses, problem_responses
from stickslip_services.catalog.datasets import find_dataset, find_file, find_version, list_datasets
from stickslip_services.errors import NotFoundError
from stickslip_services.queue.jobs import is_preview

router = APIRouter(tags=["datasets"])

_BINARY_SCHEMA = {"schema": {"type": "string", "format": "binary"}}
_BINARY = {"application/octet-stream": _BINARY_SCHEMA}
_PICTURE = {"image/png": _BINARY_SCHEMA, "image/webp": _BINARY_SCHEMA}


@router.get("/v1/datasets", responses=problem_responses(422))
def get_datasets(page: PageDep, context: ContextDep) -> Page[Dataset]:
    """List datasets, newest first."""
    with context.database.read() as connection:
        return list_datasets(connection, page)


@router.get("/v1/datasets/{dataset}", responses=problem_responses(404))
def get_dataset(dataset: str, context: ContextDep) -> Dataset:
    """Return a dataset with its versions."""
    with context.database.read() as connection:
        return find_dataset(connection, dataset)


@router.get("/v1/datasets/{dataset}/versions/{version}", responses=problem_responses(404, 422))
def get_version(dataset: str, version: Version, context: ContextDep) -> DatasetVersion:
    """Return a version."""
    with context.database.read() as connection:
        return find_version(connection, dataset, version)


_MANIFEST_CONTENT: dict[str, Any] = {"application/json": {"schema": {"$ref": "#/components/schemas/Manifest"}}}


@router.get(
    "/v1/datasets/{dataset}/versions/{version}/manifest",
    response_class=Response,
    responses=file_responses(_MANIFEST_CONTENT, 422),
)
@router.head("/v1/datasets/{dataset}/versions/{version}/manifest", include_in_schema=False)
def get_manifest(dataset: str, version: Version, request: Request, context: ContextDep) -> Response:
    """Return the manifest: every file of the version with its digest, the spec and the builds."""
    return _serve(request, context, dataset, version, MANIFEST_NAME)


@router.get(
    "/v1/datasets/{dataset}/versions/{version}/files/{path:path}",
    response_class=Response,
    responses=file_responses(_BINARY, 422),
)
@router.head("/v1/datasets/{dataset}/versions/{version}/files/{path:path}", include_in_schema=False)
def get_file(dataset: str, version: Version, path: str, request: Request, context: ContextDep) -> Response:
    """Return a file of the version, or a range of it."""
    return _serve(request, context, dataset, version, path)


@router.get("/v1/previews/{digest}", response_class=Response, responses=file_responses(_PICTURE, 422), tags=["jobs"])
def get_preview(digest: str, request: Request, context: ContextDep) -> Response:
    """Return the picture of a sample."""
    with context.database.read() as connection:
        if not (is_sha256(digest) and is_preview(connection, digest)):
            raise NotFoundError(f"there is no preview {digest[:100]!r}")
    name = f"preview.{picture_format(context.store, digest)}"
    return serve(request, context.store, digest, name=name)


def _serve(request: Request, context: ContextDep, dataset: str, version: int, path: str) -> Response:
    with context.database.read() as connection:
        found = find_version(connection, dataset, version)
    if path == SIGNATURE_NAME:  # it may be made, and replaced, at any time
        try:
            signature = context.store.read_shown(dataset, version, path)
        except FileNotFoundError:
            raise NotFoundError(f"version {version} is not signed") from None
        return Response(signature, headers={"Cache-Control": "no-store"}, media_type="application/octet-stream")
    file = find_file(context.store, found, path)
    return serve(request, context.store, file.sha256, name=path, size=file.size)
