"""Spans of OpenTelemetry, from a submission to the shards: nothing, unless `OTEL_EXPORTER_OTLP_ENDPOINT` is set.

A job keeps the span that it was submitted in as a W3C `traceparent`, and each lease hands it on. So what coordinators
and workers do for a job, hours later and on other machines, hangs below that span.
"""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from opentelemetry.context import Context
from opentelemetry.trace import NoOpTracerProvider, Span, Status, StatusCode, Tracer, TracerProvider, get_current_span
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


def start(service: str, *, exporter: Any = None) -> None:
    """Begin to export spans of this process, if a collector is named; tests give an exporter of their own.

    Raises TracingUnavailableError where the packages that export are missing.
    """
    global _provider
    if exporter is None and not os.environ.get(ENDPOINT):
        return
    try:
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor, SimpleSpanProcessor

        if exporter is None:
            from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter

            processor: Any = BatchSpanProcessor(OTLPSpanExporter())
        else:
            processor = SimpleSpanProcessor(exporter)
    except ImportError as error:
        raise TracingUnavailableError(
            f"{ENDPOINT} is set, and OpenTelemetry is not installed ({error}): "
            "pip install 'stickslip-schemas[tracing]', or unset it"
        ) from error
    _provider = TracerProvider(resource=Resource.create({"service.name": service}))
    _provider.add_span_processor(processor)


def stop() -> None:
    """Export the remaining spans, and stop exporting."""
    global _provider
    provider, _provider = _provider, _OFF
    if provider is not _OFF:
        provider.shutdown()


def is_on() -> bool:
    """Return whether spans are exported."""
    return _provider is not _OFF


@contextmanager
def span(name: str, *, parent: str | None = None, **attributes: Any) -> Iterator[Span]:
    """Open a span below `parent`, a traceparent; one that is no traceparent counts as none."""
    with _tracer().start_as_current_span(name, context=_context(parent), attributes=_named(attributes)) as opened:
        yield opened


def traceparent() -> str | None:
    """Return the open span as a W3C traceparent, for spans below it; None where nothing is exported."""
    carrier: dict[str, str] = {}
    if is_on():
        _propagator.inject(carrier)
    return carrier.get("traceparent")


def note(**attributes: Any) -> None:
    """Add attributes to the open span; their names get `stickslip.` before them."""
    get_current_span().set_attributes(_named(attributes))


def record(name: str, *, parent: str | None, seconds: float, failure: str = "", **attributes: Any) -> None:
    """Export a span that ends now and has lasted so long; `failure` says what went wrong, if anything did."""
    now = time.time_ns()
    made = _tracer().start_span(
        name, context=_context(parent), attributes=_named(attributes), start_time=now - round(1e9 * seconds)
    )
    if failure:
        made.set_status(Status(StatusCode.ERROR, failure))
    made.end(now)


def record_task(lease: Lease, result: TaskResult, seconds: float, *, worker: str) -> None:
    """Export the span of a task that a worker has run; it lasted as long as the call that it was a part of."""
    record(
        lease.task.stage,
        parent=lease.traceparent,
        seconds=seconds,
        failure=result.message[:500] if result.outcome == "failed" else "",
        task=lease.task_id,
        attempt=lease.attempt,
        outcome=result.outcome,
        reason=result.reason,
        cpu_seconds=result.cpu_seconds,
        worker=worker,
    )


def _tracer() -> Tracer:
    return _provider.get_tracer("stickslip")


def _context(parent: str | None) -> Context:
    """Return the context of a parent; an empty one if there is none, so that no span of this thread is taken."""
    return _propagator.extract({"traceparent": parent or ""}, Context())


def _named(attributes: dict[str, Any]) -> dict[str, Any]:
    return {f"stickslip.{name}": value for name, value in attributes.items() if value is not None}
