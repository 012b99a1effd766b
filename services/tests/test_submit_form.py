"""The form that submits a job: fields from the schema, the spec from fields, faults by field."""

import html
import re
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import httpx
import pytest
import yaml
from stickslip_schemas.kinds import KINDS, job_spec_adapter
from stickslip_schemas.scene.library import load_scene, scene_names
from stickslip_services.pages.rendering import spec_text
from stickslip_services.pages.submit_filling import filled_form
from stickslip_services.pages.submit_form import FormError, document_of, field_of, form_of, grouped
from stickslip_testing.servers import RunningServer

FORM = {"Content-Type": "application/x-www-form-urlencoded"}

BELT = [
    ("kind", "cloth_scene"),
    ("scene", "belt"),
    ("name", "ten-belts"),
    ("axes.mu.form", "linspace"),
    ("axes.mu.from", "0.1"),
    ("axes.mu.to", "0.9"),
    ("axes.mu.num", "10"),
    ("axes.texture.values", "checker"),
    ("axes.viewpoint.values", "front"),
    ("quality", "preview"),
    ("frames", "8"),
    ("allow_uncertified", "yes"),
    ("store_positions", "yes"),
]


def test_a_form_gives_the_spec_that_it_shows() -> None:
    form = form_of("cloth_scene", "belt")
    document = document_of(form, grouped(BELT))
    assert document == {
        "kind": "cloth_scene",
        "name": "ten-belts",
        "scene": "belt",
        "axes": {
            "mu": {"type": "linspace", "start": 0.1, "stop": 0.9, "num": 10},
            "texture": "checker",
            "viewpoint": "front",
        },
        "quality": "preview",
        "frames": 8,
        "allow_uncertified": True,
    }
    assert job_spec_adapter.validate_python(document).sample_count == 10


def test_fabrics_are_drawn_where_a_number_of_them_is_given() -> None:
    fields = [
        ("axes.material.values", "gray-interlock"),
        ("axes.material.num", "5"),
        ("axes.mu.values", "0.3"),
        ("axes.texture.values", "dots"),
        ("axes.viewpoint.values", "left"),
        ("store_positions", "yes"),
    ]
    document = document_of(form_of("cloth_drag", None), grouped(fields))
    assert document["axes"]["material"] == {"distribution": "measured-618", "num": 5}
    assert job_spec_adapter.validate_python(document).sample_count == 5
    belt = document_of(form_of("cloth_scene", "belt"), grouped([*BELT, ("axes.fabric.num", "3")]))
    assert job_spec_adapter.validate_python(belt).sample_count == 30


@pytest.mark.parametrize("kind", KINDS)
def test_every_key_of_every_kind_has_a_field_or_is_named(kind: str) -> None:
    form = form_of(kind, None)
    schema = KINDS[kind].model_json_schema()
    known = {setting.name for setting in form.settings} | set(form.yaml_keys)
    assert known | {"kind", "name", "scene", "set", "axes"} >= set(schema["properties"])
    axes = schema["$defs"][schema["properties"]["axes"]["$ref"].rpartition("/")[2]]
    assert {axis.name for axis in form.axes} >= set(axes["properties"])


@pytest.mark.parametrize("scene", scene_names())
def test_the_form_of_a_scene_is_ready_to_submit(scene: str) -> None:
    form = form_of("cloth_scene", scene)
    first = [
        (f"axes.{axis.name}.values", axis.choices[0]) for axis in form.axes if axis.is_required
    ]
    document = document_of(form, grouped([*first, ("store_positions", "yes")]))
    assert set(document) == {"kind", "scene", "axes"}
    job_spec_adapter.validate_python(document)


def sent(**values: str) -> dict[str, list[str]]:
    return {name.replace("__", "."): [value] for name, value in values.items()}


