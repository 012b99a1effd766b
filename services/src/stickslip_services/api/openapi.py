"""The OpenAPI document."""

import re
from collections.abc import Iterator
from typing import Any, Literal

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import TypeAdapter
from stickslip_schemas.documents.certificate import Certificate
from stickslip_schemas.documents.problems import Problem
from stickslip_schemas.documents.responses import JobPatch
from stickslip_schemas.documents.tasks import task_adapter
from stickslip_schemas.documents.worker_api import (
    Heartbeat,
    LeaseRequest,
    ReportBatch,
    WorkerRegistration,
)
from stickslip_schemas.format.manifest import Manifest
from stickslip_schemas.kinds import job_spec_adapter

from stickslip_services.access.principals import Scope
from stickslip_services.api.middleware import needed_scope

_MODELS = (
    WorkerRegistration,
    LeaseRequest,
    Heartbeat,
    ReportBatch,
    Certificate,
    JobPatch,
    Manifest,
    Problem,
)
_DOCUMENTS: dict[str, TypeAdapter[Any]] = {model.__name__: TypeAdapter(model) for model in _MODELS}
_DOCUMENTS |= {"JobSpec": job_spec_adapter, "Task": task_adapter}
_TAGS = {
    "previews": "jobs",
    "textures": "uploads",
    "files": "uploads",
    "worker": "workers",
    "": "health",
}
"""Tags of paths whose first word is another."""


def describe(app: FastAPI) -> dict[str, Any]:
    """Return the OpenAPI document of `app`, with the documents of requests."""
    if not app.openapi_schema:
        document = get_openapi(
            title=app.title, version=app.version, description=app.description, routes=app.routes
        )
        components = document.setdefault("components", {}).setdefault("schemas", {})
        document["components"]["securitySchemes"] = {
            "key": {
                "type": "http",
                "scheme": "bearer",
                "description": "an API key, as `stickslip keys create` makes it",
            }
        }
        # Requests allow more forms than answers (short forms of axes), so their schema holds for
        # both.
        components.update(_body_components())
        # A tag is the first word of a path, by which readers of the document find an operation.
        for path, methods in document["paths"].items():
            for method, operation in methods.items():
                operation["tags"] = [
                    _TAGS.get(word := re.split(r"[/:]", path.removeprefix("/v1/"))[0], word)
                ]
                if needed_scope(method.upper(), path) is Scope.work:
                    operation["security"] = [{"key": []}]
                _tidy(operation)
        _name_by_title(document)
        _require_tags(document)
        for unused in (
            "HTTPValidationError",
            "ValidationError",
        ):  # FastAPI's own; we answer with problems
            components.pop(unused, None)
        app.openapi_schema = document
    return app.openapi_schema


def _tidy(operation: dict[str, Any]) -> None:
    """Drop FastAPI's 422 answer where no parameter can be invalid.

    Make a summary; remove null from parameters.
    """
    # Our own 422 is a problem document; FastAPI adds another where it could refuse a parameter.
    content = operation["responses"].get("422", {}).get("content", {})
    if content.get("application/json", {}).get("schema") == {
        "$ref": "#/components/schemas/HTTPValidationError"
    }:
        del operation["responses"]["422"]
    if "description" in operation:  # its first sentence
        sentence = re.split(r"(?<=[.;:]) |\n", operation["description"], maxsplit=1)[0]
        operation["summary"] = sentence.rstrip(".;:")
    # An optional parameter is omitted, and never null.
    for parameter in operation.get("parameters", ()):
        for kind in parameter["schema"].pop("anyOf", ()):
            parameter["schema"] |= {} if kind == {"type": "null"} else kind


def _objects(node: object) -> Iterator[dict[str, Any]]:
    """Yield all objects of a JSON document."""
    if isinstance(node, dict):
        yield node
        for value in node.values():
            yield from _objects(value)
    elif isinstance(node, list):
        for value in node:
            yield from _objects(value)


def _require_tags(document: dict[str, Any]) -> None:
    """Make the discriminator of a union required, even if it has a default."""
    for node in _objects(document):
        discriminator = node.get("discriminator")
        if isinstance(discriminator, dict) and "mapping" in discriminator:
            for reference in discriminator["mapping"].values():
                member = document["components"]["schemas"][reference.rpartition("/")[2]]
                member["required"] = sorted(
                    {*member.get("required", ()), discriminator["propertyName"]}
                )


def _name_by_title(document: dict[str, Any]) -> None:
    """Rename components whose names pydantic has derived from type parameters to their titles.

    For example `ListAxisMu`.
    """
    components = document["components"]["schemas"]
    # A title that is taken stays a derived name.
    for name in list(components):
        title = components[name].get("title", name)
        if title != name and title.isidentifier() and title not in components:
            components[title] = components.pop(name)
            for node in _objects(document):
                for key, value in node.items():
                    if value == f"#/components/schemas/{name}":
                        node[key] = f"#/components/schemas/{title}"


def _body_components() -> dict[str, Any]:
    """Return the OpenAPI components of request documents by name."""
    adapters: list[tuple[str, Literal["validation"], TypeAdapter[Any]]] = [
        (name, "validation", adapter) for name, adapter in _DOCUMENTS.items()
    ]
    template = "#/components/schemas/{model}"
    schemas, shared = TypeAdapter.json_schemas(adapters, ref_template=template)
    components: dict[str, Any] = dict(shared.get("$defs", {}))
    for (name, _), schema in schemas.items():
        if schema != {"$ref": f"#/components/schemas/{name}"}:
            components[str(name)] = schema
    return components
