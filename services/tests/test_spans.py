"""Spans of OpenTelemetry: one tree for a job, from its submission to the commit, over processes."""

import gzip
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import pytest
from stickslip_schemas import tracing
from stickslip_services.queue.context import Context
from stickslip_services.queue.planner import Planner
from stickslip_services.queue.submit import submit_job
from stickslip_services.queue.sweep import start, sweep
from stickslip_services.settings import Settings
from stickslip_testing.jobs import ManualClock, parsed, rods
from stickslip_testing.servers import start_server
from stickslip_testing.worker import DirectApi, PretendWorker, failure

pytest.importorskip("opentelemetry.exporter.otlp.proto.http", reason="needs pip install 'stickslip-schemas[tracing]'")

HOST = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"
"""A traceparent as a program sends it that submits jobs [W3C Trace Context, 3.2]."""


@pytest.fixture
def spans() -> Iterator[Any]:
    """The spans of this process, as they end."""
    from opentelemetry.sdk.trace.export import SimpleSpanProcessor
    from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

    exporter = InMemorySpanExporter()
    tracing.start("tests", processor=SimpleSpanProcessor(exporter))
    yield exporter
    tracing.stop()


def test_a_job_is_one_tree(settings: Settings, clock: ManualClock, spans: Any) -> None:
    context = Context.open(settings.model_copy(update={"plan_samples": 2}), clock)
    start(context)
    worker = PretendWorker(DirectApi(context), context.store).register()
    job = submit_job(context, parsed(rods()), None, traceparent=HOST)
    Planner(context).run()
    (bad,) = worker.lease(simulate=1)
    tracing.record_task(bad, failure(), 2.5, worker="pretend")
    worker.report((bad, failure()))
    clock.advance(10)
    sweep(context)
    worker.work()
    context.close()
    found = spans.get_finished_spans()
    (root,) = [span for span in found if span.name == "submit"]
    assert f"{root.parent.span_id:016x}" == HOST.split("-")[2]
    assert root.attributes["stickslip.job"] == job.id  # type: ignore[union-attr]
    assert {f"{span.context.trace_id:032x}" for span in found} == {HOST.split("-")[1]}
    assert all(span.parent.span_id == root.context.span_id for span in found if span is not root)
    names = [span.name for span in found]
    assert {name: names.count(name) for name in names} == {
        "submit": 1, "plan": 2, "simulate": 5, "render": 4, "pack": 2, "publish": 1, "commit": 1,
    }  # fmt: skip
    (failed,) = [span for span in found if not span.status.is_ok]
    assert (failed.name, failed.status.description) == ("simulate", "it crashed")
    assert (failed.end_time - failed.start_time) == 2_500_000_000
    assert failed.attributes["stickslip.reason"] == "renderer_crash"


@pytest.mark.parametrize("sent", ["", "nonsense", "00-0-0-00", HOST + "-more"])
def test_a_traceparent_that_is_none_counts_as_none(context: Context, spans: Any, sent: str) -> None:
    submit_job(context, parsed(rods()), None, traceparent=sent)
    (root,) = spans.get_finished_spans()
    assert root.parent is None


class _Receiver(BaseHTTPRequestHandler):
    """The least of a collector: POST /v1/traces, as protobuf [OTLP 1.x, OTLP/HTTP]."""

    def do_POST(self) -> None:
        from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

        body = self.rfile.read(int(self.headers["Content-Length"]))
        if self.headers.get("Content-Encoding") == "gzip":
            body = gzip.decompress(body)
        request = ExportTraceServiceRequest.FromString(body)
        for resource in request.resource_spans:
            (service,) = [
                item.value.string_value for item in resource.resource.attributes if item.key == "service.name"
            ]
            for scope in resource.scope_spans:
                self.server.spans += [(service, span) for span in scope.spans]  # type: ignore[attr-defined]
        self.send_response(200)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        pass


@pytest.fixture
def collector(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[tuple[str, Any]]]:
    """A collector that processes find by their environment; the spans that came, with their services."""
    with ThreadingHTTPServer(("127.0.0.1", 0), _Receiver) as server:
        server.spans = []  # type: ignore[attr-defined]
        threading.Thread(target=server.serve_forever, daemon=True).start()
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", f"http://127.0.0.1:{server.server_address[1]}")
        yield server.spans  # type: ignore[attr-defined]
        server.shutdown()


@pytest.mark.real
def test_spans_of_processes_arrive_as_one_tree(collector: list[tuple[str, Any]], tmp_path: Path) -> None:
    server = start_server(tmp_path / "data")
    tracing.start("worker")  # this process is the worker
    try:
        worker = server.worker()
        sent = {"traceparent": HOST}
        httpx.post(f"{server.url}/v1/jobs", json=rods(), headers=sent, trust_env=False).raise_for_status()
        worker.work()
    finally:
        tracing.stop()
        server.stop()
    by_id = {span.span_id: (service, span) for service, span in collector}
    (root,) = [span for _, span in by_id.values() if span.name == "submit"]
    assert root.parent_span_id.hex() == HOST.split("-")[2]
    below = [(service, span.name) for service, span in by_id.values() if span.parent_span_id == root.span_id]
    assert sorted(set(below)) == [
        ("stickslip-coordinator", "commit"),
        *(("worker", stage) for stage in ("pack", "publish", "render", "simulate")),
    ]
    assert len(below) == 1 + 11
    assert {span.trace_id.hex() for _, span in by_id.values()} == {HOST.split("-")[1]}
