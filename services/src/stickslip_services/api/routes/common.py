"""What routes share: the coordinator, pages of lists, and what OpenAPI says of problems."""

from typing import Annotated, Any

from fastapi import Depends, Query, Request
from stickslip_schemas.problems import MEDIA_TYPE, FieldError, ProblemCode

from stickslip_services.api.problems import ProblemError
from stickslip_services.database.paging import MAX_PAGE_SIZE, PageRequest


def coordinator_of(request: Request) -> Any:
    """Return the application's coordinator; routes declare it as `Annotated[Coordinator, Depends(coordinator_of)]`."""
    return request.app.state.coordinator


def _page(
    page_size: Annotated[int, Query(ge=1, le=MAX_PAGE_SIZE, description="the most items to return")] = 50,
    page_token: Annotated[str | None, Query(max_length=64, description="`next_page_token` of the page before")] = None,
) -> PageRequest:
    try:
        return PageRequest.from_query(page_size, page_token)
    except ValueError as error:
        field = FieldError(pointer="/query/page_token", rule=str(error), value=(page_token or "")[:200])
        detail = f"{error}, and it is {field.value!r}"
        raise ProblemError(422, ProblemCode.validation_failed, detail, fields=[field]) from error


PageDep = Annotated[PageRequest, Depends(_page)]

_TITLES = {
    400: "The body is not JSON",
    401: "The key is missing or not known",
    403: "The key lacks the scope, or the request comes under a foreign name or from a page of another site",
    404: "There is no such thing",
    409: "It cannot be done in the state that the thing is in",
    413: "The body is too large",
    415: "The body is not declared to be JSON",
    416: "The range lies outside the file",
    422: "The request breaks a rule; `errors` says which, and where",
    500: "The coordinator has a fault",
    503: "The coordinator cannot answer now",
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
