"""Errors as problem documents [RFC 9457]: a function for each kind of error, in one table."""

import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic_core import ErrorDetails
from sqlalchemy.exc import OperationalError
from starlette.exceptions import HTTPException
from starlette.routing import Match, Route
from starlette.types import Receive, Scope, Send
from stickslip_schemas.documents.problems import MEDIA_TYPE, FieldError, Problem, ProblemCode
from stickslip_schemas.format.manifest import BrokenSectionError

from stickslip_services import errors
from stickslip_services.database.database import TOKEN_PATTERN
from stickslip_services.pages.rendering import html_page

logger = logging.getLogger(__name__)

EVENT_ID_PATTERN = r"^[0-9]{0,18}$"

SHOWN_VALUE = 200
"""Characters of a wrong value in an answer."""

_STATUS: dict[type[errors.StickslipError], tuple[int, ProblemCode]] = {
    errors.NotFoundError: (404, ProblemCode.not_found),
    errors.UnknownWorkerError: (404, ProblemCode.unknown_worker),
    errors.ConflictError: (409, ProblemCode.conflict),
    errors.QuotaExceededError: (429, ProblemCode.quota_exceeded),
    errors.IdempotencyKeyReusedError: (422, ProblemCode.idempotency_key_reused),
    errors.KindNotAvailableError: (409, ProblemCode.kind_not_available),
    errors.PresetNotCertifiedError: (409, ProblemCode.preset_not_certified),
    errors.UnknownFileError: (422, ProblemCode.validation_failed),
    errors.DamagedRowError: (500, ProblemCode.storage_error),
}

_RULES = {
    "missing": "is required",
    "int_parsing": "must be a whole number",
    "int_parsing_size": "must be a whole number of fewer digits",
    "float_parsing": "must be a number",
    "bool_parsing": "must be true or false",
    "greater_than": "must be more than {gt}",
    "greater_than_equal": "must be at least {ge}",
    "less_than": "must be less than {lt}",
    "less_than_equal": "must be at most {le}",
    "string_too_short": "must have at least {min_length} character(s)",
    "string_too_long": "must have at most {max_length} characters",
}
"""Rules of parameters in words, by pydantic's type of the error; `{...}` is of its context."""

_FORMS = {
    TOKEN_PATTERN: "must be the `next_page_token` of the page before",
    EVENT_ID_PATTERN: "must be the id of an event, a whole number of at most 18 digits",
}
"""Rules of parameters in words, by their regular expression."""


SHOWN_DETAIL = 4000
"""Longest detail of an answer [characters]: it may repeat a name of the request."""


