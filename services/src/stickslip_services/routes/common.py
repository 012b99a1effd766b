"""What routes share: the coordinator, pages, and what OpenAPI says of problems."""

from typing import Annotated, Any

from fastapi import Depends, Query, Request
from stickslip_schemas.problems import MEDIA_TYPE

from stickslip_services.operations import Coordinator
from stickslip_services.paging import MAX_PAGE_SIZE, PageRequest


def _coordinator(request: Request) -> Coordinator:
    coordinator: Coordinator = request.app.state.coordinator
    return coordinator


def _page(
    page_size: Annotated[int, Query(ge=1, le=MAX_PAGE_SIZE, description="the most items to return")] = 50,
    page_token: Annotated[str | None, Query(max_length=64, description="`next_page_token` of the page before")] = None,
) -> PageRequest:
    return PageRequest.from_query(page_size, page_token)


CoordinatorDep = Annotated[Coordinator, Depends(_coordinator)]
PageDep = Annotated[PageRequest, Depends(_page)]

_TITLES = {
    400: "The body is not JSON",
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


def problem_responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return what OpenAPI says of the problems that a route may answer with."""
    schema = {"$ref": "#/components/schemas/Problem"}
    return {
        status: {"description": _TITLES[status], "content": {MEDIA_TYPE: {"schema": schema}}}
        for status in sorted({*statuses, 500, 503})
    }