def test_values_are_read_as_they_are_written() -> None:
    form = form_of("rod_hang", None)

    def gamma(**values: str) -> Any:
        return document_of(form, sent(**values))["axes"].get("gamma")

    assert gamma(axes__gamma__values="1, 2.5;3\n4") == [1, 2.5, 3, 4]
    assert gamma(axes__gamma__values=" 7 ") == 7
    assert gamma(axes__gamma__values="") is None
    assert gamma(axes__gamma__values="many") == "many"  # the model refuses it with its rule
    assert gamma(axes__gamma__form="sobol", axes__gamma__from="1", axes__gamma__num="4") == {
        "type": "sobol",
        "low": 1,
        "num": 4,
    }
    with pytest.raises(FormError, match="must be one of values, linspace, random, sobol"):
        gamma(axes__gamma__form="spiral")
    more = document_of(form, sent(more="views: null\naxes: {phi0: 2}", axes__phi1__values="3"))
    assert (more["views"], more["axes"]) == (None, {"phi1": 3, "phi0": 2})
    for wrong in ("a: [", "just a word", "- 1", "x: !!binary aGk=", "x: !!set {a}", "1: 2"):
        with pytest.raises(FormError, match=r"more: (is not YAML|must be keys|must have values)"):
            document_of(form, sent(more=wrong))


EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.yaml"))


def own_scene() -> dict[str, Any]:
    """Return a spec with a scene that is not built in."""
    scene = load_scene("peg").model_dump(mode="json", exclude_unset=True) | {"name": "mine"}
    axes = {"mu": [0.2, 0.4], "texture": "dots", "viewpoint": "front"}
    return {"kind": "cloth_scene", "scene": scene, "axes": axes, "frames": 8}


def built_in_scene(name: str) -> dict[str, Any]:
    axes = {"texture": ["checker", "dots"], "viewpoint": "front", "lighting": "room"}
    return {"kind": "cloth_scene", "scene": name, "axes": axes, "measured": 0.5}


SPECS = {
    **{path.stem: yaml.safe_load(path.read_text()) for path in EXAMPLES},
    **{name: built_in_scene(name) for name in scene_names()},
    "own scene": own_scene(),
}


@pytest.mark.parametrize("document", SPECS.values(), ids=SPECS)
def test_a_form_that_a_job_filled_in_gives_its_spec_again(document: dict[str, Any]) -> None:
    """So does its YAML, and a change of one field changes that field alone."""
    spec = job_spec_adapter.validate_python(document)
    form, filling = filled_form(spec)
    again = job_spec_adapter.validate_python(document_of(form, filling.fields))
    assert again.model_dump(mode="json") == spec.model_dump(mode="json")
    parsed_again = job_spec_adapter.validate_python(yaml.safe_load(spec_text(spec)))
    assert parsed_again.content_digest == spec.content_digest

    changed = document_of(form, {**filling.fields, "seed": ["77"]})
    expected = spec.model_dump(mode="json") | {"seed": 77}
    assert job_spec_adapter.validate_python(changed).model_dump(mode="json") == expected


def test_the_page_of_a_job_leads_to_its_form(server: RunningServer) -> None:
    document = built_in_scene("belt") | {"name": "ten-belts", "allow_uncertified": True}
    server.worker(kinds=("cloth_scene",))
    job = httpx.post(f"{server.url}/v1/jobs", json=document).json()["id"]
    assert f'href="/submit?job={job}"' in httpx.get(f"{server.url}/jobs/{job}").text
    page = httpx.get(f"{server.url}/submit?job={job}").text
    assert 'name="name" value="ten-belts"' in page
    ticked = re.findall(r'name="axes.texture.values" value="(\w+)" checked', page)
    assert ticked == ["checker", "dots"]
    assert httpx.get(f"{server.url}/submit?job=job-0000000000000000").status_code == 404


def test_faults_find_their_fields() -> None:
    form = form_of("cloth_drag", None)
    assert field_of(form, "/axes/mu/values/0") == "axes.mu"
    assert field_of(form, "/mesh") == "mesh"
    assert field_of(form, "/textures/mine") == ""
    assert field_of(form, "") == ""


