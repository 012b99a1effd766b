"""The whole path on real parts: coordinator, Ray, the C++ core, Blender, Zarr readers, training."""

import gc
import subprocess
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import tensorstore
import xarray
from harness import STICKSLIP, Service, descendants, read_arrays
from stickslip_schemas.base import sha256
from stickslip_schemas.format.codecs import CorruptChunkError
from stickslip_schemas.format.manifest import Manifest
from stickslip_sim_core import other_minima, reach, self_contact_distance, solve_rods
from stickslip_training.data.reader import DatasetReader
from stickslip_training.data.samples import Samples

TRAIN = STICKSLIP.with_name("stickslip-train")

# The second gamma has no stable planar rest shape at phi0 = 0, so two of the eight samples are
# rejected.
SPEC: dict[str, Any] = {
    "kind": "rod_hang",
    "axes": {"gamma": [100, 700], "phi0": [0, 6], "phi1": [8, 12]},
    "quality": "draft",
    "samples_per_shard": 3,
    "splits": {"train": 0.5, "validation": 0.25, "test": 0.25},
}


@pytest.fixture(scope="module")
def job(service: Service) -> dict[str, Any]:
    return service.finished(service.submit(SPEC))


@pytest.fixture(scope="module")
def directory(
    service: Service, job: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    target = tmp_path_factory.mktemp("pulled") / "dataset"
    cli(service, "pull", job["dataset"]["dataset"], str(target))
    return target


def cli(service: Service, *arguments: str, status: int = 0) -> str:
    done = subprocess.run(
        [STICKSLIP, *arguments, "--url", service.url], capture_output=True, text=True, check=False
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout + done.stderr


def files_url(service: Service, job: dict[str, Any]) -> str:
    dataset = job["dataset"]
    version = f"{dataset['dataset']}/versions/{dataset['version']}"
    return f"{service.url}/v1/datasets/{version}/files/"


def manifest_of(directory: Path) -> Manifest:
    return Manifest.model_validate_json((directory / "manifest.json").read_bytes())


def test_the_job_ends_and_says_what_was_rejected(
    service: Service, job: dict[str, Any], directory: Path
) -> None:
    manifest = manifest_of(directory)
    assert job["state"] == ("succeeded_with_rejects" if manifest.rejections else "succeeded")
    assert job["rejected_count"] == len(manifest.rejections)
    assert manifest.sample_count == 8
    assert {rejection.reason for rejection in manifest.rejections} <= {"solver_diverged"}
    for rejection in manifest.rejections:
        assert rejection.labels["phi0"] == 0.0
        assert "gamma" in rejection.message
        assert rejection.reason in cli(service, "show", job["id"])


def test_all_that_listens_is_on_loopback(service: Service, job: dict[str, Any]) -> None:
    """The coordinator, and Ray, which has run the job."""
    assert service.process is not None
    pids = {service.process.pid, *descendants(service.process.pid)}
    listeners = subprocess.run(
        ["ss", "-ltnpH"], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    places = [line.split()[3] for line in listeners if any(f"pid={pid}," in line for pid in pids)]
    assert len(places) >= 3
    assert all("127.0.0.1]:" in place or place.startswith("127.0.0.1:") for place in places), places


def test_labels_and_curves_are_those_of_the_solver(directory: Path) -> None:
    group = read_arrays(directory)
    gamma, phi0, phi1 = (group[name] for name in ("gamma", "phi0", "phi1"))
    expected = np.array(
        [[g, a, b] for g in (100, 700) for a in (0, 6) for b in (8, 12)], dtype=float
    )
    assert np.array_equal(np.stack([gamma, phi0, phi1], axis=1), expected)
    solution = solve_rods(gamma, phi0, phi1)
    valid = group["valid"]
    assert np.array_equal(valid, solution.stable & solution.converged)
    for name in ("centerline", "curvature", "frame"):
        assert np.array_equal(
            group[name][valid], getattr(solution, name)[valid].astype(np.float32)
        ), name
    assert np.array_equal(group["energy"][valid], solution.energy[valid])
    lines = solution.centerline[valid]
    assert np.array_equal(
        group["multistable"][valid], other_minima(gamma, phi0, phi1).multistable[valid]
    )
    assert np.array_equal(group["self_contact_distance"][valid], self_contact_distance(lines))
    assert np.array_equal(group["reach"][valid], reach(lines))


def test_pictures_show_the_rod_of_their_sample(directory: Path) -> None:
    """Bright pixels lie where the manifest's cameras project the centreline."""
    group = read_arrays(directory)
    cameras = manifest_of(directory).cameras
    for slot in np.flatnonzero(group["valid"]):
        views, line = group["views"][slot], group["centerline"][slot].astype(float)
        for view, camera in zip(views, cameras, strict=True):
            rows, columns = np.nonzero(view.max(axis=-1) > 40)
            pixels, _ = camera.project(line)
            nearest = np.hypot(columns[:, None] - pixels[:, 0], rows[:, None] - pixels[:, 1]).min(
                axis=1
            )
            assert len(rows) > 50
            assert nearest.max() < 4  # the radius of the rod is 1.7 px


@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)  # fsspec leaves its connections open
@pytest.mark.parametrize("where", ["disk", "url"])
def test_every_reader_sees_the_same_bits(
    service: Service, job: dict[str, Any], directory: Path, where: str
) -> None:
    place = str(directory) if where == "disk" else files_url(service, job)
    group = read_arrays(place)
    data = xarray.open_zarr(place)
    kvstore = (
        {"driver": "file", "path": f"{directory}/"}
        if where == "disk"
        else {"driver": "http", "base_url": place}
    )
    reader = DatasetReader(directory if where == "disk" else place)
    assert set(data.variables) == set(group)
    valid = np.flatnonzero(group["valid"])
    for name, expected in group.items():
        assert np.array_equal(
            data[name].to_numpy(), expected, equal_nan=expected.dtype.kind == "f"
        ), name
        store = kvstore | (
            {"path": f"{directory}/{name}/"} if where == "disk" else {"base_url": f"{place}{name}/"}
        )
        other = tensorstore.open({"driver": "zarr3", "kvstore": store}).result().read().result()
        assert np.asarray(other).tobytes() == expected.tobytes(), name
        assert np.array_equal(
            reader.read(name, valid), expected[valid], equal_nan=expected.dtype.kind == "f"
        ), name
    reader.close()
    del data
    gc.collect()  # here, where the warning about those connections is expected


def test_files_on_disk_and_over_http_are_those_of_the_manifest(
    service: Service, job: dict[str, Any], directory: Path
) -> None:
    with httpx.Client(base_url=files_url(service, job)) as client:
        for file in manifest_of(directory).files:
            data = (directory / file.path).read_bytes()
            assert (sha256(data), len(data)) == (file.sha256, file.size)
            response = client.get(file.path, headers={"Range": f"bytes={file.size // 2}-"})
            assert response.status_code == 206
            assert response.content == data[file.size // 2 :]
            assert response.headers["etag"] == f'"{file.sha256}"'
    assert sha256((directory / "manifest.json").read_bytes()) == job["dataset"]["manifest"]
    cli_free = subprocess.run(
        [STICKSLIP, "verify", directory], capture_output=True, text=True, check=False
    )
    assert cli_free.returncode == 0, cli_free.stdout


def test_the_same_spec_again_runs_nothing(service: Service, job: dict[str, Any]) -> None:
    again = service.finished(service.submit({**SPEC, "name": "again"}))
    assert again["dataset"] == job["dataset"]
    for stage, progress in again["progress"]["stages"].items():
        assert progress["cached"] == sum(progress["counts"].values()), stage
        assert progress["cpu_seconds"] == 0


def test_a_grown_grid_runs_what_is_new(service: Service, job: dict[str, Any]) -> None:
    assert job["finished_at"]
    axes = SPEC["axes"] | {"gamma": [100, 700, 900]}
    grown = service.finished(service.submit({**SPEC, "axes": axes}))
    assert grown["progress"]["stages"]["simulate"]["cached"] == 8
    assert sum(grown["progress"]["stages"]["simulate"]["counts"].values()) == 12


@pytest.mark.slow
def test_training_learns_from_the_pulled_dataset(directory: Path) -> None:
    rods = Samples(directory, arrays=["centerline", "curvature", "views"])
    (batch,) = rods.loader(8)
    assert batch["views"].shape == (len(rods), 4, 224, 224, 3)
    done = subprocess.run(
        [
            TRAIN,
            "curvature",
            str(directory),
            "--out",
            str(directory.parent / "run"),
            "--steps",
            "6",
            "--threads",
            "1",
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "network" in done.stdout
    assert (directory.parent / "run" / "model.pt").exists()


def test_a_flipped_bit_in_a_pulled_shard_is_told(directory: Path) -> None:
    path = directory / "views" / "c" / "0" / "0" / "0" / "0" / "0"
    slot = int(np.flatnonzero(DatasetReader(directory).label("valid"))[0])
    whole = path.read_bytes()
    try:
        path.write_bytes(whole[:100] + bytes([whole[100] ^ 4]) + whole[101:])
        with pytest.raises((CorruptChunkError, OSError, ValueError), match="views"):
            DatasetReader(directory).read("views", [slot])
        verify = subprocess.run(
            [STICKSLIP, "verify", directory], capture_output=True, text=True, check=False
        )
        assert verify.returncode == 1
    finally:
        path.write_bytes(whole)


@pytest.mark.parametrize(
    ("change", "pointer", "value"),
    [
        ({"kind": "cloth_drag",
          "axes": {"material": "silk", "mu": 0.1, "texture": "dots", "viewpoint": "left"}},
         "/axes/material", "silk"),
        ({"axes": {"gamma": -1, "phi0": 1, "phi1": 6}}, "/axes/gamma", "-1"),
        ({"axes": {"gamma": [], "phi0": 1, "phi1": 6}}, "/axes/gamma", "[]"),
        ({"axes": {"gamma": {"type": "linspace", "start": 1, "stop": 2, "num": 10**12},
                   "phi0": 1, "phi1": 6}},
         "/axes/gamma/num", "1000000000000"),
    ],
)  # fmt: skip
def test_bad_specs_queue_nothing(
    service: Service, change: dict[str, Any], pointer: str, value: str
) -> None:
    before = [item["id"] for item in service.get("/v1/jobs")["items"]]
    base = SPEC if "kind" not in change else {}
    response = httpx.post(f"{service.url}/v1/jobs", json={**base, **change})
    assert response.status_code == 422
    assert response.headers["content-type"] == "application/problem+json"
    (error,) = response.json()["errors"]
    assert error["pointer"] == pointer
    assert value in error["value"]
    assert error["rule"]
    assert [item["id"] for item in service.get("/v1/jobs")["items"]] == before


def test_nan_is_refused(service: Service) -> None:
    body = '{"kind": "rod_hang", "axes": {"gamma": [NaN], "phi0": 1, "phi1": 6}}'
    response = httpx.post(
        f"{service.url}/v1/jobs", content=body, headers={"content-type": "application/json"}
    )
    assert response.status_code == 422
    assert response.json()["errors"] == [
        {"pointer": "/axes/gamma/0", "rule": "must be a finite number", "value": "NaN"}
    ]
