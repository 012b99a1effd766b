"""Spans of OpenTelemetry, from a submission to the shards: nothing, unless `OTEL_EXPORTER_OTLP_ENDPOINT` is set.

A job keeps the span that it was submitted in as a W3C `traceparent`, and each lease hands it on. So what coordinators
and workers do for a job, hours later and on other machines, hangs below that span.
"""

import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from stickslip_schemas.documents.tasks import TaskResult
from stickslip_schemas.documents.worker_api import Lease

ENDPOINT = "OTEL_EXPORTER_OTLP_ENDPOINT"
"""Environment variable with the URL of a collector; the other variables of OpenTelemetry's SDK hold as well."""

_TRACEPARENT = re.compile(r"00-([0-9a-f]{32})-([0-9a-f]{16})-([0-9a-f]{2})")

_provider: Any = None


class TracingUnavailableError(Exception):
    """A collector is named, and OpenTelemetry is not installed."""


def start(service: str, *, exporter: Any = None) -> None:
    """Begin to export spans of this process, if a collector is named; tests give an exporter of their own.

    Raises TracingUnavailableError where OpenTelemetry's packages are missing.
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
    """Export what is left, and no more."""
    global _provider
    provider, _provider = _provider, None
    if provider is not None:
        provider.shutdown()


def is_on() -> bool:
    """Tell whether spans are exported."""
    return _provider is not None


class Span:
    """A span that is open; where nothing is exported, nothing."""

    def __init__(self, span: Any) -> None:
        self._span = span

    @property
    def traceparent(self) -> str | None:
        """What others need to hang their spans below this one [W3C Trace Context]; None where nothing is exported."""
        if self._span is None:
            return None
        context = self._span.get_span_context()
        return f"00-{context.trace_id:032x}-{context.span_id:016x}-{int(context.trace_flags):02x}"

    def note(self, **attributes: Any) -> None:
        """Add attributes; their names get `stickslip.` before them."""
        if self._span is not None:
            self._span.set_attributes(_named(attributes))


@contextmanager
def span(name: str, *, parent: str | None = None, **attributes: Any) -> Iterator[Span]:
    """Open a span below `parent`, a traceparent; one that is no traceparent counts as none."""
    if _provider is None:
        yield Span(None)
        return
    tracer = _provider.get_tracer("stickslip")
    with tracer.start_as_current_span(name, context=_context(parent), attributes=_named(attributes)) as opened:
        yield Span(opened)


def record(name: str, *, parent: str | None, seconds: float, failure: str = "", **attributes: Any) -> None:
    """Export a span that ends now and has lasted so long; `failure` says what went wrong, if anything did."""
    if _provider is None:
        return
    from opentelemetry.trace import Status, StatusCode

    now = time.time_ns()
    made = _provider.get_tracer("stickslip").start_span(
        name, context=_context(parent), attributes=_named(attributes), start_time=now - round(1e9 * seconds)
    )
    if failure:
        made.set_status(Status(StatusCode.ERROR, failure))
    made.end(now)


def record_task(lease: Lease, result: TaskResult, seconds: float, *, worker: str) -> None:
    """Export the span of a task that a worker has run; it lasted as long as the call that it was a part of."""
    failure = result.message[:500] if result.outcome == "failed" else ""
    record(
        lease.task.stage,
        parent=lease.traceparent,
        seconds=seconds,
        failure=failure,
        task=lease.task_id,
        attempt=lease.attempt,
        outcome=result.outcome,
        reason=result.reason,
        cpu_seconds=result.cpu_seconds,
        worker=worker,
    )


def _context(parent: str | None) -> Any:
    """Return the context of a parent; an empty one where there is none, so that no span of this thread is taken."""
    from opentelemetry.context import Context
    from opentelemetry.trace import NonRecordingSpan, SpanContext, TraceFlags, set_span_in_context

    parts = _TRACEPARENT.fullmatch(parent or "")
    if parts is None:
        return Context()
    trace, own, flags = (int(part, 16) for part in parts.groups())
    return set_span_in_context(
        NonRecordingSpan(SpanContext(trace, own, is_remote=True, trace_flags=TraceFlags(flags))), Context()
    )


def _named(attributes: dict[str, Any]) -> dict[str, Any]:
    return {f"stickslip.{name}": value for name, value in attributes.items() if value is not None}
