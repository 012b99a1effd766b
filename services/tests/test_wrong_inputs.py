"""Wrong inputs, in files, request bodies and flags: each is refused, and the message names field,
rule and value.
"""

import json
from collections.abc import Iterator
from copy import deepcopy
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx
import pytest
from click.testing import CliRunner
from stickslip_services.app import make_app
from stickslip_services.cli import app
from stickslip_services.settings import Settings
from stickslip_testing.servers import serving

OFFLINE = ["--url", "http://127.0.0.1:9"]
DATASET = "ds-0123456789abcdef"
MISSING: Any = object()

ROD = {"kind": "rod_hang", "axes": {"gamma": [400, 700], "phi0": 0.2, "phi1": 8}}
CLOTH = {
    "kind": "cloth_drag",
    "axes": {"material": "gray-interlock", "mu": 0.3, "texture": "dots", "viewpoint": "left"},
}
SCENE = {"kind": "cloth_scene", "scene": "wipe", "axes": {"texture": "dots", "viewpoint": "front"}}


def linspace(**change: Any) -> dict[str, Any]:
    return {"type": "linspace", "start": 1, "stop": 2, "num": 3} | change


def drawn(**change: Any) -> dict[str, Any]:
    return {"type": "random", "low": 1, "high": 2, "num": 3} | change


