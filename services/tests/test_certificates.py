"""Certificates: registered once, shown, and asked for before cloth is made."""

import re
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from sqlalchemy import update
from stickslip_schemas.base import JobState, Reason
from stickslip_schemas.documents.certificate import Certificate
from stickslip_schemas.format.manifest import Manifest
from stickslip_schemas.spec.jobs import CONTACT_PROTOCOLS
from stickslip_services.app import make_app
from stickslip_services.catalog.inputs import register_certificate
from stickslip_services.database.tables import certificates
from stickslip_services.errors import PresetNotCertifiedError
from stickslip_services.queue.context import Context
from stickslip_services.queue.estimate import validate_spec
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_testing.jobs import ManualClock, parsed, rods, show_job
from stickslip_testing.servers import serving
from stickslip_testing.worker import BUILDS, DirectApi, PretendWorker

KINDS = ("rod_hang", "cloth_drag", "cloth_scene")


def upload(
    *, protocols: tuple[str, ...] = ("stick-slip", *CONTACT_PROTOCOLS), **changes: Any
) -> Certificate:
    error = changes.pop("error", 0.001)
    report = {
        "x": "strain",
        "y": "mu",
        "tolerance": 0.01,
        "error": error,
        "passed": error <= 0.01,
        "settings": {},
        "build_hash": "d" * 64,
        "curves": [
            {"parameters": {}, "x": [0.1], "measured": [1.0], "master": [1.0], "errors": [error]}
        ],
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
    return Certificate.model_validate(content | changes)


def cloth(**rest: Any) -> Any:
    axes = {"material": "gray-interlock", "mu": [0.1, 0.2], "texture": "dots", "viewpoint": "left"}
    return parsed({"kind": "cloth_drag", "axes": axes, **rest})


def manifest_of(context: Context, job: Any) -> Manifest:
    detail = show_job(context, job.id)
    assert detail.state is JobState.succeeded, detail.message
    assert detail.dataset is not None
    return Manifest.model_validate_json(context.store.read(detail.dataset.manifest))


@pytest.fixture
def weaver(context: Context) -> PretendWorker:
    return PretendWorker(DirectApi(context), context.store, kinds=KINDS).register()


class TestTheRule:
    def test_cloth_needs_a_certificate(self, context: Context, weaver: PretendWorker) -> None:
        refusal = r"^preset 'certified' .* `stickslip certify --preset certified`"
        with pytest.raises(PresetNotCertifiedError, match=refusal):
            submit_job(context, cloth(), None)
        estimate = validate_spec(context, cloth())  # which counts all the same
        assert re.match(refusal, estimate.refusal or "")
        assert (estimate.sample_count, estimate.certificate, estimate.cached_count) == (
            2,
            None,
            None,
        )
        added = register_certificate(context.database, context.store, upload(), context.clock())
        assert validate_spec(context, cloth()).certificate == added.digest
        job = submit_job(context, cloth(), None)
        weaver.work()
        manifest = manifest_of(context, job)
        assert manifest.certificate == added.digest

    @pytest.mark.parametrize(
        "other",
        [{"preset": "fast"}, {"sim_core": "8" * 64}, {"extent": "quick"}, {"error": 0.02}],
        ids=["preset", "build", "quick", "failed"],
    )
    def test_no_other_certificate_will_do(
        self, context: Context, weaver: PretendWorker, other: dict[str, Any]
    ) -> None:
        register_certificate(context.database, context.store, upload(**other), context.clock())
        with pytest.raises(PresetNotCertifiedError):
            submit_job(context, cloth(), None)

    @pytest.mark.parametrize("missing", CONTACT_PROTOCOLS)
    def test_cloth_that_touches_cloth_needs_the_protocols_of_contact(
        self, context: Context, weaver: PretendWorker, missing: str
    ) -> None:
        has = tuple(name for name in ("stick-slip", *CONTACT_PROTOCOLS) if name != missing)
        added = register_certificate(
            context.database, context.store, upload(protocols=has), context.clock()
        )
        over = parsed(
            {
                "kind": "cloth_scene",
                "scene": "on-cloth",
                "axes": {"texture": "dots", "viewpoint": "high"},
            }
        )
        for touching in (cloth(), cloth(self_friction=0.0), over):
            with pytest.raises(
                PresetNotCertifiedError,
                match=f"it must have {missing}, since .* `self_friction: null`",
            ):
                submit_job(context, touching, None)
        assert validate_spec(context, cloth(self_friction=None)).certificate == added.digest
        job = submit_job(context, cloth(allow_uncertified=True), None)
        weaver.work()
        assert manifest_of(context, job).certificate is None

    def test_a_certificate_of_a_time_that_kept_no_protocols_counts_once_it_is_registered_again(
        self, context: Context, weaver: PretendWorker
    ) -> None:
        register_certificate(context.database, context.store, upload(), context.clock())
        with context.database.write() as connection:
            connection.execute(
                update(certificates).values(protocols="")
            )  # as the migration leaves it
        assert validate_spec(context, cloth()).refusal
        assert not validate_spec(context, cloth(self_friction=None)).refusal
        register_certificate(context.database, context.store, upload(), context.clock())
        assert not validate_spec(context, cloth()).refusal

    def test_the_full_one_that_came_last_stands(
        self, context: Context, weaver: PretendWorker, clock: ManualClock
    ) -> None:
        good = register_certificate(context.database, context.store, upload(), context.clock())
        register_certificate(
            context.database, context.store, upload(extent="quick", error=0.5), context.clock()
        )
        assert validate_spec(context, cloth()).certificate == good.digest
        register_certificate(context.database, context.store, upload(error=0.02), context.clock())
        assert validate_spec(context, cloth()).refusal
        clock.advance(1)
        register_certificate(context.database, context.store, upload(), context.clock())
        assert validate_spec(context, cloth()).certificate == good.digest

    def test_uncertified_where_the_spec_says_so(
        self, context: Context, weaver: PretendWorker
    ) -> None:
        job = submit_job(context, cloth(allow_uncertified=True), None)
        weaver.work()
        manifest = manifest_of(context, job)
        assert manifest.certificate is None
        assert manifest.model_dump()["spec"]["allow_uncertified"] is True

    def test_a_certificate_that_comes_later_makes_a_version_and_no_sample(
        self, context: Context, weaver: PretendWorker
    ) -> None:
        submit_job(context, cloth(allow_uncertified=True), None)
        weaver.work()
        added = register_certificate(context.database, context.store, upload(), context.clock())
        before = len(weaver.finished_ids)
        job = submit_job(context, cloth(allow_uncertified=True), None)
        weaver.work()
        assert [name.partition("-")[0] for name in weaver.finished_ids[before:]] == ["publish"]
        manifest = manifest_of(context, job)
        assert (manifest.version, manifest.certificate) == (2, added.digest)
        # And the strict spec shares every sample with the lenient one.
        before = len(weaver.finished_ids)
        submit_job(context, cloth(), None)
        weaver.work()
        assert {name.partition("-")[0] for name in weaver.finished_ids[before:]} == {"publish"}

    def test_rods_need_none_and_carry_what_there_is(
        self, context: Context, worker: PretendWorker
    ) -> None:
        job = submit_job(context, parsed(rods()), None)
        worker.work()
        assert manifest_of(context, job).certificate is None
        added = register_certificate(
            context.database, context.store, upload(preset="rods"), context.clock()
        )
        job = submit_job(context, parsed(rods()), None)
        worker.work()
        assert manifest_of(context, job).certificate == added.digest

    def test_a_job_that_waited_for_a_worker_fails_with_the_reason(self, context: Context) -> None:
        early = submit_job(context, cloth(), None)
        lenient = submit_job(context, cloth(allow_uncertified=True), None)
        PretendWorker(DirectApi(context), context.store, kinds=KINDS).register()
        detail = show_job(context, early.id)  # type: ignore[union-attr]  # no replay
        assert (detail.state, detail.reason) == (JobState.failed, Reason.preset_not_certified)
        assert "stickslip certify" in detail.message
        assert show_job(context, lenient.id).state is JobState.queued  # type: ignore[union-attr]


class TestHttp:
    @pytest.fixture
    def app(self, settings: Settings) -> FastAPI:
        return make_app(settings)

    def test_register_list_and_show(self, app: FastAPI) -> None:
        with serving(app) as url, httpx.Client(base_url=url) as client:
            body = upload().model_dump(mode="json")
            first = client.post("/v1/certificates", json=body)
            assert first.status_code == 201, first.text
            body["environment"] = {"python": "another"}
            again = client.post("/v1/certificates", json=body)
            (entry,) = client.get("/v1/certificates").json()["items"]
            assert entry == again.json()
            assert entry == first.json() | {"created_at": entry["created_at"]}
            assert first.headers["location"] == entry["href"]
            response = client.get(entry["href"])
            assert Certificate.model_validate_json(response.content).digest == entry["digest"]
            for path in (
                "/v1/certificates/abc",
                f"/v1/certificates/{'0' * 64}",
                "/v1/certificates/..%2f..%2fx",
            ):
                assert client.get(path).json()["code"] == "not_found"

    def test_a_lying_certificate_is_refused(self, app: FastAPI) -> None:
        with serving(app) as url, httpx.Client(base_url=url) as client:
            body = upload(error=0.02).model_dump(mode="json")
            body["passed"] = True
            answer = client.post("/v1/certificates", json=body)
            assert (answer.status_code, answer.json()["code"]) == (422, "validation_failed")
            assert answer.json()["errors"][0]["pointer"] == ""
            assert client.get("/v1/certificates").json()["items"] == []

    def test_the_refusal_says_where_and_what_to_do(self, app: FastAPI) -> None:
        with serving(app) as url, httpx.Client(base_url=url) as client:
            PretendWorker(
                DirectApi(app.state.context), app.state.context.store, kinds=KINDS
            ).register()
            answer = client.post("/v1/jobs", json=cloth(preset="fast").model_dump(mode="json"))
            problem = answer.json()
            assert (answer.status_code, problem["code"]) == (409, "preset_not_certified")
            (field,) = problem["errors"]
            assert (field["pointer"], field["value"]) == ("/preset", '"fast"')
            assert "stickslip certify --preset fast" in field["rule"]
            assert "allow_uncertified" in field["rule"]
