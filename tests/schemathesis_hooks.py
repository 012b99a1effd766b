"""Rules between fields, which JSON Schema has no words for: a generated document that breaks one is
not a valid one.

Each is a part of the message of the error that names it. Whatever else the coordinator refuses, its
schema must refuse.
"""

import io
import uuid
from typing import Any

import schemathesis
from hypothesis import strategies as st
from PIL import Image
from pydantic import TypeAdapter, ValidationError
from stickslip_schemas.documents.certificate import Certificate
from stickslip_schemas.documents.worker_api import ReportBatch
from stickslip_schemas.kinds import AnyJobSpec

RELATIONS = (
    "low must be less than high",
    "start and stop must differ",
    "must differ unless axes are zipped",
    "train + validation + test must be 1",
    "axes that are zipped must have one length",
    "a job has at most",
    "frames must be at most",
    "must be one of ",  # the names that are built in, or of the spec's own
    "must not redefine what is built in",
    "must be [low, high]",
    "must hold fabrics: of",
    "must fit the density: ",
    "must have one unit: ",
    "which the axis draws",
    "distortion must be 0",
    "distortion must move places",
    "camera_matrix must be",
    "rvec and tvec must put",
    "give stretching, or",
    "stretching must be positive definite",
    "bending must be given with stretching",
    "young times thickness must be",
    "young and thickness must give",
    "reason is there exactly when",
    "output is there exactly when",
    "damaged_inputs are those of",
    "a sample is rejected for a reason of its own",
    "error must be the largest of the curves",
    "limit_error must be the largest of the limits",
    "limit_tolerance must be given with limits",
    "limit, order, cells and errors_by_mesh must have",
    "cells and errors_by_mesh must have the same meshes",
    "passed must say whether",
    "x, measured, master and errors must have one length",
    "dense_x and dense_master must have",
    "every protocol must be there once",
    "all protocols must have been run with one build",
)

SAMPLES_MAX = 5_000
"""Of a job that is submitted; planning takes 0.1 ms of each."""

_DOCUMENTS: dict[str, TypeAdapter[Any]] = {
    "/v1/jobs": TypeAdapter(AnyJobSpec),
    "/v1/jobs:validate": TypeAdapter(AnyJobSpec),
    "/v1/worker/report": TypeAdapter(ReportBatch),
    "/v1/certificates": TypeAdapter(Certificate),
}


@schemathesis.hook
def filter_case(context: Any, case: Any) -> bool:
    """Leave out valid cases whose body breaks a rule between fields, and jobs that take long to
    plan, and no other.
    """
    adapter = _DOCUMENTS.get(case.path)
    if adapter is None or case.method != "POST" or not case.meta.generation.mode.is_positive:
        return True
    try:
        document = adapter.validate_python(case.body)
        if case.path in ("/v1/jobs", "/v1/jobs:validate") and document.artifacts:
            return False  # nobody has uploaded them
        if case.path == "/v1/jobs":
            return bool(document.sample_count <= SAMPLES_MAX)
    except ValidationError as error:
        items = error.errors()
        if any(item["loc"][:1] == ("cloth_scene",) for item in items):
            return False  # most rules of scenes are between fields; schemas/tests/scene has them
        return not any(relation in item["msg"] for item in items for relation in RELATIONS)
    return True


@schemathesis.hook
def map_case(context: Any, case: Any) -> Any:
    """Give each request an Idempotency-Key of its own: the same one with another document is
    rightly refused.
    """
    if case.headers and "idempotency-key" in case.headers and case.meta.generation.mode.is_positive:
        case.headers["idempotency-key"] = uuid.uuid4().hex
    return case


def _picture(form: str) -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (64, 64), (90, 20, 20)).save(file, format=form)
    return file.getvalue()


for form in ("PNG", "JPEG"):  # JSON Schema has no words for what is a picture
    schemathesis.openapi.media_type(f"image/{form.lower()}", st.just(_picture(form)))
schemathesis.openapi.media_type(
    "application/octet-stream", st.just(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
)
