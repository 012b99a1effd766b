"""Keys expire on their date, and a rotation leaves no moment without a valid key."""

import time
from pathlib import Path

import httpx
import pytest
from click.testing import CliRunner, Result
from fastapi import FastAPI
from sqlalchemy import update
from stickslip_services.access.keys import create_key, keys_that_expire, list_keys, rotate_key
from stickslip_services.access.principals import Scope
from stickslip_services.app import make_app
from stickslip_services.cli import app as cli
from stickslip_services.database.tables import api_keys
from stickslip_services.errors import ConflictError, NotFoundError
from stickslip_services.queue.context import Context
from stickslip_services.settings import Settings
from stickslip_testing.servers import serving, wait_until

DAY = 86_400.0


def run(data: Path, *words: str) -> Result:
    return CliRunner().invoke(cli, ["keys", *words, "--data", str(data)], env={"COLUMNS": "200"})


def status(url: str, key: str) -> int:
    answer = httpx.get(f"{url}/v1/jobs", headers={"Authorization": f"Bearer {key}"})
    return answer.status_code


@pytest.fixture
def closed(settings: Settings) -> FastAPI:
    """A coordinator that asks everybody for a key."""
    return make_app(settings.model_copy(update={"require_keys": True}))


def end(app: FastAPI, key_id: str) -> None:
    """Move the expiry of a key to now."""
    database = app.state.context.database
    with database.write() as connection:
        expire = update(api_keys).where(api_keys.c.id == key_id)
        connection.execute(expire.values(expires_at=database.clock()))


@pytest.mark.databases
def test_a_key_ends_on_its_date_and_the_refusal_names_it(closed: FastAPI) -> None:
    with serving(closed) as url:
        database = closed.state.context.database
        with database.write() as connection:
            now = database.clock()
            _, secret = create_key(connection, "short", [Scope.read], now, expires_at=now + 3.0)
        wait_until(lambda: status(url, secret) == 200, seconds=2.9)
        # No write and no command ends it: the clock does.
        wait_until(lambda: status(url, secret) == 401, seconds=4.0)
        answer = httpx.get(f"{url}/v1/jobs", headers={"Authorization": f"Bearer {secret}"})
        assert answer.json()["detail"].startswith("the key expired at 20")


@pytest.mark.databases
def test_old_and_new_key_work_during_the_overlap_only(closed: FastAPI) -> None:
    with serving(closed) as url:
        database = closed.state.context.database
        with database.write() as connection:
            now = database.clock()
            old_id, old = create_key(
                connection, "ada", [Scope.submit], now, project="rods", expires_at=now + 90 * DAY
            )
        with database.write() as connection:
            rotation = rotate_key(connection, old_id, now + DAY, overlap=3600.0, lifetime=None)
        wait_until(lambda: status(url, rotation.secret) == 200)
        assert status(url, old) == 200
        end(closed, old_id)
        wait_until(lambda: status(url, old) == 401)
        assert status(url, rotation.secret) == 200
        with database.read() as connection:
            new_row = list_keys(connection)[0]
            expiring = keys_that_expire(connection, now)
    assert (new_row.name, new_row.scopes, new_row.project) == ("ada", "submit", "rods")
    assert rotation.expires_at == pytest.approx(now + 91 * DAY)
    # Nobody must be warned of a key that has a successor.
    assert [row.id for row in expiring] == [rotation.key_id]


def test_a_rotation_never_prolongs_a_key_and_happens_once(context: Context) -> None:
    with context.database.write() as connection:
        key_id, _ = create_key(connection, "ada", [Scope.read], 100.0, expires_at=200.0)
        rotation = rotate_key(connection, key_id, 150.0, overlap=DAY, lifetime=500.0)
        assert (rotation.old_expires_at, rotation.expires_at) == (200.0, 650.0)
        with pytest.raises(ConflictError, match=f"has the successor {rotation.key_id}"):
            rotate_key(connection, key_id, 160.0, overlap=DAY, lifetime=None)
        with pytest.raises(ConflictError, match="expired at 1970-01-01 00:10 UTC"):
            rotate_key(connection, rotation.key_id, 700.0, overlap=DAY, lifetime=None)
        with pytest.raises(NotFoundError, match="there is no key 'key-0'"):
            rotate_key(connection, "key-0", 700.0, overlap=DAY, lifetime=None)


def test_an_expired_worker_key_is_replaced_at_the_next_start(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path, durable=False)
    app = make_app(settings)
    with serving(app):
        with app.state.context.database.read() as connection:
            (key,) = list_keys(connection)
        old = settings.worker_key_path.read_text()
        end(app, key.id)
    with serving(make_app(settings)):
        assert settings.worker_key_path.read_text() != old


def test_expiry_and_rotation_from_the_command_line(tmp_path: Path) -> None:
    result = run(tmp_path, "create", "a laptop", "--scope", "read", "--days", "90")
    assert result.exit_code == 0, result.output
    date = time.strftime("%Y-%m-%d", time.gmtime(time.time() + 90 * DAY))
    assert f"and expires at {date}" in result.stderr
    key_id = run(tmp_path, "list").stdout.splitlines()[1].split()[0]
    rotated = run(tmp_path, "rotate", key_id, "--overlap", "2", "--days", "30")
    assert rotated.exit_code == 0, rotated.output
    assert len(rotated.stdout.split()) == 1
    listed = run(tmp_path, "list").stdout.splitlines()
    assert len(listed) == 3
    assert "never" not in "".join(listed)
    again = run(tmp_path, "rotate", key_id)
    assert (again.exit_code, "has the successor key-" in again.stderr) == (1, True)


@pytest.mark.parametrize("days", ["0", "nan", "1e9", "-1", "soon"])
def test_a_lifetime_out_of_range_is_refused(tmp_path: Path, days: str) -> None:
    result = run(tmp_path, "create", "x", "--scope", "read", "--days", days)
    assert result.exit_code == 2
    assert "must be a number of days, 0.01 to 36500" in result.stderr
