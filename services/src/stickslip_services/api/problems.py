"""Errors as problem documents [RFC 9457], mapped by one table."""

import logging
from collections.abc import Mapping
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from sqlalchemy.exc import OperationalError
from starlette.exceptions import HTTPException
from starlette.routing import Match, Route
from stickslip_schemas.documents.problems import MEDIA_TYPE, FieldError, Problem, ProblemCode

from stickslip_services import errors
from stickslip_services.api.html import html_page

logger = logging.getLogger(__name__)

_STATUS: dict[type[errors.StickslipError], tuple[int, ProblemCode]] = {
    errors.NotFoundError: (404, ProblemCode.not_found),
    errors.UnknownWorkerError: (404, ProblemCode.unknown_worker),
    errors.ConflictError: (409, ProblemCode.conflict),
    errors.QuotaExceededError: (429, ProblemCode.quota_exceeded),
    errors.IdempotencyKeyReusedError: (422, ProblemCode.idempotency_key_reused),
    errors.KindNotAvailableError: (409, ProblemCode.kind_not_available),
    errors.PresetNotCertifiedError: (409, ProblemCode.preset_not_certified),
    errors.UnknownFileError: (422, ProblemCode.validation_failed),
    errors.MissingArtifactError: (500, ProblemCode.storage_error),
    errors.DamagedRowsError: (500, ProblemCode.storage_error),
}

_HTTP_CODES = {404: ProblemCode.not_found, 405: ProblemCode.method_not_allowed, 413: ProblemCode.body_too_large}


class ProblemError(Exception):
    """Carries a problem document to the response."""

    def __init__(
        self,
        status: int,
        code: ProblemCode,
        detail: str,
        *,
        fields: list[FieldError] | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.code = code
        self.detail = detail
        self.fields = fields or []
        self.headers = dict(headers or {})


def problem_document(
    status: int,
    code: ProblemCode,
    detail: str,
    *,
    path: str | None = None,
    request_id: str | None = None,
    fields: list[FieldError] | None = None,
) -> Problem:
    """Return a problem document; its type and title follow from the code."""
    return Problem(
        type=f"urn:stickslip:problem:{code}",
        title=code.replace("_", " ").capitalize(),
        status=status,
        detail=detail,
        code=code,
        instance=path,
        request_id=request_id,
        errors=fields or [],
    )


def problem_response(
    status: int,
    code: ProblemCode,
    detail: str,
    *,
    path: str,
    request_id: str | None,
    fields: list[FieldError] | None = None,
    headers: Mapping[str, str] | None = None,
) -> Response:
    problem = problem_document(status, code, detail, path=path, request_id=request_id, fields=fields)
    # The request may contain text without a UTF-8 form; the answer must be valid UTF-8.
    content = problem.model_dump_json(ensure_ascii=True)
    return Response(content, status, dict(headers or {}), MEDIA_TYPE)


def install(app: FastAPI) -> None:
    """Make `app` answer every error with a problem document."""
    app.add_exception_handler(ProblemError, _problem)
    app.add_exception_handler(errors.StickslipError, _stickslip_error)
    app.add_exception_handler(RequestValidationError, _invalid_parameters)
    app.add_exception_handler(HTTPException, _http_error)
    app.add_exception_handler(OperationalError, _database_error)
    app.add_exception_handler(Exception, _unexpected)


def _answer(request: Request, status: int, code: ProblemCode, detail: str, **rest: Any) -> Response:
    request_id = getattr(request.state, "request_id", None)
    if "text/html" in request.headers.get("accept", "") and not request.url.path.startswith("/v1/"):
        title = code.replace("_", " ").capitalize()
        return html_page("error.html", status, title=title, detail=detail, request_id=request_id, here="")
    return problem_response(status, code, detail, path=request.url.path, request_id=request_id, **rest)


def _problem(request: Request, error: Exception) -> Response:
    assert isinstance(error, ProblemError)
    return _answer(request, error.status, error.code, error.detail, fields=error.fields, headers=error.headers)


def _stickslip_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, errors.StickslipError)
    status, code = _STATUS[type(error)]
    if status >= 500:
        logger.error("%s %s: %s", request.method, request.url.path, error)
    return _answer(request, status, code, str(error), fields=list(error.fields))


def _invalid_parameters(request: Request, error: Exception) -> Response:
    """Parameters of path, query and header; bodies are read in bodies.py."""
    assert isinstance(error, RequestValidationError)
    fields = [
        FieldError(
            pointer="".join(f"/{part}" for part in item["loc"]),
            rule=item["msg"],
            value=str(item.get("input", ""))[:200],
        )
        for item in error.errors()
    ]
    detail = "; ".join(f"{field.pointer[1:]}: {field.rule}" for field in fields)
    return _answer(request, 422, ProblemCode.validation_failed, detail, fields=fields)


def _http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    code = _HTTP_CODES.get(error.status_code, ProblemCode.malformed_body)
    detail = error.detail
    if error.status_code == 404:
        detail = f"there is nothing at {request.url.path}"
    elif error.status_code == 405:
        allowed = _allowed_methods(request)
        detail = f"{request.url.path} answers {allowed}, and not {request.method}"
        return _answer(request, 405, code, detail, headers={"Allow": allowed})
    return _answer(request, error.status_code, code, detail, headers=error.headers)


def _allowed_methods(request: Request) -> str:
    """Return the methods of a resource: those of the routes with the longest matching template."""
    fitting = [
        route
        for route in request.app.state.routes
        if isinstance(route, Route) and route.matches(request.scope)[0] is not Match.NONE
    ]
    longest = max((len(route.path) for route in fitting), default=0)
    methods = {method for route in fitting if len(route.path) == longest for method in route.methods or ()}
    return ", ".join(sorted(methods))


def _database_error(request: Request, error: Exception) -> Response:
    logger.error("%s %s: %s", request.method, request.url.path, error)
    if any(words in str(error) for words in ("locked", "busy", "lock timeout")):
        headers = {"Retry-After": "1"}
        return _answer(request, 503, ProblemCode.busy, "the database is busy; try again", headers=headers)
    detail = "the coordinator cannot use its database (is the disk full?); its log says more"
    return _answer(request, 503, ProblemCode.storage_error, detail, headers={"Retry-After": "10"})


def _unexpected(request: Request, error: Exception) -> Response:
    logger.error("%s %s failed", request.method, request.url.path, exc_info=error)
    return _answer(request, 500, ProblemCode.internal_error, "the coordinator has a fault; its log says more")
