"""Shared by the routes of pages: the coordinator, and HTML with its security headers."""

from typing import Annotated, Any

from fastapi import Depends, Response

from stickslip_services.api.routes.common import coordinator_of
from stickslip_services.pages.rendering import render
from stickslip_services.queue.coordinator import Coordinator

CoordinatorDep = Annotated[Coordinator, Depends(coordinator_of)]

_POLICY = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def html_page(template: str, **context: Any) -> Response:
    """Return a rendered template as a response; everything that it loads comes from this server."""
    return Response(render(template, **context), media_type="text/html", headers=_POLICY)