@dataclass(eq=False)
class ProblemError(Exception):
    """A problem: raised by a route, or sent as it is by middleware."""

    status: int
    code: ProblemCode
    detail: str
    fields: Sequence[FieldError] = ()
    headers: Mapping[str, str] | None = None

    @property
    def title(self) -> str:
        """The code in words."""
        return self.code.replace("_", " ").capitalize()

    def document(self, path: str | None = None, request_id: str | None = None) -> Problem:
        """Return the problem document that answers a request."""
        return Problem(
            type=f"urn:stickslip:problem:{self.code}",
            title=self.title,
            status=self.status,
            detail=self.detail[:SHOWN_DETAIL],
            code=self.code,
            instance=path,
            request_id=request_id,
            errors=list(self.fields),
        )

    def response(self, path: str, request_id: str | None) -> Response:
        """Return the answer to a request."""
        # The request may contain text without a UTF-8 form; the answer must be valid UTF-8.
        content = self.document(path, request_id).model_dump_json(ensure_ascii=True)
        # The answer to an unexpected error passes no middleware, which would add these.
        headers = {"Cache-Control": "no-store", "Vary": "Authorization", **(self.headers or {})}
        return Response(content, self.status, headers, MEDIA_TYPE)

    async def answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the problem as an ASGI application."""
        request_id = scope.get("state", {}).get("request_id")
        await self.response(scope["path"], request_id)(scope, receive, send)


def unfit_parameter(pointer: str, name: str, rule: str, value: str) -> ProblemError:
    """Return the refusal of a parameter of the path, the query or a header."""
    field = FieldError(pointer=pointer, rule=rule, value=value[:SHOWN_VALUE])
    return ProblemError(422, ProblemCode.validation_failed, f"{name}: {rule}", [field])


def install(app: FastAPI) -> None:
    """Let an application answer every error with a problem."""
    for error_type in (*_PROBLEMS, Exception):
        app.add_exception_handler(error_type, _answer)


def _answer(request: Request, error: Exception) -> Response:
    problem = _problem_of(request, error)
    request_id = getattr(request.state, "request_id", None)
    is_page = not request.url.path.startswith("/v1/")
    if is_page and "text/html" in request.headers.get("accept", ""):
        return html_page(
            "error.html",
            problem.status,
            here="",
            title=problem.title,
            detail=problem.detail,
            request_id=request_id,
        )
    return problem.response(request.url.path, request_id)


def _problem_of(request: Request, error: Exception) -> ProblemError:
    # In the order of the table: an error may be of several of these types.
    for error_type, problem_of in _PROBLEMS.items():
        if isinstance(error, error_type):
            return problem_of(request, error)
    # A bug. The user gets no details, which belong to the log.
    logger.error("%s %s failed", request.method, request.url.path, exc_info=error)
    detail = "the coordinator has a fault; its log says more"
    return ProblemError(500, ProblemCode.internal_error, detail)


def _as_it_is(_request: Request, error: ProblemError) -> ProblemError:
    return error


def _of_refusal(request: Request, error: errors.StickslipError) -> ProblemError:
    # Each error has a status of its own, so a new one without an entry is found by its first test.
    status, code = _STATUS[type(error)]
    if status >= 500:
        logger.error("%s %s: %s", request.method, request.url.path, error)
    return ProblemError(status, code, str(error), error.fields)


def _of_parameters(_request: Request, error: RequestValidationError) -> ProblemError:
    """Return the problem of wrong parameters; `JsonBody` reads bodies."""
    fields = [
        FieldError(
            pointer="".join(f"/{part}" for part in item["loc"]),
            rule=_rule_of(item),
            value=str(item.get("input", ""))[:SHOWN_VALUE],
        )
        for item in error.errors()
    ]
    # A pointer is /query/page_size; people know the parameter by its last part.
    sentences = [f"{field.pointer.rpartition('/')[2]} {field.rule}" for field in fields]
    return ProblemError(422, ProblemCode.validation_failed, "; ".join(sentences), fields)


def _rule_of(item: ErrorDetails) -> str:
    """Return the rule of a parameter in words."""
    context = item.get("ctx", {})
    error_type = item["type"]
    if error_type == "string_pattern_mismatch":
        return _FORMS.get(context["pattern"], "has the wrong form")
    if error_type in ("enum", "literal_error"):
        words = re.findall(r"'([^']*)'", context["expected"])
        return f"must be one of {', '.join(words)}"
    if error_type in _RULES:
        return _RULES[error_type].format(**context)
    return item["msg"]


def _of_http(request: Request, error: HTTPException) -> ProblemError:
    """Return the problem of an error of Starlette: there is no such route, or no such method."""
    path = request.url.path
    if error.status_code == 404:
        detail = f"there is nothing at {path}"
        return ProblemError(404, ProblemCode.not_found, detail, headers=error.headers)
    if error.status_code == 405:
        allowed = _allowed_methods(request)
        detail = f"{path} answers {allowed}, and not {request.method}"
        headers = {"Allow": allowed}
        return ProblemError(405, ProblemCode.method_not_allowed, detail, headers=headers)
    is_too_large = error.status_code == 413
    code = ProblemCode.body_too_large if is_too_large else ProblemCode.malformed_body
    return ProblemError(error.status_code, code, error.detail, headers=error.headers)


def _of_database(request: Request, error: OperationalError) -> ProblemError:
    logger.error("%s %s: %s", request.method, request.url.path, error)
    # SQLite and PostgreSQL have no common class for a lock that another process holds.
    if any(words in str(error) for words in ("locked", "busy", "lock timeout")):
        headers = {"Retry-After": "1"}
        detail = "the database is busy; try again"
        return ProblemError(503, ProblemCode.busy, detail, headers=headers)
    headers = {"Retry-After": "10"}
    detail = "the coordinator cannot use its database (is the disk full?); its log says more"
    return ProblemError(503, ProblemCode.storage_error, detail, headers=headers)


def _of_store(request: Request, error: Exception) -> ProblemError:
    logger.error("%s %s failed", request.method, request.url.path, exc_info=error)
    detail = (
        "a file is missing or damaged in the store, or the store is out of reach; the log says more"
    )
    return ProblemError(500, ProblemCode.storage_error, detail)


_PROBLEMS: dict[type[Exception], Callable[..., ProblemError]] = {
    ProblemError: _as_it_is,
    errors.StickslipError: _of_refusal,
    RequestValidationError: _of_parameters,
    HTTPException: _of_http,
    OperationalError: _of_database,
    OSError: _of_store,
    BrokenSectionError: _of_store,
}
"""How each kind of error is answered. Everything else is a bug."""


def _allowed_methods(request: Request) -> str:
    """Return the methods of a resource: those of the routes with the longest matching template."""
    # Starlette answers with the first route that has the path, and other routes may have it, too.
    candidates = [
        route
        for route in request.app.state.routes
        if isinstance(route, Route) and route.matches(request.scope)[0] is not Match.NONE
    ]
    longest = max((len(route.path) for route in candidates), default=0)
    methods = {
        method
        for route in candidates
        if len(route.path) == longest
        for method in route.methods or ()
    }
    return ", ".join(sorted(methods))
