"""Routes of certificates: register, list and return them."""

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request, Response
from stickslip_schemas.documents.certificate import Certificate
from stickslip_schemas.documents.responses import CertificateEntry, Page

from stickslip_services.api.bodies import JsonBody, body_schema
from stickslip_services.api.files import serve
from stickslip_services.api.routes.common import BODY_PROBLEMS, ContextDep, PageDep, file_responses, problem_responses
from stickslip_services.catalog.certificates import find_certificate, list_certificates, register_certificate

router = APIRouter(tags=["certificates"])

_CERTIFICATE: dict[str, Any] = {"application/json": {"schema": {"$ref": "#/components/schemas/Certificate"}}}


@router.post(
    "/v1/certificates",
    status_code=201,
    responses=problem_responses(*BODY_PROBLEMS),
    openapi_extra=body_schema("Certificate"),
)
def post_certificate(
    certificate: Annotated[Certificate, Depends(JsonBody(Certificate))], context: ContextDep, response: Response
) -> CertificateEntry:
    """Register a certificate; it may be sent twice. The newest full certificate of a preset and build counts."""
    entry = register_certificate(context.database, context.store, certificate, context.clock())
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
