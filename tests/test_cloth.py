"""Cloth on real parts: spec, core, Blender, Zarr, training; a simulation serves its renders."""

import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from harness import STICKSLIP, Service, read_arrays
from stickslip_schemas.format.manifest import Manifest
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.kinds.cloth.spec import SEGMENTS
from stickslip_schemas.kinds.cloth_drag import ClothDragSimulation
from stickslip_schemas.spec.arrays import shown_frames
from stickslip_sim_core.scenes import cloth_drag
from stickslip_training.data.reader import DatasetReader
from stickslip_training.data.samples import Samples

SPEC: dict[str, Any] = {
    "kind": "cloth_drag",
    "allow_uncertified": True,
    "axes": {
        "material": "gray-interlock",
        "mu": 0.4,
        "texture": ["checker", "dots"],
        "viewpoint": ["calibrated", "left"],
    },
    "preset": "fast",
    "mesh": 9,
    "frames": 3,
    "quality": "draft",
    "samples_per_shard": 3,
    "splits": {"train": 1, "validation": 0, "test": 0},
}


@pytest.fixture(scope="module")
def job(service: Service) -> dict[str, Any]:
    return service.finished(service.submit(SPEC))


@pytest.fixture(scope="module")
def directory(
    service: Service, job: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    target = tmp_path_factory.mktemp("pulled") / "clips"
    command = [STICKSLIP, "pull", job["dataset"]["dataset"], target, "--url", service.url]
    subprocess.run(command, check=True, capture_output=True)
    return target


def test_one_simulation_makes_all_clips(service: Service, job: dict[str, Any]) -> None:
    assert job["state"] == "succeeded"
    counts = {stage: item["counts"] for stage, item in job["progress"]["stages"].items()}
    assert counts["simulate"] == {"succeeded": 1}
    assert counts["render"] == {"succeeded": 4}
    more = SPEC | {"axes": SPEC["axes"] | {"texture": ["checker", "dots", "plaid"]}}
    grown = service.finished(service.submit(more))["progress"]["stages"]
    assert (grown["simulate"]["cached"], grown["render"]["cached"]) == (1, 4)
    assert sum(grown["render"]["counts"].values()) == 6


def test_meshes_and_labels_are_those_of_the_solver(directory: Path) -> None:
    spec = job_spec_adapter.validate_python(SPEC)
    simulation = spec.simulation({"material": "gray-interlock", "mu": 0.4})
    assert isinstance(simulation, ClothDragSimulation)
    run = cloth_drag.scene(
        "gray-interlock",
        0.4,
        preset="fast",
        mesh=9,
        seed=simulation.seed,
        self_friction=simulation.self_friction,
    ).run()
    arrays = read_arrays(directory)
    assert arrays["valid"].all()
    assert arrays["positions"].shape == (4, 300, 81, 3)
    for slot in range(4):
        assert np.array_equal(arrays["positions"][slot], run.positions.astype(np.float32))
        assert np.array_equal(arrays["rest"][slot], run.rest.astype(np.float32))
        assert np.array_equal(arrays["triangles"][slot], run.triangles)
        assert np.array_equal(
            arrays["contact_force"][slot], run.record["contact_force"].astype(np.float32)
        )
        assert np.array_equal(
            arrays["holder_force"][slot], run.record["holder_force"].astype(np.float32)
        )
        assert np.array_equal(arrays["self_intersections"][slot], run.self_intersections)
        for name in (
            "bias_side",
            "landed_side",
            "bias",
            "steps",
            "unconverged_steps",
            "worst_residual",
        ):
            assert arrays[name][slot] == ({**vars(run), **run.labels})[name], name
    assert (
        len(set(arrays["light_seed"].tolist())) == 2
    )  # one for each viewpoint: textures share a trace


def test_cloth_feels_itself_unless_its_spec_says_null(directory: Path) -> None:
    simulation = job_spec_adapter.validate_python(SPEC).simulation(
        {"material": "gray-interlock", "mu": 0.4}
    )
    assert isinstance(simulation, ClothDragSimulation)
    through = cloth_drag.scene(
        "gray-interlock", 0.4, preset="fast", mesh=9, seed=simulation.seed, self_friction=None
    ).run()
    assert through.self_intersections.any()
    assert not read_arrays(directory)["self_intersections"].any()


def test_clips_show_the_cloth_of_their_sample(directory: Path) -> None:
    """What changes between two frames is where the cloth was or is, and the light it throws on the
    floor about.
    """
    manifest = Manifest.model_validate_json((directory / "manifest.json").read_bytes())
    cameras = {camera.name: camera for camera in manifest.cameras}
    clips = Samples(directory, arrays=["video", "positions"])
    instants = clips.reader.arrays["video"].attributes["instants"]
    assert list(instants) == [0, 100, 200]
    for index in range(len(clips)):
        item = clips[index]
        camera = cameras[item.name("viewpoint")]
        centers = []
        for frame, instant in zip(item["video"].numpy(), instants, strict=True):
            bright = np.argwhere(frame.max(axis=2) > 110)
            pixels, _ = camera.project(item["positions"][instant].numpy())
            low, high = pixels.min(axis=0) - 3, pixels.max(axis=0) + 3
            inside = ((bright[:, ::-1] >= low) & (bright[:, ::-1] <= high)).all(axis=1)
            assert len(bright) > 100
            assert inside.mean() > 0.95
            centers.append(pixels.mean(axis=0))
        assert np.linalg.norm(centers[1] - centers[0]) > 20.0  # it has been dragged


def test_what_is_known_of_every_pixel_reaches_the_reader(service: Service, tmp_path: Path) -> None:
    names = ("depth", "segmentation", "normals", "uv", "flow")
    spec = SPEC | {"ground_truth": list(names), "axes": SPEC["axes"] | {"viewpoint": "left"}}
    job = service.finished(service.submit(spec))
    assert job["state"] == "succeeded", job["message"]
    assert job["progress"]["stages"]["simulate"]["cached"] == 1
    target = tmp_path / "known"
    command = [STICKSLIP, "pull", job["dataset"]["dataset"], target, "--url", service.url]
    subprocess.run(command, check=True, capture_output=True)
    arrays = read_arrays(target)
    with DatasetReader(target) as reader:
        known = {name: reader.read(name, [0, 1]) for name in names}
        instants = shown_frames(3, 300)
        camera = {camera.name: camera for camera in reader.manifest.cameras}["left"]
    for name, values in known.items():
        assert np.array_equal(values, arrays[name], equal_nan=True)
        assert np.array_equal(values[0], values[1], equal_nan=True)  # textures share it
    cloth = known["segmentation"][0] == SEGMENTS.index("cloth")
    assert (cloth == np.isfinite(known["uv"][0]).all(axis=-1)).all()
    for frame, instant in enumerate(instants):
        vertices = arrays["positions"][0, instant] @ np.asarray(camera.rotation).T + np.asarray(
            camera.translation
        )
        depth = known["depth"][0, frame][cloth[frame]]
        assert (
            vertices[:, 2].min() - 0.01 < depth.min() <= depth.max() < vertices[:, 2].max() + 0.01
        )
        pixels, _ = camera.project(arrays["positions"][0, instant])
        rows, columns = np.nonzero(cloth[frame])
        assert (
            abs(columns.min() - pixels[:, 0].min()) < 3
        )  # a corner ends in a tip that is thinner than a pixel
        assert abs(rows.max() - pixels[:, 1].max()) < 3
    assert (
        np.linalg.norm(known["flow"][0, 0][cloth[0]].astype(float), axis=-1).mean() > 10.0
    )  # it is dragged
