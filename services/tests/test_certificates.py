"""Certificates: registered once, shown, and asked for before cloth is made."""

import re
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from sqlalchemy import update
from stickslip_schemas.base.states import JobState, Reason
from stickslip_schemas.documents.certificate import Certificate, CertificateUpload
from stickslip_schemas.format.manifest import Manifest
from stickslip_schemas.spec.jobs import CONTACT_PROTOCOLS
from stickslip_services.coordinator import make_app
from stickslip_services.database.tables import certificates
from stickslip_services.errors import PresetNotCertifiedError
from stickslip_services.queue.coordinator import Coordinator
from stickslip_services.queue.validating import validate
from stickslip_services.settings import Settings
from stickslip_testing.jobs import ManualClock, parsed, rods, show_job
from stickslip_testing.servers import serving
from stickslip_testing.worker import BUILDS, PretendWorker

KINDS = ("rod_hang", "cloth_drag", "cloth_on_cloth", "cloth_sphere")
PAGE = "<!doctype html><title>c</title>"


def upload(*, protocols: tuple[str, ...] = ("stick-slip", *CONTACT_PROTOCOLS), **changes: Any) -> CertificateUpload:
    error = changes.pop("error", 0.001)
    report = {
        "x": "strain",
        "y": "mu",
        "tolerance": 0.01,
        "error": error,
        "passed": error <= 0.01,
        "settings": {},
        "build_hash": "d" * 64,
        "curves": [{"parameters": {}, "x": [0.1], "measured": [1.0], "master": [1.0], "errors": [error]}],
    }
    content = {
        "preset": "certified",
        "numbers": {},
        "sim_core": BUILDS.sim_core,
        "protocol_sources": "f" * 64,
        "extent": "full",
        "protocols": [report | {"protocol": name} for name in protocols],
        "passed": error <= 0.01,
        "environment": {},
    }
    return CertificateUpload(certificate=Certificate.model_validate(content | changes), page=PAGE)


def cloth(**rest: Any) -> Any:
    axes = {"material": "gray-interlock", "mu": [0.1, 0.2], "texture": "dots", "viewpoint": "left"}
    return parsed({"kind": "cloth_drag", "axes": axes, **rest})


def manifest_of(coordinator: Coordinator, job: Any) -> Manifest:
    shown = show_job(coordinator, job.id)
    assert shown.state is JobState.succeeded, shown.message
    assert shown.dataset is not None
    return Manifest.model_validate_json(coordinator.store.read(shown.dataset.manifest))


@pytest.fixture
def weaver(coordinator: Coordinator) -> PretendWorker:
    return PretendWorker(coordinator, coordinator.store, kinds=KINDS).register()


