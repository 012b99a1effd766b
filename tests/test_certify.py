"""From `stickslip certify` to a dataset that carries the certificate: real protocols, a real
coordinator.
"""

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from stickslip_schemas.format.manifest import Manifest
from stickslip_schemas.spec.jobs import CONTACT_PROTOCOLS
from stickslip_services.cli import app
from stickslip_services.client.http import Client
from stickslip_services.local.making import read_certificate
from stickslip_testing.servers import RunningServer, served
from stickslip_testing.worker import BUILDS

CLOTH = {
    "kind": "cloth_drag",
    "axes": {
        "material": "gray-interlock",
        "mu": [0.1, 0.2],
        "texture": "dots",
        "viewpoint": "left",
    },
}
NOBODY = "http://127.0.0.1:9"

pytestmark = pytest.mark.real  # the workers' program measures in a process of its own


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    with served(tmp_path_factory.mktemp("certify") / "data") as running:
        yield running


@pytest.fixture(scope="module")
def cli(server: RunningServer) -> Callable[..., Result]:
    def run(*words: object, url: str = server.url) -> Result:
        return CliRunner().invoke(
            app, [str(word) for word in words], env={"STICKSLIP_URL": url, "COLUMNS": "200"}
        )

    return run


@pytest.fixture(scope="module")
def quick(cli: Callable[..., Result], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A certificate of the rod solver that was made while nobody listened."""
    out = tmp_path_factory.mktemp("certificates") / "rods"
    result = cli("certify", "--preset", "rods", "--out", out, "--quick", url=NOBODY)
    assert result.exit_code == 0, result.output
    assert "within the tolerances" in result.stdout
    assert f"stickslip register {out}" in result.stdout
    return out


def test_register_and_list(cli: Callable[..., Result], quick: Path) -> None:
    registered = cli("register", quick)
    assert registered.exit_code == 0, registered.output
    digest = read_certificate(quick).digest
    assert digest in registered.stdout
    assert cli("register", quick).stdout == registered.stdout
    (entry,) = json.loads(cli("certificates", "--json").stdout)
    assert (entry["digest"], entry["preset"], entry["extent"], entry["passed"]) == (
        digest,
        "rods",
        "quick",
        True,
    )
    assert digest[:16] in cli("certificates").stdout


def test_a_cloth_job_from_refusal_to_dataset(
    cli: Callable[..., Result], server: RunningServer, quick: Path, tmp_path: Path
) -> None:
    """The certificate is the rods' under the name of a preset of cloth.

    One of its reports stands for contact, too.
    """
    certificate = read_certificate(quick)
    build = certificate.sim_core
    builds = BUILDS.model_copy(update={"sim_core": build})
    worker = server.worker(kinds=("cloth_drag",), builds=builds)
    spec = tmp_path / "spec.json"
    spec.write_text(json.dumps(CLOTH))
    refused = cli("submit", spec)
    assert refused.exit_code == 1
    for words in (
        "preset",
        f"build {build[:12]}",
        "stickslip certify --preset certified",
        '"certified"',
    ):
        assert words in refused.stderr

    expected: dict[str, Any] = {"preset": "certified", "extent": "full"}
    alone = certificate.model_copy(update=expected)
    of_rods = certificate.protocols
    expected["protocols"] = (
        *of_rods,
        *(of_rods[0].model_copy(update={"protocol": name}) for name in CONTACT_PROTOCOLS),
    )
    full = certificate.model_copy(update=expected)
    with Client(server.url) as client:
        client.register(alone)
        refused = cli("submit", spec)
        assert refused.exit_code == 1
        assert (
            f"it must have {', '.join(CONTACT_PROTOCOLS)}, since cloth touches cloth"
            in refused.stderr
        )
        entry = client.register(full)
        assert client.request("GET", entry.href).content == full.canonical()
        submitted = cli("submit", spec)
        assert submitted.exit_code == 0, submitted.output
        worker.work()
        job = client.job(submitted.stdout.strip())
        assert job.dataset is not None
        manifest = client.contents(job.dataset.dataset, job.dataset.version).manifest
    assert isinstance(manifest, Manifest)
    assert manifest.certificate == entry.digest
    assert manifest.builds.sim_core == full.sim_core
    assert "this" in cli("certificates").stdout


def test_a_folder_without_a_certificate_is_refused_in_words(
    cli: Callable[..., Result], tmp_path: Path
) -> None:
    result = cli("register", tmp_path)
    assert result.exit_code == 1
    assert "there is no certificate.json" in result.stderr
    assert "Traceback" not in result.stderr


def test_an_old_certificate_is_not_taken_for_a_new_one(
    cli: Callable[..., Result], quick: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        sys, "executable", "/bin/false"
    )  # ends with status 1, as a preset that fails does
    result = cli("certify", "--preset", "rods", "--out", quick)
    assert result.exit_code == 1
    assert "no certificate was made: the workers' program ended with status 1" in result.stderr


def test_a_damaged_certificate_is_refused_in_words(
    cli: Callable[..., Result], quick: Path, tmp_path: Path
) -> None:
    document = json.loads((quick / "certificate.json").read_text())
    document["protocols"][0]["error"] = 0.5
    (tmp_path / "certificate.json").write_text(json.dumps(document))
    result = cli("register", tmp_path)
    assert result.exit_code == 1
    assert "is not a valid certificate" in result.stderr
    assert "largest of the curves' errors" in result.stderr
