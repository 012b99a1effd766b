"""Spans of OpenTelemetry, from a submission to the shards: nothing, unless `OTEL_EXPORTER_OTLP_ENDPOINT` is set.

A job keeps the span that it was submitted in as a W3C `traceparent`, and each lease hands it on. So what coordinators
and workers do for a job, hours later and on other machines, hangs below that span.
"""

import os
import time
from contextlib import AbstractContextManager
from typing import Any

from opentelemetry.context import Context
from opentelemetry.trace import NoOpTracerProvider, Span, Status, StatusCode, TracerProvider, use_span
from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

from stickslip_schemas.documents.tasks import TaskResult
from stickslip_schemas.documents.worker_api import Lease

ENDPOINT = "OTEL_EXPORTER_OTLP_ENDPOINT"
"""Environment variable with the URL of a collector; the other variables of OpenTelemetry's SDK hold as well."""

_OFF = NoOpTracerProvider()
_provider: TracerProvider = _OFF
_propagator = TraceContextTextMapPropagator()


class TracingUnavailableError(Exception):
    """A collector is named, and OpenTelemetry's SDK is not installed."""


def start(service: str, *, processor: Any = None) -> None:
    """Begin to export spans of this process, if a collector is named; tests give a processor of their own.

    Raises TracingUnavailableError where the packages that export are missing.
    """
    global _provider
    if processor is None and not os.environ.get(ENDPOINT):
        return
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError as error:
        raise TracingUnavailableError(
            f"{ENDPOINT} is set, and OpenTelemetry is not installed ({error}): "
            "pip install 'stickslip-schemas[tracing]', or unset it"
        ) from error
    _provider = TracerProvider(resource=Resource.create({"service.name": service}))
    _provider.add_span_processor(processor or BatchSpanProcessor(OTLPSpanExporter()))


def stop() -> None:
    """Export the remaining spans, and stop exporting."""
    global _provider
    provider, _provider = _provider, _OFF
    if provider is not _OFF:
        provider.shutdown()


def is_on() -> bool:
    """Return whether spans are exported."""
    return _provider is not _OFF


def span(name: str, *, parent: str | None, **attributes: Any) -> AbstractContextManager[Span]:
    """Open a span below `parent`, a traceparent; one that is no traceparent counts as none."""
    opened: AbstractContextManager[Span] = use_span(_started(name, parent, attributes), end_on_exit=True)
    return opened


def traceparent() -> str | None:
    """Return the open span as a W3C traceparent, for spans below it; None where nothing is exported."""
    carrier: dict[str, str] = {}
    if is_on():
        _propagator.inject(carrier)
    return carrier.get("traceparent")


def record(name: str, *, parent: str | None, seconds: float, failure: str = "", **attributes: Any) -> None:
    """Export a span that ends now and has lasted so long; `failure` says what went wrong, if anything did."""
    now = time.time_ns()
    made = _started(name, parent, attributes, now - round(1e9 * seconds))
    if failure:
        made.set_status(Status(StatusCode.ERROR, failure[:500]))
    made.end(now)


def record_task(lease: Lease, result: TaskResult, seconds: float, *, worker: str) -> None:
    """Export the span of a task that a worker has run; it lasted as long as the call that it was a part of."""
    failure = result.message if result.outcome == "failed" else ""
    told: dict[str, Any] = {
        "attempt": lease.attempt,
        "outcome": result.outcome,
        "reason": result.reason,
        "worker": worker,
    }
    told |= {"task": lease.task_id, "cpu_seconds": result.cpu_seconds}
    record(lease.task.stage, parent=lease.traceparent, seconds=seconds, failure=failure, **told)


def _started(name: str, parent: str | None, attributes: dict[str, Any], begin_ns: int | None = None) -> Span:
    """Start a span; without a parent its context is empty, so that it hangs below no span of this thread."""
    context = _propagator.extract({"traceparent": parent or ""}, Context())
    known = {f"stickslip.{name}": value for name, value in attributes.items() if value is not None}
    return _provider.get_tracer("stickslip").start_span(name, context, attributes=known, start_time=begin_ns)
