"""Shared by routes: the context, pages of lists, and the OpenAPI responses of files and problems."""

from typing import Annotated, Any

from fastapi import Depends, Path, Query, Request
from stickslip_schemas.documents.problems import MEDIA_TYPE

from stickslip_services.api.files import OPENAPI_HEADERS
from stickslip_services.database.paging import MAX_PAGE_SIZE, TOKEN_PATTERN, PageRequest
from stickslip_services.queue.context import Context


def _context(request: Request) -> Context:
    context: Context = request.app.state.context
    return context


ContextDep = Annotated[Context, Depends(_context)]


def _page(
    page_size: Annotated[int, Query(ge=1, le=MAX_PAGE_SIZE, description="the most items to return")] = 50,
    page_token: Annotated[
        str | None, Query(pattern=TOKEN_PATTERN, description="`next_page_token` of the page before")
    ] = None,
) -> PageRequest:
    return PageRequest(page_size, None if page_token is None else int(page_token))


PageDep = Annotated[PageRequest, Depends(_page)]
Version = Annotated[int, Path(ge=1, lt=2**31)]

_TITLES = {
    400: "The body is not JSON",
    401: "The key is missing or not known",
    403: "The key lacks the scope, or the request names a foreign host or comes from a page of another site",
    404: "Not found",
    409: "The state does not allow it; `detail` names the state",
    413: "The body is too large",
    415: "The `Content-Type` of the body is not JSON",
    416: "The range lies outside the file",
    422: "The request breaks a rule; `errors` lists the fields, rules and values",
    429: "The project of the key has as much in flight as it may have, or the key or the address as many streams",
    500: "The coordinator failed; its log says more",
    503: "The coordinator is busy or cannot reach its database; try again later",
}

BODY_PROBLEMS = (400, 413, 415, 422)

KEYED: dict[str, Any] = {"security": [{"key": []}]}
"""OpenAPI attributes of a route that needs a key, also on loopback."""


def problem_responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI responses of the problems that a route may answer with."""
    schema = {"$ref": "#/components/schemas/Problem"}
    return {
        status: {"description": _TITLES[status], "content": {MEDIA_TYPE: {"schema": schema}}}
        for status in sorted({*statuses, 401, 403, 500, 503})
    }


def file_responses(content: dict[str, Any], *problems: int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI responses of a route that serves an artifact."""
    return {
        200: {"description": "The file", "headers": OPENAPI_HEADERS, "content": content},
        206: {"description": "The range that was asked for", "headers": OPENAPI_HEADERS, "content": content},
        304: {"description": "The client has it already", "headers": OPENAPI_HEADERS},
        **problem_responses(404, 416, *problems),
    }
