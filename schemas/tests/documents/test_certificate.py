"""A certificate says one thing only, and its digest does not depend on where it was made."""

from typing import Any

import pytest
from pydantic import ValidationError
from stickslip_schemas.documents.certificate import Certificate
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.plan.points import publish_key
from stickslip_testing.samples import samples

BUILDS = Builds(sim_core="a" * 64, simulate="a" * 64, render="b" * 64, pack="c" * 64)


def protocol(**changes: Any) -> dict[str, Any]:
    curve = {
        "parameters": {},
        "x": [1.0, 2.0],
        "measured": [1.0, None],
        "master": [1.0, None],
        "errors": [0.0, 0.0],
    }
    return {
        "protocol": "stick-slip",
        "x": "strain",
        "y": "mu",
        "tolerance": 0.01,
        "error": 0.0,
        "passed": True,
        "settings": {"cells": 50},
        "build_hash": "d" * 64,
        "curves": [curve],
    } | changes


def document(**changes: Any) -> dict[str, Any]:
    return {
        "preset": "certified",
        "numbers": {"dt": 0.01},
        "sim_core": "a" * 64,
        "protocol_sources": "b" * 64,
        "extent": "full",
        "protocols": [protocol()],
        "passed": True,
        "environment": {"python": "3.11"},
    } | changes


def off_by(error: float | None) -> list[dict[str, Any]]:
    return [{"parameters": {}, "x": [1.0], "measured": [1.0], "master": [1.0], "errors": [error]}]


def test_round_trip() -> None:
    certificate = Certificate.model_validate(document())
    assert certificate.certifies
    assert Certificate.model_validate_json(certificate.canonical()) == certificate


def test_the_environment_is_no_content() -> None:
    digest = Certificate.model_validate(document()).digest
    assert Certificate.model_validate(document(environment={})).digest == digest
    assert Certificate.model_validate(document(numbers={"dt": 0.02})).digest != digest
    assert Certificate.model_validate(document(sim_core="e" * 64)).digest != digest


def test_a_quick_or_failed_one_certifies_nothing() -> None:
    assert not Certificate.model_validate(document(extent="quick")).certifies
    failed = protocol(curves=off_by(-0.02), error=0.02, passed=False)
    assert not Certificate.model_validate(document(protocols=[failed], passed=False)).certifies


CONTRADICTIONS: dict[str, tuple[dict[str, Any], str]] = {
    "passed with a failed protocol": (
        document(protocols=[protocol(curves=off_by(0.02), error=0.02, passed=False)]),
        "all protocols passed",
    ),
    "passed with a step that did not converge": (
        document(protocols=[protocol(settings={"unconverged_steps": 1})]),
        "all steps have converged",
    ),
    "passed beyond the tolerance": (
        document(protocols=[protocol(curves=off_by(0.02), error=0.02)]),
        "within their tolerances",
    ),
    "passed with an infinite error": (
        document(protocols=[protocol(curves=off_by(None), error=None)]),
        "within",
    ),
    "an error that is not that of the curves": (
        document(protocols=[protocol(curves=off_by(0.5))]),
        "largest of the curves' errors",
    ),
    "passed without a measurement": (
        document(protocols=[protocol(curves=[], error=None)]),
        "within",
    ),
    "passed though it broke off": (document(protocols=[protocol(message="no")]), "within"),
    "a protocol twice": (document(protocols=[protocol(), protocol()]), "there once"),
    "two builds": (
        document(protocols=[protocol(), protocol(protocol="cantilever", build_hash="e" * 64)]),
        "one build",
    ),
    "no protocol": (document(protocols=[]), "at least 1 item"),
    "curves of two lengths": (
        document(protocols=[protocol(curves=[off_by(0.0)[0] | {"x": []}])]),
        "one length",
    ),
    "a digest that is none": (document(sim_core="latest"), "pattern"),
}


@pytest.mark.parametrize("contradiction", CONTRADICTIONS)
def test_contradictions_are_refused(contradiction: str) -> None:
    wrong, words = CONTRADICTIONS[contradiction]
    with pytest.raises(ValidationError, match=words):
        Certificate.model_validate(wrong)


def test_allow_uncertified_changes_no_sample() -> None:
    axes = {"material": "gray-interlock", "mu": [0.1, 0.2], "texture": "dots", "viewpoint": "left"}
    strict, lenient = (
        job_spec_adapter.validate_python(
            {"kind": "cloth_drag", "axes": axes, "allow_uncertified": allowed}
        )
        for allowed in (False, True)
    )
    assert [s.key for s in samples(strict, BUILDS)] == [s.key for s in samples(lenient, BUILDS)]
    assert strict.content_digest != lenient.content_digest
    assert strict.certified_preset == "certified"


def test_a_certificate_makes_another_version_of_the_dataset() -> None:
    spec = job_spec_adapter.validate_python(
        {"kind": "rod_hang", "axes": {"gamma": 1, "phi0": 1, "phi1": 6}}
    )
    assert publish_key(spec, ["a" * 64], BUILDS, "e" * 64) != publish_key(spec, ["a" * 64], BUILDS)
    assert spec.certified_preset == "rods"
