"""The audit log: each change has an entry with its actor, and no entry is ever changed."""

import json
import time
from typing import Any

import httpx
import pytest
from click.testing import CliRunner
from sqlalchemy import delete, update
from sqlalchemy.exc import DBAPIError
from stickslip_services.access import audit_log
from stickslip_services.access.keys import create_key, revoke_key, sealer
from stickslip_services.access.principals import NOBODY, Principal, Scope, acting_as
from stickslip_services.access.webhooks import create_webhook, delete_webhook, retry_webhook
from stickslip_services.app import make_app
from stickslip_services.cli import app
from stickslip_services.database.tables import audit_log as audit_rows
from stickslip_services.errors import NotFoundError
from stickslip_services.queue.context import Context
from stickslip_services.queue.control import cancel_job, pause_job, prioritise_job, resume_job
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_testing.jobs import parsed, rods
from stickslip_testing.servers import serving
from stickslip_testing.worker import PretendWorker

pytestmark = pytest.mark.databases


def lines(context: Context, subject: str | None = None) -> list[tuple[str, str, dict[str, Any]]]:
    """Return who did what, the oldest first."""
    with context.database.read() as connection:
        entries = audit_log.read(connection, subject=subject)
    return [(line.actor, line.action, line.details) for line in reversed(entries)]


def test_every_change_of_a_job_has_its_line(context: Context, worker: PretendWorker) -> None:
    with acting_as(Principal("key-1 ada")):
        job = submit_job(context, parsed(rods(name="hers")), None, priority=3).id  # type: ignore[union-attr]
        pause_job(context, job)
    with acting_as(Principal("key-2 bert")):
        resume_job(context, job)
        prioritise_job(context, job, 7)
        cancel_job(context, job)
    assert lines(context, job) == [
        ("key-1 ada", "job.submit", {"name": "hers", "samples": 4, "priority": 3}),
        ("key-1 ada", "job.pause", {}),
        ("key-2 bert", "job.resume", {}),
        ("key-2 bert", "job.prioritise", {"priority": 7}),
        ("key-2 bert", "job.cancel", {}),
    ]


def test_what_is_refused_or_fails_leaves_no_line(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = submit_job(context, parsed(rods()), None).id  # type: ignore[union-attr]
    with pytest.raises(NotFoundError):
        pause_job(context, "job-0")
    monkeypatch.setattr("stickslip_services.queue.control.settle_job", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        cancel_job(context, job)
    again = submit_job(context, parsed(rods()), "the same")
    replayed = submit_job(context, parsed(rods()), "the same")
    assert type(replayed) is not type(again)
    assert [action for _, action, _ in lines(context)] == ["job.submit", "job.submit"]


def test_keys_and_webhooks_have_lines(context: Context) -> None:
    with acting_as(Principal("user ada")), context.database.write() as connection:
        key, secret = create_key(connection, "bert", [Scope.read, Scope.submit], 1.0)
        revoke_key(connection, key, 2.0)
        hook, sign = create_webhook(
            connection, sealer(context.settings), "https://example.org/hook", 3.0
        )
        retry_webhook(connection, hook, 4.0)
        delete_webhook(connection, hook, 5.0)
    entries = lines(context)
    assert [(actor, action) for actor, action, _ in entries] == [
        ("user ada", action)
        for action in (
            "key.create",
            "key.revoke",
            "webhook.create",
            "webhook.retry",
            "webhook.delete",
        )
    ]
    assert entries[0][2] == {"name": "bert", "scopes": ["read", "submit"], "project": ""}
    assert not any(secret in json.dumps(entries) for secret in (secret, sign))


@pytest.mark.parametrize("change", [update(audit_rows).values(actor="nobody"), delete(audit_rows)])
def test_no_line_can_be_changed(context: Context, change: Any) -> None:
    submit_job(context, parsed(rods()), None)
    before = lines(context)
    with (
        pytest.raises(DBAPIError, match="the audit log is append-only"),
        context.database.write() as connection,
    ):
        connection.execute(change)
    assert lines(context) == before != []


def test_requests_are_told_apart_by_their_keys(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also when many come at once: each is noted with its own."""
    application = make_app(settings.model_copy(update={"require_keys": True}))
    with serving(application) as url:
        with application.state.context.database.write() as connection:
            keys = [
                create_key(connection, name, [Scope.submit], time.time())
                for name in ("ada", "bert")
            ]
        time.sleep(1.1)  # so long a key may take to count
        for _ in range(3):
            for _, secret in keys:
                headers = {"Authorization": f"Bearer {secret}"}
                answer = httpx.post(
                    f"{url}/v1/jobs", json=rods(), headers=headers, trust_env=False, timeout=30
                )
                assert answer.status_code == 202, answer.text
        entries = [
            actor for actor, action, _ in lines(application.state.context) if action == "job.submit"
        ]
    assert entries == [
        f"{keys[number % 2][0]} {('ada', 'bert')[number % 2]}" for number in range(6)
    ]


def test_the_command_line_shows_it(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    def cli(*words: str) -> Any:
        result = CliRunner().invoke(
            app, [*words, "--data", str(settings.data)], env={"COLUMNS": "200"}
        )
        assert result.exit_code == 0, result.output
        return result

    monkeypatch.setattr("getpass.getuser", lambda: "ada")
    cli("keys", "create", "bert", "--scope", "read")
    with serving(make_app(settings)) as url:
        job = httpx.post(f"{url}/v1/jobs", json=rods(), trust_env=False, timeout=30).json()["id"]
    (line,) = (json.loads(text) for text in cli("audit-log", job, "--json").stdout.splitlines())
    assert (line["actor"], line["action"], line["subject"]) == (NOBODY, "job.submit", job)
    output = cli("audit-log").stdout
    assert "user ada" in output
    assert "key.create" in output
    assert len(cli("audit-log", "--json", "--limit", "1").stdout.splitlines()) == 1
