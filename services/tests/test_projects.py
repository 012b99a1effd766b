"""Projects: whose jobs they are, what they may have in flight, and how they share the workers."""

from collections import Counter
from pathlib import Path
from typing import Any

import httpx
import pytest
from click.testing import CliRunner
from stickslip_schemas.base import JobState
from stickslip_services.access import audit_log
from stickslip_services.access.principals import Principal, acting_as
from stickslip_services.access.quotas import find_project, list_projects, set_quota
from stickslip_services.app import make_app
from stickslip_services.cli import app
from stickslip_services.errors import QuotaExceededError
from stickslip_services.queue.context import Context
from stickslip_services.queue.control import cancel_job, pause_job
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_testing.invariants import violations
from stickslip_testing.jobs import parsed, rods, show_job
from stickslip_testing.servers import serving
from stickslip_testing.worker import PretendWorker

pytestmark = pytest.mark.databases


def submit(context: Context, project: str, *, priority: int = 0, **spec: Any) -> str:
    with acting_as(Principal(project=project)):
        job = submit_job(context, parsed(rods(**spec)), None, priority=priority)
    return job.id  # type: ignore[union-attr]


def limit(context: Context, project: str, **most: int | None) -> None:
    with context.database.write() as connection:
        limits: dict[str, int | None] = {"max_samples": None, "max_jobs": None, **most}
        set_quota(connection, project, **limits, now=context.clock())


def shares(
    context: Context, worker: PretendWorker, count: int, jobs: dict[float, str]
) -> Counter[str]:
    """Lease simulations, and return how many are of each project; a job is known by its gamma."""
    leases = worker.lease(simulate=count)
    return Counter(jobs[lease.task.simulation.gamma] for lease in leases)  # type: ignore[union-attr]


def test_a_quota_of_samples_refuses_what_is_too_much(
    context: Context, worker: PretendWorker
) -> None:
    limit(context, "lab", max_samples=6)
    first = submit(context, "lab")
    assert show_job(context, first).project == "lab"
    with pytest.raises(
        QuotaExceededError, match=r"samples of the project 'lab' .* at most 6: there are 4, .* be 8"
    ):
        submit(context, "lab", gamma=(8.0, 9.0))
    submit(context, "lab", gamma=(8.0,))
    submit(context, "other", gamma=(8.0, 9.0))  # of a project without a quota
    with context.database.read() as connection:
        assert (find_project(connection, "lab").samples, find_project(connection, "lab").jobs) == (
            6,
            2,
        )
    worker.work()
    submit(context, "lab", gamma=(8.0, 9.0))  # all of it has ended
    limit(context, "lab")
    submit(context, "lab", gamma=(1.0, 2.0, 3.0, 4.0, 5.0))
    with context.database.read() as connection:
        assert violations(connection) == []
        assert [project.name for project in list_projects(connection)] == ["", "lab", "other"]
        assert [
            line.subject for line in audit_log.read(connection) if line.action == "project.quota"
        ] == ["lab", "lab"]


def test_a_quota_of_jobs_counts_those_that_have_not_ended(
    context: Context, worker: PretendWorker
) -> None:
    limit(context, "", max_jobs=1)
    first = submit(context, "")
    with pytest.raises(
        QuotaExceededError, match=r"jobs of requests without a project .* at most 1: there are 1"
    ):
        submit(context, "", gamma=(7.0,))
    pause_job(context, first)
    with pytest.raises(QuotaExceededError):
        submit(context, "", gamma=(7.0,))
    cancel_job(context, first)
    assert show_job(context, first).state is JobState.cancelled
    submit(context, "", gamma=(7.0,))


def test_a_large_job_counts_before_it_is_planned(context: Context, worker: PretendWorker) -> None:
    context.settings = context.settings.model_copy(update={"plan_samples": 2})
    limit(context, "lab", max_samples=5)
    assert show_job(context, submit(context, "lab")).state is JobState.planning
    with pytest.raises(QuotaExceededError):
        submit(context, "lab", gamma=(7.0,))


