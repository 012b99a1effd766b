"""Shared by routes: the context, pages of lists, known query parameters, and OpenAPI attributes."""

from collections.abc import Callable, Coroutine
from typing import Annotated, Any

from fastapi import Depends, Path, Query, Request, Response
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute
from stickslip_schemas.documents.problems import MEDIA_TYPE
from stickslip_schemas.spec.names import did_you_mean

from stickslip_services.api.problems import unfit_parameter
from stickslip_services.database.database import MAX_PAGE_SIZE, TOKEN_PATTERN, PageRequest
from stickslip_services.queue.context import Context

Handler = Callable[[Request], Coroutine[Any, Any, Response]]


class StrictRoute(APIRoute):
    """A route that refuses query parameters that it does not know.

    A misspelt filter would otherwise return everything.
    """

    def get_route_handler(self) -> Handler:
        """Return the handler of the route behind the check of its query."""
        known = _query_names(self.dependant)
        handler = self.plain_handler()

        async def handle(request: Request) -> Response:
            check_query(request, known)
            return await handler(request)

        return handle

    def plain_handler(self) -> Handler:
        """Return the handler without the check."""
        return super().get_route_handler()


def _query_names(dependant: Dependant) -> set[str]:
    """Return the query parameters of a function and of its dependencies."""
    names = {field.alias for field in dependant.query_params}
    return names.union(*map(_query_names, dependant.dependencies))


def check_query(request: Request, known: set[str]) -> None:
    """Raise ProblemError for a query parameter that is unknown, or given twice."""
    names = [name for name, _ in request.query_params.multi_items()]
    for name in names:
        pointer = f"/query/{name[:100]}"
        value = request.query_params[name]
        if name not in known:
            hint = did_you_mean(name, sorted(known)) or "."
            listed = ", ".join(sorted(known)) or "none"
            rule = f"there is no such query parameter{hint} Parameters: {listed}"
            raise unfit_parameter(pointer, name[:100], rule, value)
        if names.count(name) > 1:
            raise unfit_parameter(pointer, name, "must be given once", value)


def _context(request: Request) -> Context:
    context: Context = request.app.state.context
    return context


ContextDep = Annotated[Context, Depends(_context)]


def _page(
    page_size: Annotated[
        int, Query(ge=1, le=MAX_PAGE_SIZE, description="the most items to return")
    ] = 50,
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
    403: (
        "The key lacks the scope, or the request names a foreign host or comes from a page of "
        "another site"
    ),
    404: "Not found",
    409: "The state does not allow it; `detail` names the state",
    413: "The body is too large",
    415: "The `Content-Type` of the body is not JSON",
    416: "The range lies outside the file",
    422: "The request breaks a rule; `errors` lists the fields, rules and values",
    429: (
        "The project of the key has as much in flight as it may have, or the key or the address as "
        "many streams"
    ),
    500: "The coordinator failed; its log says more",
    503: "The coordinator is busy or cannot reach its database; try again later",
}

BODY_PROBLEMS = (400, 413, 415)
"""Problems of every route that reads a body."""

_COMMON_PROBLEMS = (401, 403, 422, 500, 503)
"""Problems of every route: of keys, of the query, and of the coordinator."""

Responses = dict[int | str, dict[str, Any]]


def problem_responses(*statuses: int) -> Responses:
    """Return the OpenAPI responses of the problems that a route may answer with."""
    schema = {"$ref": "#/components/schemas/Problem"}
    return {
        status: {"description": _TITLES[status], "content": {MEDIA_TYPE: {"schema": schema}}}
        for status in sorted({*statuses, *_COMMON_PROBLEMS})
    }


def json_content(name: str) -> dict[str, Any]:
    """Return the OpenAPI content of the JSON document `name`."""
    return {"application/json": {"schema": {"$ref": f"#/components/schemas/{name}"}}}


def reads(name: str, *problems: int, answers: Responses | None = None) -> dict[str, Any]:
    """Return the OpenAPI attributes of a route that reads the document `name`."""
    body = {"requestBody": {"required": True, "content": json_content(name)}}
    return {
        "responses": (answers or {}) | problem_responses(*problems, *BODY_PROBLEMS),
        "openapi_extra": body,
    }


_FILE_HEADERS = {
    name: {"description": description, "schema": {"type": "string"}}
    for name, description in {
        "ETag": "The SHA-256 of the whole file, quoted",
        "Repr-Digest": "The SHA-256 of the whole file [RFC 9530]",
        "Accept-Ranges": "bytes",
        "Cache-Control": "The file never changes",
    }.items()
}


def serves(content: dict[str, Any], *problems: int) -> dict[str, Any]:
    """Return the OpenAPI attributes of a route that serves an artifact."""
    whole = {"description": "The file", "headers": _FILE_HEADERS, "content": content}
    part = whole | {"description": "The range that was asked for"}
    unchanged = {"description": "The client has it already", "headers": _FILE_HEADERS}
    responses: Responses = {200: whole, 206: part, 304: unchanged}
    return {
        "response_class": Response,
        "responses": responses | problem_responses(404, 416, *problems),
    }
