"""The page that submits a job: a form, its check while the user fills it in, and the submission."""

import json
import secrets
import shlex
from dataclasses import dataclass, field
from typing import Annotated, Any
from urllib.parse import parse_qsl

from fastapi import APIRouter, Query, Request, Response
from starlette.concurrency import run_in_threadpool
from stickslip_schemas.base import sha256
from stickslip_schemas.documents.problems import ProblemCode
from stickslip_schemas.documents.responses import JobDetail, Validation
from stickslip_schemas.kinds import AnyJobSpec, UnknownKindError, job_spec_adapter
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.addresses import link, url
from stickslip_services.api.bodies import (
    SPEC_BYTES,
    JsonBody,
    content_type,
    whole_body,
    wrong_media_type,
)
from stickslip_services.api.problems import ProblemError
from stickslip_services.api.routes.common import ContextDep
from stickslip_services.errors import NotFoundError, StickslipError
from stickslip_services.pages.rendering import html_page
from stickslip_services.pages.submit_filling import Filling, filled_form
from stickslip_services.pages.submit_form import (
    AXIS_FORMS,
    MAX_FIELDS,
    FormError,
    Sent,
    SubmitForm,
    document_of,
    field_of,
    form_of,
    grouped,
    kinds,
    spec_yaml,
)
from stickslip_services.queue.context import Context
from stickslip_services.queue.estimate import validate_spec
from stickslip_services.queue.jobs import find_job
from stickslip_services.queue.submit import submit_job

router = APIRouter(include_in_schema=False)

FORM_TYPE = "application/x-www-form-urlencoded"

_SPEC: JsonBody[JobSpec] = JsonBody(AnyJobSpec, max_bytes=SPEC_BYTES)
"""Reads a spec by the same rules as `POST /v1/jobs`."""

DEFAULT_KIND = "cloth_scene"


@dataclass
class Check:
    """The result of checking a form that is filled in."""

    form: SubmitForm
    document: dict[str, Any] = field(default_factory=dict)
    spec: JobSpec | None = None
    plan: Validation | None = None
    faults: dict[str, list[str]] = field(default_factory=dict)
    """Rules that do not hold, by the name of the field; those of no field have an empty name."""

    def add(self, name: str, rule: str) -> None:
        self.faults.setdefault(name, []).append(rule)


@router.get("/submit")
def get_form(
    context: ContextDep,
    kind: Annotated[str, Query(max_length=50)] = DEFAULT_KIND,
    scene: Annotated[str | None, Query(max_length=64)] = None,
    job: Annotated[str, Query(max_length=64)] = "",
) -> Response:
    """Show the form of a kind, or of a scene; or that of a job, filled in with its spec."""
    form, filling = _form_of_job(context, job) if job else (_form(kind, scene), Filling())
    return html_page(
        "submit.html",
        here="submit",
        form=form,
        filling=filling,
        job=job,
        kinds=kinds(),
        axis_forms=AXIS_FORMS,
        token=secrets.token_hex(8),
    )


@router.post("/ui/submit/check")
async def post_check(request: Request, context: ContextDep) -> Response:
    """Show the faults, the size and the cost of the job, and the spec in three forms."""
    sent = await _sent(request)
    return await run_in_threadpool(lambda: _answer(_checked(context, sent), is_submission=False))


@router.post("/ui/submit")
async def post_form(request: Request, context: ContextDep) -> Response:
    """Submit the job and redirect to it, or show what stands against it."""
    sent = await _sent(request)
    return await run_in_threadpool(_submitted, context, sent)


def _form(kind: str, scene: str | None) -> SubmitForm:
    try:
        return form_of(kind, scene or None)
    except (UnknownKindError, ValueError) as error:
        raise NotFoundError(f"there is no such form: {error}") from error


def _form_of_job(context: Context, job: str) -> tuple[SubmitForm, Filling]:
    """Return the form of a job and the values of its fields; raise NotFoundError."""
    with context.database.read() as connection:
        spec = job_spec_adapter.validate_json(find_job(connection, job).spec)
    return filled_form(spec)


async def _sent(request: Request) -> Sent:
    """Return the fields of a form; raise ProblemError if the body is none."""
    media_type = content_type(request)
    if media_type != FORM_TYPE:
        raise wrong_media_type(FORM_TYPE, media_type)
    body = await whole_body(request, SPEC_BYTES)
    try:
        text = body.decode("utf-8")
        return grouped(parse_qsl(text, keep_blank_values=True, max_num_fields=MAX_FIELDS))
    except ValueError as error:
        detail = f"the body is no form of at most {MAX_FIELDS} fields: {error}"
        raise ProblemError(422, ProblemCode.validation_failed, detail) from error


def _checked(context: Context, sent: Sent) -> Check:
    """Return the spec of a form, the cost of its job, and its faults."""
    kind, scene = ((sent.get(name) or [""])[0] for name in ("kind", "scene"))
    check = Check(_form(kind, scene))
    try:
        check.document = document_of(check.form, sent)
        check.spec = _SPEC.read(json.dumps(check.document).encode())
        check.plan = validate_spec(context, check.spec)
    except FormError as error:
        check.add(error.name, error.rule)
    except (ProblemError, StickslipError) as error:
        for fault in error.fields:
            # A field that is missing has no value.
            value = f" (it is {fault.value})" if fault.value else ""
            check.add(field_of(check.form, fault.pointer), f"{fault.rule}{value}")
        if not error.fields:
            check.add("", str(error.detail if isinstance(error, ProblemError) else error))
    return check


def _submitted(context: Context, sent: Sent) -> Response:
    check = _checked(context, sent)
    if check.spec is None or check.faults:
        return _answer(check, is_submission=True)
    # One form makes one job of a spec, however often the button is pressed.
    content = sha256(check.spec.model_dump_json().encode())[:16]
    key = f"form-{(sent.get('token') or [''])[0][:64]}-{content}"
    try:
        job = submit_job(context, check.spec, key)
    except StickslipError as error:
        check.add("", str(error))
        return _answer(check, is_submission=True)
    job_id = job.id if isinstance(job, JobDetail) else job.job_id
    return Response(status_code=204, headers={"HX-Redirect": link(f"/jobs/{job_id}")})


def _answer(check: Check, *, is_submission: bool) -> Response:
    """Return the faults of a form, its size and cost, and its spec in three forms."""
    return html_page(
        "submit_check.html",
        check=check,
        is_submission=is_submission,
        yaml=spec_yaml(check.document),
        curl=_curl(check.document),
        python=_python(check.document),
    )


def _curl(document: dict[str, Any]) -> str:
    body = shlex.quote(json.dumps(document))
    return f"curl {url()}/v1/jobs -H 'Content-Type: application/json' -d {body}"


def _python(document: dict[str, Any]) -> str:
    return (
        "from stickslip import Client\n\n"
        f"spec = {document!r}\n\n"
        f'with Client("{url()}") as client:\n'
        "    print(client.submit(spec).id)"
    )