class TestTheRule:
    def test_cloth_needs_a_certificate(self, coordinator: Coordinator, weaver: PretendWorker) -> None:
        refusal = r"^preset 'certified' .* `stickslip certify --preset certified`"
        with pytest.raises(PresetNotCertifiedError, match=refusal):
            coordinator.submit(cloth(), None)
        told = validate(coordinator.database, cloth())  # which counts all the same
        assert re.match(refusal, told.refusal or "")
        assert (told.sample_count, told.certificate, told.cached_count) == (2, None, None)
        added = coordinator.add_certificate(upload())
        assert validate(coordinator.database, cloth()).certificate == added.digest
        job = coordinator.submit(cloth(), None)
        weaver.work()
        manifest = manifest_of(coordinator, job)
        assert manifest.certificate == added.digest

    @pytest.mark.parametrize(
        "other",
        [{"preset": "fast"}, {"sim_core": "8" * 64}, {"extent": "quick"}, {"error": 0.02}],
        ids=["preset", "build", "quick", "failed"],
    )
    def test_no_other_certificate_will_do(
        self, coordinator: Coordinator, weaver: PretendWorker, other: dict[str, Any]
    ) -> None:
        coordinator.add_certificate(upload(**other))
        with pytest.raises(PresetNotCertifiedError):
            coordinator.submit(cloth(), None)

    @pytest.mark.parametrize("missing", CONTACT_PROTOCOLS)
    def test_cloth_that_touches_cloth_needs_the_protocols_of_contact(
        self, coordinator: Coordinator, weaver: PretendWorker, missing: str
    ) -> None:
        has = tuple(name for name in ("stick-slip", *CONTACT_PROTOCOLS) if name != missing)
        added = coordinator.add_certificate(upload(protocols=has))
        axes = {"material": "gray-interlock", "mu": 0.1, "texture": "dots"}
        over = parsed(
            {"kind": "cloth_on_cloth", "axes": axes | {"viewpoint": "left", "substrate_material": "gray-interlock"}}
        )
        for touching in (cloth(), cloth(self_friction=0.0), over):
            with pytest.raises(
                PresetNotCertifiedError, match=f"it must have {missing}, since .* `self_friction: null`"
            ):
                coordinator.submit(touching, None)
        ball = parsed({"kind": "cloth_sphere", "axes": axes | {"viewpoint": "high", "angular_speed": 1.0}})
        for alone in (cloth(self_friction=None), ball):
            assert validate(coordinator.database, alone).certificate == added.digest
        job = coordinator.submit(cloth(allow_uncertified=True), None)
        weaver.work()
        assert manifest_of(coordinator, job).certificate is None

    def test_a_certificate_of_a_time_that_kept_no_protocols_counts_once_it_is_registered_again(
        self, coordinator: Coordinator, weaver: PretendWorker
    ) -> None:
        coordinator.add_certificate(upload())
        with coordinator.database.write() as connection:
            connection.execute(update(certificates).values(protocols=""))  # as the migration leaves it
        assert validate(coordinator.database, cloth()).refusal
        assert not validate(coordinator.database, cloth(self_friction=None)).refusal
        coordinator.add_certificate(upload())
        assert not validate(coordinator.database, cloth()).refusal

    def test_the_full_one_that_came_last_stands(
        self, coordinator: Coordinator, weaver: PretendWorker, clock: ManualClock
    ) -> None:
        good = coordinator.add_certificate(upload())
        coordinator.add_certificate(upload(extent="quick", error=0.5))
        assert validate(coordinator.database, cloth()).certificate == good.digest
        coordinator.add_certificate(upload(error=0.02))
        assert validate(coordinator.database, cloth()).refusal
        clock.advance(1)
        coordinator.add_certificate(upload())
        assert validate(coordinator.database, cloth()).certificate == good.digest

    def test_uncertified_where_the_spec_says_so(self, coordinator: Coordinator, weaver: PretendWorker) -> None:
        job = coordinator.submit(cloth(allow_uncertified=True), None)
        weaver.work()
        manifest = manifest_of(coordinator, job)
        assert manifest.certificate is None
        assert manifest.model_dump()["spec"]["allow_uncertified"] is True

    def test_a_certificate_that_comes_later_makes_a_version_and_no_sample(
        self, coordinator: Coordinator, weaver: PretendWorker
    ) -> None:
        coordinator.submit(cloth(allow_uncertified=True), None)
        weaver.work()
        added = coordinator.add_certificate(upload())
        before = len(weaver.ran)
        job = coordinator.submit(cloth(allow_uncertified=True), None)
        weaver.work()
        assert [name.partition("-")[0] for name in weaver.ran[before:]] == ["publish"]
        manifest = manifest_of(coordinator, job)
        assert (manifest.version, manifest.certificate) == (2, added.digest)
        # And the strict spec shares every sample with the lenient one.
        before = len(weaver.ran)
        coordinator.submit(cloth(), None)
        weaver.work()
        assert {name.partition("-")[0] for name in weaver.ran[before:]} == {"publish"}

    def test_rods_need_none_and_carry_what_there_is(self, coordinator: Coordinator, worker: PretendWorker) -> None:
        job = coordinator.submit(parsed(rods()), None)
        worker.work()
        assert manifest_of(coordinator, job).certificate is None
        added = coordinator.add_certificate(upload(preset="rods"))
        job = coordinator.submit(parsed(rods()), None)
        worker.work()
        assert manifest_of(coordinator, job).certificate == added.digest

    def test_a_job_that_waited_for_a_worker_fails_with_the_reason(self, coordinator: Coordinator) -> None:
        early = coordinator.submit(cloth(), None)
        lenient = coordinator.submit(cloth(allow_uncertified=True), None)
        PretendWorker(coordinator, coordinator.store, kinds=KINDS).register()
        shown = show_job(coordinator, early.id)  # type: ignore[union-attr]  # no replay
        assert (shown.state, shown.reason) == (JobState.failed, Reason.preset_not_certified)
        assert "stickslip certify" in shown.message
        assert show_job(coordinator, lenient.id).state is JobState.queued  # type: ignore[union-attr]


class TestHttp:
    @pytest.fixture
    def app(self, settings: Settings) -> FastAPI:
        return make_app(settings)

    def test_register_list_and_show(self, app: FastAPI) -> None:
        with serving(app) as url, httpx.Client(base_url=url) as client:
            body = upload().model_dump(mode="json")
            first = client.post("/v1/certificates", json=body)
            assert first.status_code == 201, first.text
            body["certificate"]["environment"] = {"python": "another"}
            again = client.post("/v1/certificates", json=body)
            (entry,) = client.get("/v1/certificates").json()["items"]
            assert entry == again.json()
            assert entry == first.json() | {"created_at": entry["created_at"]}
            assert first.headers["location"] == entry["href"]
            shown = client.get(entry["href"])
            assert Certificate.model_validate_json(shown.content).digest == entry["digest"]
            page = client.get(entry["page"])
            assert page.text == PAGE
            assert page.headers["content-type"].startswith("text/html")
            assert "sandbox" in page.headers["content-security-policy"]
            assert "default-src 'none'" in page.headers["content-security-policy"]
            for path in ("/v1/certificates/abc", f"/v1/certificates/{'0' * 64}/page", "/v1/certificates/..%2f..%2fx"):
                assert client.get(path).json()["code"] == "not_found"

    def test_a_lying_certificate_is_refused(self, app: FastAPI) -> None:
        with serving(app) as url, httpx.Client(base_url=url) as client:
            body = upload(error=0.02).model_dump(mode="json")
            body["certificate"]["passed"] = True
            answer = client.post("/v1/certificates", json=body)
            assert (answer.status_code, answer.json()["code"]) == (422, "validation_failed")
            assert answer.json()["errors"][0]["pointer"] == "/certificate"
            assert client.get("/v1/certificates").json()["items"] == []

    def test_the_refusal_says_where_and_what_to_do(self, app: FastAPI) -> None:
        with serving(app) as url, httpx.Client(base_url=url) as client:
            PretendWorker(app.state.coordinator, app.state.coordinator.store, kinds=KINDS).register()
            answer = client.post("/v1/jobs", json=cloth(preset="fast").model_dump(mode="json"))
            problem = answer.json()
            assert (answer.status_code, problem["code"]) == (409, "preset_not_certified")
            (field,) = problem["errors"]
            assert (field["pointer"], field["value"]) == ("/preset", '"fast"')
            assert "stickslip certify --preset fast" in field["rule"]
            assert "allow_uncertified" in field["rule"]
