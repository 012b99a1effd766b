"""What routes share: the coordinator, pages of lists, and what OpenAPI says of problems."""

from typing import Annotated, Any

from fastapi import Depends, Query, Request
from stickslip_schemas.documents.problems import MEDIA_TYPE

from stickslip_services.database.paging import MAX_PAGE_SIZE, TOKEN_PATTERN, PageRequest


def coordinator_of(request: Request) -> Any:
    """Return the application's coordinator; routes declare it as `Annotated[Coordinator, Depends(coordinator_of)]`."""
    return request.app.state.coordinator


def _page(
    page_size: Annotated[int, Query(ge=1, le=MAX_PAGE_SIZE, description="the most items to return")] = 50,
    page_token: Annotated[
        str | None, Query(pattern=TOKEN_PATTERN, description="`next_page_token` of the page before")
    ] = None,
) -> PageRequest:
    return PageRequest.from_query(page_size, page_token)


PageDep = Annotated[PageRequest, Depends(_page)]

_TITLES = {
    400: "The body is not JSON",
    401: "The key is missing or not known",
    403: "The key lacks the scope, or the request names a foreign host or comes from a page of another site",
    404: "Not found",
    409: "The state does not allow it; `detail` names the state",
    412: "The job has changed since the `ETag` in `If-Match`",
    413: "The body is too large",
    415: "The `Content-Type` of the body is not JSON",
    416: "The range lies outside the file",
    422: "The request breaks a rule; `errors` lists the fields, rules and values",
    429: "The project of the key has as much in flight as it may have; `errors` names the rule and the value",
    500: "The coordinator failed; its log says more",
    503: "The coordinator is busy or cannot reach its database; try again later",
}

BODY_PROBLEMS = (400, 413, 415, 422)

KEYED: dict[str, Any] = {"security": [{"key": []}]}
"""What OpenAPI says of a route that needs a key, also on loopback."""


def problem_responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return what OpenAPI says of the problems that a route may answer with."""
    schema = {"$ref": "#/components/schemas/Problem"}
    return {
        status: {"description": _TITLES[status], "content": {MEDIA_TYPE: {"schema": schema}}}
        for status in sorted({*statuses, 401, 403, 500, 503})
    }