# Where a document is changed, to what, a part of the rule, and the field that is named where it is
# another place.
WRONG_RODS: list[tuple[Any, ...]] = [
    ("kind", "rod", "one of cloth_drag, cloth_scene, rod_hang"),
    ("kind", MISSING, "one of cloth_drag, cloth_scene, rod_hang"),
    ("name", 7, "string"),
    ("name", "x" * 200, "lower-case letters"),
    ("quality", "best", "one of preview, draft, standard, high"),
    ("quality", 3, "one of preview, draft, standard, high"),
    ("views", "rod-5", "one of rod-4"),
    ("views", 4, "one of rod-4"),
    ("samples_per_shard", 0, "greater than or equal to 1"),
    ("samples_per_shard", 1.5, "integer"),
    ("samples_per_shard", 10**9, "less than or equal to 4096"),
    ("seed", -1, "greater than or equal to 0"),
    ("seed", "x", "integer"),
    ("seed", 2**40, "less than 2147483648"),
    ("combine", "all", "one of product, zip"),
    ("combine", "zip", "one length, and theirs are {'gamma': 2, 'phi0': 1, 'phi1': 1}", ""),
    ("poisson", -1.5, "greater than -1"),
    ("poisson", 0.9, "less than or equal to 0.5"),
    ("poisson", "x", "number"),
    ("splits", {"train": 2}, "less than or equal to 1", "splits/train"),
    ("splits", {"train": -0.1}, "greater than or equal to 0", "splits/train"),
    ("splits", {"by": "day"}, "one of simulation, clip", "splits/by"),
    ("splits", 3, "an object"),
    ("axes", {}, "required", "axes/gamma"),
    ("axes", MISSING, "required"),
    ("axes/gamma", -1, "greater than or equal to 0"),
    ("axes/gamma", 1e9, "less than or equal to 100000"),
    ("axes/gamma", "x", "number"),
    ("axes/gamma", [], "at least 1 item"),
    ("axes/gamma", [1, 1], "values must differ unless axes are zipped"),
    ("axes/gamma", True, "a value, a list of values, or an object"),
    ("axes/gama", 1, "did you mean gamma?"),
    ("axes/phi1", MISSING, "required"),
    ("axes/gamma", linspace(num=0), "greater than or equal to 1", "axes/gamma/num"),
    ("axes/gamma", linspace(num=1.5), "integer", "axes/gamma/num"),
    ("axes/gamma", linspace(stop=1), "start and stop must differ"),
    ("axes/gamma", linspace(type="log"), "one of list, linspace, random, sobol", "axes/gamma/type"),
    ("axes/gamma", linspace(num=10**7), "less than or equal to 1000000", "axes/gamma/num"),
    ("axes/gamma", linspace(step=1), "no such field", "axes/gamma/step"),
    ("axes/gamma", drawn(low=3), "low must be less than high"),
    ("axes/gamma", drawn(seed=-1), "greater than or equal to 0", "axes/gamma/seed"),
    ("axes/gamma", {"type": "sobol"}, "required", "axes/gamma/low"),
    ("axes/phi0", 1e6, "less than or equal to 40"),
    ("colour", 1, "no such field"),
]
WRONG_CLOTH: list[tuple[Any, ...]] = [
    ("mesh", 4, "greater than or equal to 5"),
    ("mesh", 200, "less than or equal to 161"),
    ("mesh", 21.5, "integer"),
    ("mesh", "x", "integer"),
    ("preset", "best", "one of certified, fast, fine"),
    ("frames", 0, "greater than or equal to 1"),
    ("frames", 10**6, "frames must be at most 300, the instants of the motion; got 1000000", ""),
    ("frames", "x", "integer"),
    ("quality", "ultra", "one of preview, draft, standard, high"),
    ("axes/material", "denim", "did you mean 11oz-black-denim?"),
    ("axes/mu", -0.1, "greater than or equal to 0"),
    ("axes/mu", 50, "less than or equal to 10"),
    ("axes/texture", "dot", "did you mean dots?"),
    ("axes/viewpoint", "up", "one of calibrated, left, right"),
    ("axes/lighting", "dark", "one of drawn, held-out, room, window"),
    ("axes/substrate", "ice", "one of matt, aluminium"),
    ("axes/density", 0, "greater than or equal to 0.1"),
    ("axes/bending", -1, "greater than or equal to 0.1"),
    ("self_friction", -1, "greater than or equal to 0"),
    ("self_friction", "x", "number"),
    ("allow_uncertified", "x", "boolean"),
    ("ground_truth", ["depth", "depth"], "name each array once; got depth, depth", ""),
    ("ground_truth", ["deep"], "did you mean depth?", "ground_truth/0"),
    ("creases", "x", "number"),
    ("measured", "x", "number"),
    ("textures", {"logo": "x"}, "sha256", "textures/logo"),
    ("textures", {"Logo!": "sha256:" + "a" * 64}, "lower-case letters", "textures/Logo!"),
    ("lamps", {"l": {}}, "required", "lamps/l/azimuth"),
    ("substrates", {"s": {"albedo": [2, 3]}}, "less than or equal to 1", "substrates/s/albedo/0"),
    ("viewpoints", {"v": {}}, "required", "viewpoints/v/image_size"),
    ("materials", {"m": {}}, "required", "materials/m/density"),
    ("shear", 1, "no such field"),
]
WRONG_SCENES: list[tuple[Any, ...]] = [
    ("scene", "wype", "did you mean wipe?"),
    ("axes/speed", -1, "one of fabric, mu"),
    ("axes/mu", 3, "within 0 to 1.5"),
    ("axes/texture", MISSING, "required"),
    ("frames", 0, "greater than or equal to 1"),
    ("axes/viewpoint", "nowhere", "one of front, side, high"),
    ("preset", "certified", "no such field"),
    ("mesh", 21, "no such field"),
]
DOCUMENTS = [
    pytest.param(base, *row, id=f"{base['kind']}-{row[0]}-{number}")
    for base, rows in ((ROD, WRONG_RODS), (CLOTH, WRONG_CLOTH), (SCENE, WRONG_SCENES))
    for number, row in enumerate((*row, None)[:4] for row in rows)
]


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    served = make_app(Settings(data=tmp_path_factory.mktemp("wrong"), durable=False))
    with serving(served) as url, httpx.Client(base_url=url) as client:
        yield client


