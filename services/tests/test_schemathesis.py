"""The coordinator keeps what its OpenAPI document promises: every check of schemathesis.

`tests/schemathesis_hooks.py` names the rules between fields that JSON Schema has no words for.
"""

import subprocess
import sys
import threading
from pathlib import Path

import pytest
from stickslip_services.app import make_app
from stickslip_services.errors import StickslipError
from stickslip_services.queue.context import Context
from stickslip_services.queue.control import cancel_job
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_testing.jobs import list_jobs, parsed, rods
from stickslip_testing.servers import serving
from stickslip_testing.worker import DirectApi, PretendWorker, rejection

ROOT = Path(__file__).parents[2]
EXAMPLES = 3
"""Generated for each operation, beside those that cover the document; a nightly run may ask for
more.
"""


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_every_check_of_schemathesis_passes(tmp_path: Path) -> None:
    app = make_app(Settings(data=tmp_path, durable=False))
    command = Path(sys.executable).with_name("schemathesis")
    with serving(app) as url:
        context: Context = app.state.context
        make_datasets(context)
        stop = threading.Event()
        canceller = threading.Thread(target=cancel_jobs, args=(context, stop))
        canceller.start()
        try:
            run = subprocess.run(
                [
                    *(
                        command,
                        "run",
                        f"{url}/openapi.json",
                        "--header",
                        f"Authorization: Bearer {app.state.worker_key}",
                    ),
                    *(
                        "--checks",
                        "all",
                        "--max-examples",
                        str(EXAMPLES),
                        "--seed",
                        "1",
                        "--suppress-health-check",
                        "all",
                    ),
                    *("--generation-database", "none", "--no-color"),
                ],
                cwd=ROOT,
                capture_output=True,
                text=True,
            )
        finally:
            stop.set()
            canceller.join()
    assert run.returncode == 0, run.stdout[-8000:] + run.stderr[-2000:]
    assert " passed" in run.stdout


def make_datasets(context: Context) -> None:
    """Make a dataset with rejected samples, and leave another job half done."""
    worker = PretendWorker(
        DirectApi(context),
        context.store,
        whole=True,
        judge=lambda task: (
            rejection() if task.stage == "simulate" and task.simulation.gamma == 1.0 else None
        ),
    ).register()
    submit_job(context, parsed(rods(gamma=(1.0, 2.0, 3.0))), None)
    worker.work()
    submit_job(context, parsed(rods(gamma=(7.0, 8.0))), None)
    worker.finish(*worker.lease(simulate=1))


def cancel_jobs(context: Context, stop: threading.Event) -> None:
    """End the jobs that are made: the stream of one that waits for a worker would never end."""
    while not stop.wait(0.1):
        for job in list_jobs(context):
            if job.state.is_open:
                try:
                    cancel_job(context, job.id)
                except StickslipError:
                    continue  # it has ended in between
