"""Cards of fabrics on the command line: files beside a spec, the list, and the laboratory."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from click.testing import CliRunner, Result
from stickslip_schemas.documents.certificate import Certificate
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.spec.reality import measured_fabrics, reality
from stickslip_services.cli import app
from stickslip_services.cli.documents import read_job, read_scene
from stickslip_services.errors import CommandError
from stickslip_services.pages.rendering import html_page

LINEN = {
    "density": 0.2,
    "bending": {"warp": 12, "weft": 9, "diagonal": 8, "unit": "uN m"},
    "stretching": "gray-interlock",
    "source": "by hand",
}


def written(folder: Path, name: str, document: dict[str, Any]) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(document))
    return path


def drag(material: object, **more: object) -> dict[str, Any]:
    axes = {"material": material, "mu": 0.3, "texture": "dots", "viewpoint": "left"}
    return {"kind": "cloth_drag", "axes": axes, **more}


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments))


def test_a_card_beside_a_spec_is_sent_with_it(tmp_path: Path) -> None:
    written(tmp_path, "fabrics/linen.yaml", LINEN)
    written(tmp_path, "fabrics/unused.yaml", {"density": -1.0})
    spec = written(tmp_path, "spec.yaml", drag(["linen", "gray-interlock"]))
    document, files = read_job(spec)
    assert not files
    assert list(document["materials"]) == ["linen"]
    assert document["materials"]["linen"]["bending"] == pytest.approx([1.2e-5, 9e-6, 2.75e-6])
    assert job_spec_adapter.validate_python(document).sample_count == 2


def test_a_card_beside_a_scene_is_sent_with_it(tmp_path: Path) -> None:
    written(tmp_path, "fabrics/linen.yaml", LINEN)
    scene = {
        "format": "stickslip-scene/1",
        "duration": 0.1,
        "default_friction": 0.3,
        "sheets": {
            "cloth": {
                "material": "linen",
                "mesh": {"type": "grid", "size": [0.1, 0.1], "cells": [5, 5]},
            }
        },
    }
    document, _ = read_scene(written(tmp_path, "scene.yaml", scene))
    card = document.materials["linen"]
    assert card is not None
    assert card.source == "by hand"
    # An axis of a built-in scene may name it, too.
    axes = {"fabric": ["linen", "royal-target"], "texture": "dots", "viewpoint": "front"}
    job = {"kind": "cloth_scene", "scene": "peg", "axes": axes}
    spec = job_spec_adapter.validate_python(read_job(written(tmp_path, "job.yaml", job))[0])
    assert spec.sample_count == 2


@pytest.mark.parametrize(
    ("name", "card", "rule"),
    [
        ("linen", {**LINEN, "density": 0.0}, "density: must be greater than or equal to 0.01"),
        ("linen", {**LINEN, "bending": [0.012, 0.009, 0.004]}, "is it in mN m"),
        ("gray-interlock", LINEN, "is the name of a built-in fabric"),
    ],
)
def test_a_wrong_card_is_refused_by_its_file(
    tmp_path: Path, name: str, card: dict[str, Any], rule: str
) -> None:
    written(tmp_path, f"fabrics/{name}.yaml", card)
    with pytest.raises(CommandError) as caught:
        read_job(written(tmp_path, "spec.yaml", drag(name)))
    assert rule in str(caught.value)
    assert f"{name}.yaml" in str(caught.value)


def test_two_cards_of_one_name_are_refused(tmp_path: Path) -> None:
    written(tmp_path, "fabrics/linen.yaml", LINEN)
    spec = written(tmp_path, "spec.yaml", drag("linen", materials={"linen": LINEN}))
    with pytest.raises(CommandError, match="must not define the fabric linen"):
        read_job(spec)


def test_the_built_in_fabrics_are_listed_with_their_bending_lengths() -> None:
    listed = json.loads(run("fabrics", "--json").stdout)
    assert listed["gray-interlock"]["bending_length"] == [13.0, 16.1]
    assert "11oz-black-denim" in run("fabrics").stdout


def test_a_certificate_is_shown_beside_measurements() -> None:
    page = html_page(
        "certificate.html",
        here="certificates",
        certificate=Certificate.model_construct(
            preset="fast",
            numbers={},
            sim_core="0" * 64,
            protocol_sources="0" * 64,
            passed=True,
            extent="full",
            environment={},
            protocols=(),
        ),
        digest="1" * 64,
        builds=set(),
        plots={},
        reality=reality(),
        fabrics=measured_fabrics(),
    ).body
    text = bytes(page).decode()
    assert "Against measurements" in text
    assert "<td>13, 16.1</td>" in text
    assert "denim 70 to 90 %" in text
    assert "hysteresis of bending" in text


def test_the_laboratory_tests_a_card_of_a_file(tmp_path: Path) -> None:
    card = written(tmp_path, "linen.yaml", LINEN)
    result = run("lab", "cantilever", str(card), "--json")
    answer = json.loads(result.stdout)
    assert answer["warp"]["bending_length_mm"] == pytest.approx(18.29, rel=2e-3)


@pytest.mark.parametrize(
    ("card", "rule"),
    [
        ("denim", "did you mean 11oz-black-denim"),
        ("denim.yaml", "there is no file denim.yaml"),
    ],
)
def test_the_laboratory_refuses_what_is_no_card(card: str, rule: str) -> None:
    result = run("lab", "tilt", card)
    assert result.exit_code == 1
    assert rule in " ".join(result.stderr.split())
