"""Routes of certificates: register and list them, and show their pages."""

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request, Response
from stickslip_schemas.documents.certificate import CertificateUpload
from stickslip_schemas.documents.responses import CertificateEntry, Page

from stickslip_services.api.bodies import JsonBody, body_schema
from stickslip_services.api.files import serve
from stickslip_services.api.routes.common import BODY_PROBLEMS, ContextDep, PageDep, file_responses, problem_responses
from stickslip_services.catalog.certificates import find_certificate, list_certificates, register_certificate

router = APIRouter(tags=["certificates"])

_CERTIFICATE: dict[str, Any] = {"application/json": {"schema": {"$ref": "#/components/schemas/Certificate"}}}
_PAGE: dict[str, Any] = {"text/html": {"schema": {"type": "string"}}}

_INERT = {
    # The page is whatever was uploaded: it may show itself, and do nothing else.
    "Content-Security-Policy": "default-src 'none'; img-src data:; style-src 'unsafe-inline'; sandbox",
}


@router.post(
    "/v1/certificates",
    status_code=201,
    responses=problem_responses(*BODY_PROBLEMS),
    openapi_extra=body_schema("CertificateUpload"),
)
def post_certificate(
    upload: Annotated[CertificateUpload, Depends(JsonBody(CertificateUpload))],
    context: ContextDep,
    response: Response,
) -> CertificateEntry:
    """Register a certificate; it may be sent twice. The newest full certificate of a preset and build counts."""
    entry = register_certificate(context.database, context.store, upload, context.clock())
    response.headers["Location"] = entry.href
    return entry


@router.get("/v1/certificates", responses=problem_responses(422))
def get_certificates(page: PageDep, context: ContextDep) -> Page[CertificateEntry]:
    """List certificates, newest first."""
    with context.database.read() as connection:
        return list_certificates(connection, page)


@router.get("/v1/certificates/{digest}", response_class=Response, responses=file_responses(_CERTIFICATE))
def get_certificate(digest: str, request: Request, context: ContextDep) -> Response:
    """Return a certificate."""
    with context.database.read() as connection:
        artifact = find_certificate(connection, digest).artifact
    return serve(request, context.store, artifact, name="certificate.json")


@router.get("/v1/certificates/{digest}/page", response_class=Response, responses=file_responses(_PAGE))
def get_certificate_page(digest: str, request: Request, context: ContextDep) -> Response:
    """Return the page of a certificate."""
    with context.database.read() as connection:
        artifact = find_certificate(connection, digest).page
    response = serve(request, context.store, artifact, name="certificate.html")
    response.headers.update(_INERT)
    return response