def changed(base: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    document = place = deepcopy(base)
    *parents, last = path.split("/")
    for parent in parents:
        place = place[parent]
    place.pop(last, None) if value is MISSING else place.update({last: value})
    return document


@pytest.mark.parametrize(("base", "path", "value", "rule", "field"), DOCUMENTS)
def test_a_wrong_document_is_refused_as_a_file_and_as_a_body(
    base: dict[str, Any],
    path: str,
    value: Any,
    rule: str,
    field: str | None,
    api: httpx.Client,
    tmp_path: Path,
) -> None:
    document = changed(base, path, value)
    named = path if field is None else field
    answer = api.post("/v1/jobs:validate", json=document)
    assert answer.status_code == 422
    first = answer.json()["errors"][0]
    assert first["pointer"] == (f"/{named}" if named else "")
    assert rule in first["rule"]
    file = tmp_path / "spec.json"
    file.write_text(json.dumps(document))
    done = CliRunner().invoke(app, ["validate", str(file), *OFFLINE])
    assert done.exit_code == 1
    line = next(line for line in done.stderr.splitlines() if rule in line)
    assert line.strip().startswith(f"{named.replace('/', '.') or 'the document'}: ")
    if not isinstance(value, dict) and value is not MISSING and named == path:
        assert str(first["value"]) in line


BODIES = {
    "not UTF-8": (b'{"kind": "\xe4"}', "it must be text in UTF-8, and byte 10 is not"),
    "UTF-16": ('{"kind": 1}'.encode("utf-16"), "it must be text in UTF-8, and byte 0 is not"),
    "cut off": (b'{"kind": ', "Expecting value, line 1, column 10"),
    "surrogate": (b'{"kind": "\\ud800"}', "it must not have the lone surrogate '\\ud800'"),
    "a long integer": (
        b'{"seed": ' + b"7" * 5000 + b"}",
        "an integer must have at most 4000 digits, and one has 5000",
    ),
    "a key twice": (b'{"kind": 1, "kind": 2}', "the key 'kind' is there twice"),
}


@pytest.mark.parametrize("name", BODIES)
def test_a_body_that_is_no_json_is_refused_in_plain_words(api: httpx.Client, name: str) -> None:
    body, fault = BODIES[name]
    headers = {"Content-Type": "application/json"}
    answer = api.post("/v1/jobs:validate", content=body, headers=headers)
    assert answer.status_code == 400
    assert answer.json()["detail"] == f"the body is not JSON: {fault}"


NUMBER = "not a valid integer range"
FLAGS: list[tuple[str, int, str]] = [
    ("submitt", 2, "No such command 'submitt'. Did you mean 'submit'?"),
    ("--verson", 2, "No such option '--verson'. Did you mean '--version'?"),
    (
        "--install-completion tcsh",
        2,
        "'--install-completion': 'tcsh' is not one of 'bash', 'zsh', 'fish'",
    ),
    ("validate", 2, "Missing argument 'FILE'"),
    ("validate OK --jsn", 2, "No such option '--jsn'. Did you mean '--json'?"),
    ("validate OK x", 2, "unexpected extra argument (x)"),
    ("validate OK --url 127.0.0.1", 1, "must begin with http:// or https://: it is '127.0.0.1'"),
    ("validate OK --url http://x:y:1", 1, "must have a host and a port from 1 to 65535"),
    ("validate OK --url http://[::1", 1, "must have a host and a port from 1 to 65535"),
    ("validate OK --url http:///x", 1, "must have a host, as in http://HOST:PORT"),
    ("validate OK --url ftp://x", 1, "must begin with http:// or https://: it is 'ftp://x'"),
    ("validate NONE", 1, "there is no file"),
    ("validate LIST", 1, "must hold a mapping (key: value), and it holds [1]"),
    ("validate NAN", 1, "axes.phi0 must be a finite number, and it is nan"),
    ("validate DATE", 1, "axes.gamma"),
    ("validate TWICE", 1, "the key 'kind' is there twice"),
    ("validate BROKEN", 1, "is not YAML"),
    ("validate BYTES", 1, "it must be YAML or JSON, text in UTF-8; byte 0 is not UTF-8"),
    ("validate PICTURE", 1, "it must be YAML or JSON, text in UTF-8, and it is a PNG picture"),
    ("validate PDF", 1, "it must be YAML or JSON, text in UTF-8, and it is a PDF file"),
    ("validate WIDE", 1, "it must be YAML or JSON, text in UTF-8, and it is text in UTF-16"),
    ("validate OBJECT", 1, "the tag !!python/name:os.system must not be there"),
    ("validate TWO", 1, "a file must have one document, and --- begins another one, line 2"),
    ("validate EMPTY", 1, "is empty: it must hold a mapping"),
    ("validate DEEP", 1, "lists and mappings must be nested at most 100 deep"),
    ("validate BOMB", 1, "aliases must stand for at most 100000 values"),
    ("scene check absent.yaml", 1, "there is no file absent.yaml"),
    ("scene check folder/absent", 1, "there is no file folder/absent"),
    ("scene check TAGS", 1, "low: sets sheets.cloth.mesh.size.0: must be greater than 0"),
    ("scene check EMPTY", 1, "is empty: it must hold a mapping"),
    ("submit OK --priority 101", 2, "'--priority': 101 is not in the range -100<=x<=100"),
    ("submit OK --priority -101", 2, "'--priority': -101 is not in the range -100<=x<=100"),
    ("submit OK --priority high", 2, f"'--priority': 'high' is {NUMBER}"),
    ("submit OK --priority 1.5", 2, f"'--priority': '1.5' is {NUMBER}"),
    ("jobs --limit 0", 2, "'--limit': 0 is not in the range x>=1"),
    ("jobs --limit x", 2, f"'--limit': 'x' is {NUMBER}"),
    ("jobs --limit", 2, "'--limit' requires an argument"),
    ("jobs --state done", 2, "'--state': 'done' is not one of 'planning', 'queued'"),
    ("priority job-1", 2, "Missing argument 'PRIORITY'"),
    ("priority job-1 200", 2, "'PRIORITY': 200 is not in the range -100<=x<=100"),
    ("priority job-1 x", 2, f"'PRIORITY': 'x' is {NUMBER}"),
    ("show", 2, "Missing argument 'JOB'"),
    ("watch", 2, "Missing argument 'JOB'"),
    ("pause", 2, "Missing argument 'JOB'"),
    ("cancel", 2, "Missing argument 'JOB'"),
    ("upload", 2, "Missing argument 'FILES...'"),
    ("upload NONE", 1, "cannot be read: No such file"),
    ("upload OK", 1, "error: http://127.0.0.1:9 does not answer"),
    ("pull", 2, "Missing argument 'DATASET[:vN]'"),
    (f"pull {DATASET}", 2, "Missing argument 'DEST'"),
    (f"pull {DATASET}:vx OUT", 1, f"must be DATASET:vN, as in {DATASET}:v1, and is '{DATASET}:vx'"),
    (
        f"pull {DATASET}:v1 OUT --split all",
        1,
        "split: Input should be 'train', 'validation' or 'test', and is 'all'",
    ),
    (f"pull {DATASET} OUT --where", 2, "'--where' requires an argument"),
    ("sign OUT", 2, "Missing option '--key'"),
    ("verify", 2, "Missing argument 'DIR'"),
    (
        "verify OUT",
        1,
        "manifest.json  missing  not there: no dataset, or a pull that was not finished",
    ),
    (f"rm {DATASET}", 1, f"must be DATASET:vN, as in {DATASET}:v1, and is '{DATASET}'"),
    (f"rm {DATASET}:v0", 1, f"must be DATASET:vN, as in {DATASET}:v1, and is '{DATASET}:v0'"),
    (f"rm {DATASET}:v1 DATA", 1, "does not exist or is empty: name the --data of a coordinator"),
    ("gc --older-than -1", 2, "'--older-than': must be a number of hours, 0 or more, and is '-1'"),
    (
        "gc --older-than nan",
        2,
        "'--older-than': must be a number of hours, 0 or more, and is 'nan'",
    ),
    (
        "gc --older-than inf",
        2,
        "'--older-than': must be a number of hours, 0 or more, and is 'inf'",
    ),
    (
        "gc --older-than week",
        2,
        "'--older-than': must be a number of hours, 0 or more, and is 'week'",
    ),
    ("scrub --rate 0", 2, "'--rate': must be a number of MB/s, 0.1 or more, and is '0'"),
    ("scrub --rate nan", 2, "'--rate': must be a number of MB/s, 0.1 or more, and is 'nan'"),
    (
        "reindex DATA --store s3://",
        1,
        "store must be a directory, file:///DIRECTORY or s3://BUCKET/PREFIX; got 's3://'",
    ),
    (
        "reindex DATA --store ftp://x",
        1,
        "store must be a directory, file:///DIRECTORY or s3://BUCKET/PREFIX; got 'ftp",
    ),
    ("keys create me", 2, "Missing option '--scope'"),
    (
        "keys create me --scope all",
        2,
        "'--scope': 'all' is not one of 'read', 'submit', 'work', 'admin'",
    ),
    (
        f"keys create {'x' * 101} --scope read DATA",
        1,
        "name must have 1 to 100 characters, and has 101",
    ),
    (
        "keys create me --scope read --project A DATA",
        1,
        "project must be lower-case letters, digits and '-', 63 at most; got 'A'",
    ),
    ("keys revoke key-0 DATA", 1, "there is no key 'key-0'"),
    ("projects quota lab --jobs -1", 2, "'--jobs': -1 is not in the range x>=0"),
    ("projects quota lab --samples many", 2, f"'--samples': 'many' is {NUMBER}"),
    (
        "projects quota A DATA",
        1,
        "project must be lower-case letters, digits and '-', 63 at most; got 'A'",
    ),
    (
        "webhooks create example.org DATA",
        1,
        "url must be https://HOST/PATH, or http:// on this machine; got 'example",
    ),
    (
        "webhooks create ftp://x DATA",
        1,
        "url must be https://HOST/PATH, or http:// on this machine; got 'ftp://x'",
    ),
    (
        "webhooks create http://example.org DATA",
        1,
        "url must be https://HOST/PATH, or http:// on this machine",
    ),
    ("webhooks delete wh-0 DATA", 1, "there is no webhook 'wh-0'"),
    ("audit-log --limit 0", 2, "'--limit': 0 is not in the range x>=1"),
    ("certify", 2, "Missing option '--preset'"),
    ("certify --preset best", 2, "'--preset': 'best' is not one of 'rods', 'certified', 'fast'"),
    ("register OUT", 1, "holds no certificate: there is no certificate.json"),
    ("scene check wype", 1, "wipe, or a file, and it is 'wype'; did you mean wipe?"),
    ("simulate wipe", 2, "Missing argument 'DIR'"),
    ("simulate wipe HERE", 1, "out: must not exist, and"),
    ("up --port 70000", 2, "'--port': 70000 is not in the range 0<=x<=65535"),
    ("up --port web", 2, f"'--port': 'web' is {NUMBER}"),
    ("up --data EMPTY", 1, "--data must be a directory, and "),
    ("up --slots 0", 2, "'--slots': 0 is not in the range x>=1"),
    ("up --host 0.0.0.0 DATA", 1, "host must be a loopback address unless"),
    (
        "up --allow-host a/b DATA",
        1,
        "allowed_hosts must be names or addresses without a port; one is 'a/b'",
    ),
    ("up --tls-key NONE DATA", 1, "tls_certificate and tls_key must be given together"),
    (
        "up --store s3:/x DATA",
        1,
        "store must be a directory, file:///DIRECTORY or s3://BUCKET/PREFIX; got 's3:/x'",
    ),
    (
        "up --database mysql://x/y DATA",
        1,
        "must be a URL of the form postgresql://USER@HOST/NAME, and is 'mysql://x/y'",
    ),
    ("up --signing-key NONE DATA", 1, "signing_key must be a file;"),
]
FILES = {
    "OK": json.dumps(ROD),
    "LIST": "[1]",
    "NAN": "{kind: rod_hang, axes: {gamma: 1, phi0: .nan, phi1: 6}}",
    "DATE": "{kind: rod_hang, axes: {gamma: 2026-01-01, phi0: 0, phi1: 6}}",
    "TWICE": "kind: rod_hang\nkind: cloth_drag\n",
    "BROKEN": "axes: [",
    "BYTES": "\udcff",
    "TAGS": "{format: stickslip-scene/1, duration: 1, default_friction: 0.3, parameters: {width: "
    "{sets: [sheets.cloth.mesh.size.0], low: -1, high: 2, unit: m, description: width}}, sheets: "
    "{cloth: {material: gray-interlock, mesh: {type: grid, size: [1, 1], cells: [1, 1]}}}}",
    "PICTURE": "\udc89PNG\r\n",
    "PDF": "%PDF-1.7",
    "WIDE": "\udcff\udcfek",
    "OBJECT": "kind: !!python/name:os.system x",
    "TWO": "kind: rod_hang\n---\nkind: cloth_drag\n",
    "EMPTY": "# a comment",
    "DEEP": "[" * 5000,
    "BOMB": "a: &a [1]\n"
    + "\n".join(
        f"{name}: &{name} [{', '.join([f'*{earlier}'] * 9)}]"
        for earlier, name in pairwise("abcdefghijk")
    ),
}


def test_there_are_150_wrong_inputs() -> None:
    assert len(DOCUMENTS) + len({words for words, _, _ in FLAGS}) >= 150


@pytest.mark.parametrize(
    ("words", "status", "message"), FLAGS, ids=[words[:40] for words, _, _ in FLAGS]
)
def test_a_wrong_flag_or_file_is_refused(
    words: str, status: int, message: str, tmp_path: Path
) -> None:
    for name, text in FILES.items():
        (tmp_path / f"{name}.yaml").write_text(text, encoding="utf-8", errors="surrogateescape")
    known = {name: [str(tmp_path / f"{name}.yaml")] for name in (*FILES, "NONE")}
    known |= {
        "DATA": ["--data", str(tmp_path / "data")],
        "OUT": [str(tmp_path / "out")],
        "HERE": [str(tmp_path)],
    }
    arguments = [part for word in words.split() for part in known.get(word, [word])]
    done = CliRunner().invoke(app, arguments, env={"COLUMNS": "250", "STICKSLIP_URL": OFFLINE[1]})
    assert done.exit_code == status, done.output
    assert message in done.output
    assert done.exception is None or isinstance(done.exception, SystemExit)
