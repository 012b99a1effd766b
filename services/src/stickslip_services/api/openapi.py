"""The OpenAPI document."""

from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel, TypeAdapter
from stickslip_schemas.certificate import CertificateUpload
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.manifest import Manifest
from stickslip_schemas.problems import Problem
from stickslip_schemas.responses import JobPatch
from stickslip_schemas.tasks import task_adapter
from stickslip_schemas.worker_api import Heartbeat, LeaseRequest, ReportBatch, WorkerRegistration

from stickslip_services.api.bodies import body_components

_DOCUMENTS: dict[str, TypeAdapter[Any] | type[BaseModel]] = {
    "JobSpec": job_spec_adapter,
    "Task": task_adapter,
    "WorkerRegistration": WorkerRegistration,
    "LeaseRequest": LeaseRequest,
    "Heartbeat": Heartbeat,
    "ReportBatch": ReportBatch,
    "CertificateUpload": CertificateUpload,
    "JobPatch": JobPatch,
    "Manifest": Manifest,
    "Problem": Problem,
}


def describe(app: FastAPI) -> dict[str, Any]:
    """Return the OpenAPI document of `app`, with the documents that bodies.py reads instead of FastAPI."""
    if not app.openapi_schema:
        document = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        components = document.setdefault("components", {}).setdefault("schemas", {})
        document["components"]["securitySchemes"] = {
            "key": {
                "type": "http",
                "scheme": "bearer",
                "description": "an API key, as `stickslip keys create` makes it",
            }
        }
        for name, schema in body_components(_DOCUMENTS).items():
            components.setdefault(name, schema)
        _drop_foreign_errors(document)
        for unused in ("HTTPValidationError", "ValidationError"):  # FastAPI's own; we answer with problems
            components.pop(unused, None)
        app.openapi_schema = document
    return app.openapi_schema


def _drop_foreign_errors(document: dict[str, Any]) -> None:
    """Drop what FastAPI says of invalid parameters where the route does not: there they cannot be invalid."""
    foreign = {"$ref": "#/components/schemas/HTTPValidationError"}
    for methods in document["paths"].values():
        for operation in methods.values():
            content = operation["responses"].get("422", {}).get("content", {})
            if content.get("application/json", {}).get("schema") == foreign:
                del operation["responses"]["422"]
