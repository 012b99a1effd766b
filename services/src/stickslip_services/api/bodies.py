"""Request bodies: strictly parsed JSON documents, refused with pointers to the wrong fields."""

import json
from collections import Counter
from contextlib import suppress
from math import isfinite
from typing import Any, Generic, TypeVar

from fastapi import Request
from pydantic import BaseModel, TypeAdapter, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect
from stickslip_schemas.documents.problems import ProblemCode, field_errors

from stickslip_services.api.problems import ProblemError

T = TypeVar("T")

SHOWN_ERRORS = 20


class JsonBody(Generic[T]):
    """A dependency that reads a request's body as a document."""

    def __init__(self, of: Any, *, from_workers: bool = False) -> None:
        """Read documents of a type: a model or a union of models. Those of workers are mostly written by pydantic."""
        self._of = of
        self._from_workers = from_workers
        self._adapter: TypeAdapter[T] = TypeAdapter(of)

    async def __call__(self, request: Request) -> T:
        body = await self.received(request)
        # A body of many megabytes keeps a thread busy, and not the event loop.
        document: T = await run_in_threadpool(self.read, body)
        return document

    async def received(self, request: Request) -> bytes:
        """Return the raw body; raise ProblemError where its Content-Type is not JSON."""
        media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
        if media_type != "application/json" and not media_type.endswith("+json"):
            detail = f"Content-Type must be application/json, and it is {media_type[:100]!r}"
            raise ProblemError(415, ProblemCode.malformed_body, detail)
        return await whole_body(request)

    def read(self, body: bytes) -> T:
        """Return the document in a body, JSON [RFC 8259] in UTF-8 without duplicate keys; raise ProblemError."""
        if self._from_workers:
            with suppress(ValidationError):
                document = self._adapter.validate_json(body)
                if self._adapter.dump_json(document) == body:  # so no key is there twice
                    return document
        strange: list[str] = []

        def number(text: str) -> float:
            value = float(text)
            if not isfinite(value):
                strange.append(text)
            return value

        try:
            text = body.decode("utf-8")
            values = json.loads(text, object_pairs_hook=_no_key_twice, parse_float=number, parse_constant=number)
            if "\\u" in text:
                json.dumps(values, ensure_ascii=False).encode("utf-8")  # lone surrogates have no UTF-8 form
            valid = self._adapter.validate_python(values)
            if strange:  # models refuse NaN with its place; this covers free-form parts
                raise ValueError(f"{strange[0]} is no number")
            return valid
        except ValidationError as error:
            fields = field_errors(error, values, self._of, at_most=SHOWN_ERRORS)
            count = error.error_count()
        except RecursionError as error:
            raise ProblemError(400, ProblemCode.malformed_body, "the document is nested too deeply") from error
        except ValueError as error:  # also bytes that are not UTF-8, and integers of more than 4300 digits
            raise ProblemError(400, ProblemCode.malformed_body, f"the body is not JSON: {error}"[:500]) from error
        detail = "; ".join(f"{field.pointer or 'the document'}: {field.rule}" for field in fields[:3])
        more = f" (and {count - 3} more)" if count > 3 else ""
        raise ProblemError(422, ProblemCode.validation_failed, detail + more, fields=fields)


async def whole_body(request: Request) -> bytes:
    """Return the raw body; raise ProblemError where it ends too soon."""
    try:
        return await request.body()
    except ClientDisconnect as error:
        raise ProblemError(400, ProblemCode.malformed_body, "the body ends too soon") from error


def _no_key_twice(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    document = dict(pairs)
    if len(document) != len(pairs):
        twice = next(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
        raise ValueError(f"the key {twice[:100]!r} is there twice")
    return document


def body_schema(name: str) -> dict[str, Any]:
    """Return the OpenAPI attributes of a route that reads the document `name`."""
    reference = {"$ref": f"#/components/schemas/{name}"}
    return {"requestBody": {"required": True, "content": {"application/json": {"schema": reference}}}}


def body_components(models: dict[str, TypeAdapter[Any] | type[BaseModel]]) -> dict[str, Any]:
    """Return the OpenAPI components of request documents by name."""
    adapters = [
        (name, "validation", model if isinstance(model, TypeAdapter) else TypeAdapter(model))
        for name, model in models.items()
    ]
    schemas, shared = TypeAdapter.json_schemas(adapters, ref_template="#/components/schemas/{model}")  # type: ignore[arg-type]
    components: dict[str, Any] = dict(shared.get("$defs", {}))
    for (name, _), schema in schemas.items():
        if schema != {"$ref": f"#/components/schemas/{name}"}:
            components[str(name)] = schema
    return components
