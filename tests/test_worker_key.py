"""The key of the workers changes under a running dispatcher."""

import json
from pathlib import Path

import httpx
from click.testing import CliRunner
from fastapi import FastAPI
from sqlalchemy import update
from stickslip_schemas.documents.worker_api import WorkerCondition, WorkerRegistration
from stickslip_services.access.keys import list_keys
from stickslip_services.app import make_app
from stickslip_services.cli import app as cli
from stickslip_services.database.tables import api_keys
from stickslip_services.settings import Settings
from stickslip_testing.servers import serving, wait_until
from stickslip_workers.lease_client import CoordinatorClient


def end(app: FastAPI, key_id: str) -> None:
    """Move the expiry of a key to now."""
    database = app.state.context.database
    with database.write() as connection:
        expire = update(api_keys).where(api_keys.c.id == key_id)
        connection.execute(expire.values(expires_at=database.clock()))


def status(url: str, key: str) -> int:
    """Return how the worker API answers an empty document with a key."""
    headers = {"Authorization": f"Bearer {key}", "Content-Type": "application/json"}
    answer = httpx.post(f"{url}/v1/workers", headers=headers, content=json.dumps({}))
    return answer.status_code


def test_a_worker_reads_its_file_again_when_its_key_has_ended(tmp_path: Path) -> None:
    app = make_app(Settings(data=tmp_path, durable=False))
    with serving(app) as url:
        with app.state.context.database.read() as connection:
            (key,) = list_keys(connection)
        key_file = tmp_path / "worker-key"
        client = CoordinatorClient((url,), key_file)
        old = key_file.read_text()
        rotated = CliRunner().invoke(cli, ["keys", "rotate", key.id, "--data", str(tmp_path)])
        assert rotated.exit_code == 0, rotated.output
        assert key_file.read_text() == rotated.stdout != old
        assert "copy it to workers on other machines" in rotated.stderr
        wait_until(lambda: status(url, rotated.stdout.strip()) == 422)
        end(app, key.id)
        wait_until(lambda: status(url, old.strip()) == 401)
        registration = WorkerRegistration(
            name="local", builds={}, condition=WorkerCondition(slots=1)
        )
        assert client.register(registration).worker_id
        client.close()
