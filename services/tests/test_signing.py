"""Signed datasets: the signer is known; unsigned, unknown signer and changed are three errors."""

import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from stickslip_schemas.base import sha256
from stickslip_schemas.format.manifest import Manifest, seal_text, with_manifest_digest
from stickslip_services.app import main, make_app
from stickslip_services.cli import app as commands
from stickslip_services.client import Client, pull, signer_of, verify
from stickslip_services.client.errors import (
    ChangedError,
    ClientError,
    DamagedError,
    UnknownSignerError,
    UnsignedError,
)
from stickslip_services.client.signing import sign
from stickslip_services.queue.context import Context
from stickslip_services.queue.jobs import has_schedulable_job
from stickslip_services.settings import Settings
from stickslip_testing.jobs import rods
from stickslip_testing.servers import serving
from stickslip_testing.worker import DirectApi, PretendWorker

pytestmark = pytest.mark.skipif(
    shutil.which("ssh-keygen") is None, reason="no ssh-keygen: apt-get install openssh-client"
)


@dataclass
class Signers:
    """Keys of OpenSSH: `lab` is allowed, `stranger` is not."""

    lab: Path
    stranger: Path
    allowed: Path


@pytest.fixture(scope="module")
def signers(tmp_path_factory: pytest.TempPathFactory) -> Signers:
    place = tmp_path_factory.mktemp("keys")
    for name in ("lab", "stranger"):
        command = [
            "ssh-keygen",
            "-q",
            "-t",
            "ed25519",
            "-N",
            "",
            "-C",
            name,
            "-f",
            str(place / name),
        ]
        subprocess.run(command, check=True)
    keys = Signers(place / "lab", place / "stranger", place / "allowed")
    keys.allowed.write_text(
        f'lab@example.org namespaces="stickslip" {(place / "lab.pub").read_text()}'
    )
    return keys


@dataclass
class Origin:
    """A coordinator that signs, with a dataset."""

    url: str
    dataset: str
    context: Context

    def file_of_version(self, name: str) -> Path:
        return Path(self.context.store.place) / "datasets" / self.dataset / "v1" / name


@pytest.fixture
def origin(tmp_path: Path, signers: Signers) -> Iterator[Origin]:
    app = make_app(
        Settings(data=tmp_path / "data", durable=False, database=None, signing_key=signers.lab)
    )
    context: Context = app.state.context
    with serving(app) as url, Client(url) as client:
        worker = PretendWorker(DirectApi(context), context.store).register()
        job = client.submit(rods())
        worker.work()
        detail = client.job(job.id).dataset
        assert detail is not None
        yield Origin(url, detail.dataset, context)


def run(*words: object) -> tuple[int, str]:
    ended = CliRunner().invoke(commands, [str(word) for word in words])
    return ended.exit_code, ended.output


def test_what_a_coordinator_signs_is_pulled_and_verified(
    origin: Origin, signers: Signers, tmp_path: Path
) -> None:
    target = tmp_path / "d"
    options = ("--allowed-signers", signers.allowed)
    assert run("pull", origin.dataset, target, *options, "--url", origin.url)[0] == 0
    status, output = run("verify", target, *options)
    assert (status, "signed by lab@example.org" in output) == (0, True), output
    with Client(origin.url) as client:
        served = client.request(
            "GET", f"/v1/datasets/{origin.dataset}/versions/1/files/manifest.sha256.sig"
        ).content
    assert served == (target / "manifest.sha256.sig").read_bytes()
    command = [
        "ssh-keygen",
        "-Y",
        "verify",
        "-n",
        "stickslip",
        "-I",
        "lab@example.org",
        "-f",
        str(signers.allowed),
    ]
    with (target / "manifest.sha256").open("rb") as seal:  # no program of ours is needed
        subprocess.run(
            [*command, "-s", str(target / "manifest.sha256.sig")], stdin=seal, check=True
        )


