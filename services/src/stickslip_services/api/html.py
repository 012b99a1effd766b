"""HTML as a response, with its security headers."""

from typing import Any

from fastapi import Response

from stickslip_services.pages.rendering import render

_POLICY = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def html_page(template: str, status: int = 200, **values: Any) -> Response:
    """Return a rendered template as a response; everything that it loads comes from this server."""
    return Response(render(template, **values), status, media_type="text/html", headers=_POLICY)
