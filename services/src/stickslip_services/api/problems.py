"""Errors as problem documents [RFC 9457], mapped by one table."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from sqlalchemy.exc import OperationalError
from starlette.exceptions import HTTPException
from starlette.routing import Match, Route
from starlette.types import Receive, Scope, Send
from stickslip_schemas.documents.problems import MEDIA_TYPE, FieldError, Problem, ProblemCode
from stickslip_schemas.format.manifest import BrokenSectionError

from stickslip_services import errors
from stickslip_services.pages.rendering import html_page

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
    errors.DamagedRowsError: (500, ProblemCode.storage_error),
}


@dataclass(eq=False)
class ProblemError(Exception):
    """A problem: raised, or sent as it is by middleware."""

    status: int
    code: ProblemCode
    detail: str
    fields: Sequence[FieldError] = ()
    headers: Mapping[str, str] | None = None

    @property
    def title(self) -> str:
        return self.code.replace("_", " ").capitalize()

    def document(self, path: str | None = None, request_id: str | None = None) -> Problem:
        return Problem(
            type=f"urn:stickslip:problem:{self.code}",
            title=self.title,
            status=self.status,
            detail=self.detail,
            code=self.code,
            instance=path,
            request_id=request_id,
            errors=list(self.fields),
        )

    def response(self, path: str, request_id: str | None) -> Response:
        # The request may contain text without a UTF-8 form; the answer must be valid UTF-8.
        content = self.document(path, request_id).model_dump_json(ensure_ascii=True)
        # The answer to an unexpected error passes no middleware, which would add these.
        headers = {"Cache-Control": "no-store", "Vary": "Authorization", **(self.headers or {})}
        return Response(content, self.status, headers, MEDIA_TYPE)

    async def answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        await self.response(scope["path"], scope.get("state", {}).get("request_id"))(
            scope, receive, send
        )


def install(app: FastAPI) -> None:
    known = (
        ProblemError,
        errors.StickslipError,
        RequestValidationError,
        HTTPException,
        OperationalError,
    )
    for sort in (*known, OSError, BrokenSectionError, Exception):
        app.add_exception_handler(sort, _answer)


def _answer(request: Request, error: Exception) -> Response:
    problem = _problem_of(request, error)
    request_id = getattr(request.state, "request_id", None)
    if "text/html" in request.headers.get("accept", "") and not request.url.path.startswith("/v1/"):
        shown = {"title": problem.title, "detail": problem.detail, "request_id": request_id}
        return html_page("error.html", problem.status, here="", **shown)
    return problem.response(request.url.path, request_id)


def _problem_of(request: Request, error: Exception) -> ProblemError:
    path = request.url.path
    match error:
        case ProblemError():
            return error
        case errors.StickslipError():
            status, code = _STATUS[type(error)]
            if status >= 500:
                logger.error("%s %s: %s", request.method, path, error)
            return ProblemError(status, code, str(error), error.fields)
        # parameters of path, query and header; `JsonBody` reads bodies
        case RequestValidationError():
            fields = [
                FieldError(
                    pointer="".join(f"/{part}" for part in item["loc"]),
                    rule=item["msg"],
                    value=str(item.get("input", ""))[:200],
                )
                for item in error.errors()
            ]
            detail = "; ".join(f"{field.pointer[1:]}: {field.rule}" for field in fields)
            return ProblemError(422, ProblemCode.validation_failed, detail, fields)
        case HTTPException(status_code=404):
            return ProblemError(
                404, ProblemCode.not_found, f"there is nothing at {path}", headers=error.headers
            )
        case HTTPException(status_code=405):
            allowed = _allowed_methods(request)
            detail = f"{path} answers {allowed}, and not {request.method}"
            return ProblemError(
                405, ProblemCode.method_not_allowed, detail, headers={"Allow": allowed}
            )
        case HTTPException():
            code = (
                ProblemCode.body_too_large
                if error.status_code == 413
                else ProblemCode.malformed_body
            )
            return ProblemError(error.status_code, code, error.detail, headers=error.headers)
        case OperationalError():
            logger.error("%s %s: %s", request.method, path, error)
            if any(words in str(error) for words in ("locked", "busy", "lock timeout")):
                return ProblemError(
                    503,
                    ProblemCode.busy,
                    "the database is busy; try again",
                    headers={"Retry-After": "1"},
                )
            detail = (
                "the coordinator cannot use its database (is the disk full?); its log says more"
            )
            return ProblemError(
                503, ProblemCode.storage_error, detail, headers={"Retry-After": "10"}
            )
    logger.error("%s %s failed", request.method, path, exc_info=error)
    if isinstance(error, OSError | BrokenSectionError):
        detail = "a file is missing or damaged in the store, or the store is out of reach; the log says more"
        return ProblemError(500, ProblemCode.storage_error, detail)
    return ProblemError(
        500, ProblemCode.internal_error, "the coordinator has a fault; its log says more"
    )


def _allowed_methods(request: Request) -> str:
    """Return the methods of a resource: those of the routes with the longest matching template."""
    fitting = [
        route
        for route in request.app.state.routes
        if isinstance(route, Route) and route.matches(request.scope)[0] is not Match.NONE
    ]
    longest = max((len(route.path) for route in fitting), default=0)
    methods = {
        method for route in fitting if len(route.path) == longest for method in route.methods or ()
    }
    return ", ".join(sorted(methods))