def test_unsigned_unknown_and_changed_are_three_errors_and_nothing_is_written(
    origin: Origin, signers: Signers, tmp_path: Path
) -> None:
    signature, target = origin.file_of_version("manifest.sha256.sig"), tmp_path / "d"
    good = signature.read_bytes()

    def refused(error: type[ClientError], words: str) -> None:
        with Client(origin.url) as client, pytest.raises(error, match=words):
            pull(client, origin.dataset, 1, target, allowed_signers=signers.allowed)
        assert not target.exists()

    signature.unlink()
    refused(UnsignedError, "is not signed")
    assert (
        run("sign", origin.file_of_version(""), "--key", signers.stranger)[0] == 0
    )  # served from the next request on
    refused(
        UnknownSignerError,
        "signed by somebody whom .*allowed does not allow, with ED25519 key SHA256:",
    )
    signature.write_bytes(good.replace(b"\n", b"\nAAAA", 1))
    refused(ChangedError, "was changed")
    signature.write_bytes(good)
    with Client(origin.url) as client:
        pull(client, origin.dataset, 1, target, allowed_signers=signers.allowed)


def test_a_dataset_that_is_changed_and_sealed_again_is_found(
    origin: Origin, signers: Signers, tmp_path: Path
) -> None:
    target = tmp_path / "d"
    with Client(origin.url) as client:
        pull(client, origin.dataset, 1, target)
    manifest = Manifest.model_validate_json((target / "manifest.json").read_bytes())
    content = manifest.model_copy(update={"certificate": "0" * 64}).model_dump_json().encode()
    group = with_manifest_digest((target / "zarr.json").read_bytes(), sha256(content))
    seal = seal_text(sha256(content), sha256(group))
    for name, data in (("manifest.json", content), ("zarr.json", group), ("manifest.sha256", seal)):
        (target / name).write_bytes(data)
    assert verify(target) == []  # it is consistent in itself
    with pytest.raises(ChangedError):
        signer_of(target, signers.allowed)
    status, output = run("verify", target, "--allowed-signers", signers.allowed)
    assert (status, "the dataset or its signature was changed" in output) == (1, True), output
    (target / "zarr.json").write_bytes(b"{}")
    status, output = run("sign", target, "--key", signers.lab)
    assert (status, "is not signed, because it is damaged" in output) == (1, True), output


def test_a_signed_version_is_not_passed_off_as_another(
    origin: Origin, signers: Signers, tmp_path: Path
) -> None:
    """A server with an older signed version answers with it where the newer one is asked for."""
    with Client(origin.url) as client:
        answer = client.request

        def other(method: str, path: str, **rest: Any) -> object:
            return answer(method, path.replace("/versions/2", "/versions/1"), **rest)

        client.request = other  # type: ignore[method-assign,assignment]
        with pytest.raises(DamagedError, match=r"of .*:v2 is that of .*:v1"):
            pull(client, origin.dataset, 2, tmp_path / "d", allowed_signers=signers.allowed)


@pytest.mark.parametrize(
    "damage", ["none", "lost", "flipped", "of another version", "by another key"]
)
def test_a_scrub_signs_again_what_has_no_good_signature(
    origin: Origin, signers: Signers, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    signature = origin.file_of_version("manifest.sha256.sig")
    good = signature.read_bytes()
    if damage == "lost":
        signature.unlink()
    elif damage == "flipped":
        signature.write_bytes(
            good[:200] + bytes([good[200] ^ 1]) + good[201:]
        )  # in place: the artifact rots with it
    elif damage == "of another version":
        signature.write_bytes(sign(b"another seal", signers.lab))
    elif damage == "by another key":
        assert run("sign", origin.file_of_version(""), "--key", signers.stranger)[0] == 0
    is_broken = damage not in ("none", "by another key")
    command = ("scrub", "--data", origin.context.settings.data)
    if is_broken:
        assert run(*command)[0] == 0  # without a key nobody knows that it should be signed
    monkeypatch.setenv("STICKSLIP_SIGNING_KEY", str(signers.lab))
    status, output = run(*command)
    assert (status, f"{origin.dataset}:v1  manifest.sha256.sig" in output) == (
        is_broken,
        is_broken,
    ), output
    assert run(*command)[0] == 0
    assert (signature.read_bytes() == good) == (damage != "by another key")
    with origin.context.database.read() as connection:
        assert not has_schedulable_job(connection)


def test_a_coordinator_does_not_start_with_a_key_that_cannot_sign(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "key").write_text("no key")
    (tmp_path / "key").chmod(0o600)
    assert (
        main(
            [
                "--data",
                str(tmp_path / "data"),
                "--port",
                "0",
                "--signing-key",
                str(tmp_path / "key"),
            ]
        )
        == 2
    )
    assert "cannot sign" in capsys.readouterr().err
