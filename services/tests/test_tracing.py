"""Spans of OpenTelemetry: one tree for a job, from its submission to the commit, over processes."""

import subprocess
import sys
from pathlib import Path

import pytest
from stickslip_schemas import tracing
from stickslip_services.queue.context import Context
from stickslip_services.queue.submit import submit_job
from stickslip_testing.jobs import parsed, rods
from stickslip_testing.worker import PretendWorker

HOST = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"
"""A traceparent as a program sends it that submits jobs [W3C Trace Context, 3.2]."""


def test_without_a_collector_nothing_is_traced(context: Context, worker: PretendWorker) -> None:
    submit_job(context, parsed(rods()), None, traceparent=HOST)
    assert not tracing.is_on()
    assert {lease.traceparent for lease in worker.lease()} == {None}
    with tracing.span("nothing", parent=HOST):
        assert tracing.traceparent() is None


@pytest.mark.real
def test_a_collector_without_the_packages_is_refused(tmp_path: Path) -> None:
    """The packages are hidden, so that it is tested where they are installed, too."""
    code = (
        "import sys; sys.modules['opentelemetry.sdk'] = None; from stickslip_services.app import main;"
        "sys.exit(main(sys.argv[1:]))"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code, "--data", str(tmp_path), "--port", "0"],
        env={"OTEL_EXPORTER_OTLP_ENDPOINT": "http://127.0.0.1:1", "PYTHONPATH": ":".join(sys.path)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert ended.returncode == 2
    assert "pip install 'stickslip-schemas[tracing]'" in ended.stderr