def test_projects_share_evenly_however_many_jobs_they_have(
    context: Context, worker: PretendWorker
) -> None:
    phi1 = tuple(float(n) for n in range(1, 21))
    jobs = {}
    for gamma in (1.0, 2.0, 3.0):
        submit(context, "many", gamma=(gamma,), phi1=phi1, priority=10)
        jobs[gamma] = "many"
    submit(context, "one", gamma=(4.0,), phi1=phi1)
    jobs[4.0] = "one"
    total = shares(context, worker, 8, jobs)
    assert total == {"many": 4, "one": 4}
    total += shares(context, worker, 5, jobs)
    assert sorted(total.values()) == [6, 7]
    submit(context, "late", gamma=(5.0,), phi1=phi1)
    jobs[5.0] = "late"
    new = shares(context, worker, 6, jobs)
    assert new == {"late": 6}  # until it has as many as the others
    assert total + new + shares(context, worker, 50, jobs) == {"one": 20, "late": 20, "many": 29}


def test_priorities_order_the_jobs_of_a_project(context: Context, worker: PretendWorker) -> None:
    phi1 = (1.0, 2.0, 3.0)
    submit(context, "lab", gamma=(1.0,), phi1=phi1)
    submit(context, "lab", gamma=(2.0,), phi1=phi1, priority=1)
    submit(context, "other", gamma=(3.0,), phi1=phi1, priority=-1)
    leases = worker.lease(simulate=4)
    assert sorted(lease.task.simulation.gamma for lease in leases) == [2.0, 2.0, 3.0, 3.0]  # type: ignore[union-attr]


@pytest.mark.parametrize("option", [["--samples", "5"], ["--jobs", "1"]])
def test_the_api_answers_429_and_names_the_rule(
    tmp_path: Path, option: list[str], database: str
) -> None:
    data = tmp_path / "data"
    settings = Settings.chosen(data=data, durable=False, require_keys=True)
    with serving(make_app(settings)) as url:
        result = CliRunner().invoke(
            app,
            ["keys", "create", "ann", "--scope", "submit", "--project", "lab", "--data", str(data)],
        )
        assert result.exit_code == 0, result.output
        done = CliRunner().invoke(app, ["projects", "quota", "lab", *option, "--data", str(data)])
        assert done.exit_code == 0, done.output
        headers = {"Authorization": f"Bearer {result.stdout.strip()}"}
        with httpx.Client(base_url=url, headers=headers, trust_env=False) as client:
            first = client.post("/v1/jobs", json=rods())
            assert (first.status_code, first.json()["project"]) == (202, "lab")
            refused = client.post("/v1/jobs", json=rods(gamma=(8.0, 9.0)))
            problem = refused.json()
            assert (refused.status_code, problem["code"]) == (429, "quota_exceeded")
            (field,) = problem["errors"]
            rule = option[0][2:]
            assert (
                field["rule"]
                == f"{rule} of the project 'lab' that have not ended must be at most {option[1]}"
            )
            assert field["value"] == {"samples": "8", "jobs": "2"}[rule]
            assert len(client.get("/v1/jobs").json()["items"]) == 1
            client.post(f"/v1/jobs/{first.json()['id']}:cancel")
            assert client.post("/v1/jobs", json=rods(gamma=(8.0, 9.0))).status_code == 202
        result = CliRunner().invoke(app, ["projects", "list", "--data", str(data)])
        assert "lab" in result.stdout, result.output


def test_a_project_needs_a_name_that_can_be_typed(tmp_path: Path, context: Context) -> None:
    data = str(context.settings.data)
    done = CliRunner().invoke(
        app, ["projects", "quota", "Two Words", "--jobs", "1", "--data", data]
    )
    assert done.exit_code == 1
    assert "project must be lower-case letters" in " ".join(done.stderr.split())
