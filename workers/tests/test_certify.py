"""Certifying: real protocols, one file, and a build's own digest."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from stickslip_schemas.documents.certificate import Certificate
from stickslip_sim_core import build_info, protocols
from stickslip_sim_core.protocols import Certification, result
from stickslip_workers.__main__ import main
from stickslip_workers.builds import solver_build
from stickslip_workers.commands import certify

pytestmark = pytest.mark.physics

ROD_SOLVER = "stickslip_sim_core.rods"
LITTLE = {"rod-cantilever": {"gamma": (1.0, 100.0), "elements": 512}}


@pytest.fixture
def presets(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two presets that are quick to certify; the second protocol of one breaks off."""
    presets_made = {
        "good": Certification(
            ("rod-lateral-buckling", "rod-cantilever"),
            ROD_SOLVER,
            lambda: {"dt": 0.01, "solver": "<b>"},
            LITTLE,
        ),
        "coarse": Certification(
            ("rod-cantilever", "rod-lateral-buckling"),
            ROD_SOLVER,
            quick={
                "rod-cantilever": {"gamma": (1e4,), "elements": 16},
                "rod-lateral-buckling": {"elements": 7},
            },
        ),
    }
    monkeypatch.setattr(protocols, "CERTIFICATION", presets_made)
    monkeypatch.setattr(result, "POINTS", 5)  # of curves that are only drawn


def read(folder: Path) -> Certificate:
    return Certificate.model_validate_json((folder / "certificate.json").read_bytes())


@pytest.mark.usefixtures("presets")
class TestCertify:
    def test_a_preset_that_passes(self, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
        assert main(["certify", "--preset", "good", "--out", str(tmp_path / "a"), "--quick"]) == 0
        certificate = read(tmp_path / "a")
        out, err = capfd.readouterr()
        assert out.strip() == certificate.digest
        assert "1/2 rod-lateral-buckling" in err
        assert "passed, largest error" in err
        assert (certificate.passed, certificate.extent, certificate.certifies) == (
            True,
            "quick",
            False,
        )
        assert certificate.sim_core == solver_build(ROD_SOLVER)
        assert certificate.numbers == {"dt": 0.01, "solver": "<b>"}
        assert [report.build_hash for report in certificate.protocols] == [
            build_info().build_hash
        ] * 2
        assert certificate.protocols[1].settings == {"elements": 512}
        assert {"cpu_seconds/rod-cantilever", "processor"} <= set(certificate.environment)

    def test_twice_is_the_same(self, tmp_path: Path) -> None:
        first, second = (
            certify("good", tmp_path / name, quick=True, say=lambda _: None) for name in "ab"
        )
        assert first.digest == second.digest

    def test_a_preset_that_does_not_pass(
        self, tmp_path: Path, capfd: pytest.CaptureFixture[str]
    ) -> None:
        assert main(["certify", "--preset", "coarse", "--out", str(tmp_path), "--quick"]) == 1
        cantilever, buckling = read(tmp_path).protocols
        assert not cantilever.passed
        assert cantilever.error is not None
        assert cantilever.error > cantilever.tolerance
        assert (
            buckling.message
            == "ValueError: elements: must be a multiple of 4 and at least 16, got 7"
        )
        assert buckling.curves == ()
        assert "broke off" in capfd.readouterr().err

    def test_a_full_one_is_run_with_the_protocols_own_settings(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        asked: list[Any] = []
        run = protocols.run

        def note(name: str, preset: str | None = None, **settings: Any) -> Any:
            asked.append((name, preset, settings))
            return run(name, preset, **(settings or LITTLE.get(name, {})))

        monkeypatch.setattr(protocols, "run", note)
        certificate = certify("good", tmp_path, quick=False, say=lambda _: None)
        assert asked == [("rod-lateral-buckling", "good", {}), ("rod-cantilever", "good", {})]
        assert certificate.certifies

    def test_settings_that_are_not_json_are_a_protocol_that_broke_off(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        run = protocols.run

        def spoil(name: str, preset: str | None = None, **settings: Any) -> Any:
            result = run(name, preset, **settings)
            return (
                replace(result, settings={"mesh": object()}) if name == "rod-cantilever" else result
            )

        monkeypatch.setattr(protocols, "run", spoil)
        certificate = certify("good", tmp_path, quick=True, say=lambda _: None)
        assert [report.passed for report in certificate.protocols] == [True, False]

    def test_an_unknown_preset(self, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
        assert main(["certify", "--preset", "best", "--out", str(tmp_path / "no")]) == 2
        assert "preset: must be one of good, coarse, got 'best'" in capfd.readouterr().err
        assert not (tmp_path / "no").exists()