def post(server: RunningServer, path: str, pairs: list[tuple[str, str]]) -> httpx.Response:
    return httpx.post(f"{server.url}{path}", content=urlencode(pairs), headers=FORM)


def test_a_form_is_checked_and_submitted(server: RunningServer) -> None:
    server.worker(kinds=("cloth_scene",))
    page = httpx.get(f"{server.url}/submit?kind=cloth_scene&scene=belt").text
    assert "0.02 to 1; 0.2 if you leave it empty" in page
    token = re.search(r'name="token" value="([0-9a-f]+)"', page)
    assert token is not None
    filled = [*BELT, ("token", token[1])]

    checked = post(server, "/ui/submit/check", filled).text
    assert "<dt>samples</dt><dd>10</dd>" in checked
    assert re.search(r"<dt>CPU time</dt><dd>about [\d.]+ (s|min)", checked)
    match = re.search(r">spec.yaml</p>.*?<pre[^>]*>(.*?)</pre>", checked, re.DOTALL)
    assert match is not None
    assert yaml.safe_load(html.unescape(match[1]))["axes"]["mu"]["num"] == 10
    assert f"curl {server.url}/v1/jobs" in html.unescape(checked)
    assert f'with Client("{server.url}") as client' in html.unescape(checked)

    # Pressing twice makes one job.
    jobs = {post(server, "/ui/submit", filled).headers["hx-redirect"] for _ in range(2)}
    assert len(jobs) == 1
    assert httpx.get(f"{server.url}/v1{jobs.pop()}").json()["sample_count"] == 10


def test_faults_are_shown_at_their_fields(server: RunningServer) -> None:
    server.worker(kinds=("cloth_scene",))
    wrong = [pair for pair in BELT if pair[0] not in ("axes.mu.to", "frames")]
    answer = post(server, "/ui/submit", [*wrong, ("axes.mu.to", "7"), ("frames", "none")])
    assert answer.status_code == 200
    assert "hx-redirect" not in answer.headers
    assert "The job was not submitted." in answer.text
    at_mu = re.search(r'id="error-axes.mu"[^>]*>([^<]+)<', answer.text)
    at_frames = re.search(r'id="error-frames"[^>]*>([^<]+)<', answer.text)
    assert at_frames is not None
    assert "must be a" in at_frames[1]
    assert at_mu is None or "within" in at_mu[1]
    only_mu = post(server, "/ui/submit", [*wrong, ("axes.mu.to", "7"), ("frames", "8")]).text
    assert "must be within 0.02 to 1" in html.unescape(only_mu)
    assert httpx.get(f"{server.url}/v1/jobs").json()["items"] == []


def test_a_refused_job_is_explained(server: RunningServer) -> None:
    server.worker(kinds=("cloth_scene",))
    uncertified = [pair for pair in BELT if pair[0] != "allow_uncertified"]
    checked = post(server, "/ui/submit/check", uncertified).text
    refused = post(server, "/ui/submit", uncertified).text
    assert "The job was not submitted." in refused
    for page in (checked, refused):
        # Once, with the way to the box that the message calls by its key.
        assert page.count("has no passing certificate") == 1
        assert '<a href="#field-allow_uncertified">tick “allow uncertified”</a>' in page


def test_what_is_no_form_is_refused(server: RunningServer) -> None:
    for path in ("/submit?kind=spiral", "/submit?kind=cloth_scene&scene=../etc"):
        assert httpx.get(server.url + path).status_code == 404
    assert httpx.post(f"{server.url}/ui/submit", json={}).status_code == 415
    many = urlencode([("more", "")] * 5000)
    assert httpx.post(f"{server.url}/ui/submit", content=many, headers=FORM).status_code == 422
    foreign = FORM | {"Origin": "https://evil.example"}
    assert httpx.post(f"{server.url}/ui/submit", content="", headers=foreign).status_code == 403
