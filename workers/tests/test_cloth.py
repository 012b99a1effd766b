"""Cloth: a trajectory becomes a record, and records and clips a dataset that every reader opens."""

import io
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tensorstore
import xarray
import zarr
from PIL import Image
from publishing import publish_task
from stickslip_schemas.base import Reason
from stickslip_schemas.documents.tasks import (
    ChunkRef,
    PackOutput,
    PackSlot,
    PackTask,
    PublishTask,
    SimulateTask,
)
from stickslip_schemas.format.codecs import encode_clip, encode_sample
from stickslip_schemas.format.manifest import Manifest, Pictures, Psnr, Rejection, layout
from stickslip_schemas.kinds.cloth.arrays import CHECKS
from stickslip_schemas.kinds.cloth_drag import VIEWPOINTS, ClothDragSimulation, ClothDragSpec
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.spec.arrays import REGIONS, ArrayLayout
from stickslip_schemas.spec.cameras import load_rig
from stickslip_schemas.spec.jobs import Quality
from stickslip_schemas.store import DirectoryStore
from stickslip_sim_core import ClothRun, Fabric, Scene, fabric, preset_named
from stickslip_sim_core.cloth import checks, meshes
from stickslip_sim_core.scenes import cloth_drag
from stickslip_sim_core.scenes.scene import cloth_kind
from stickslip_testing.samples import samples
from stickslip_workers.stages import pack as pack_module
from stickslip_workers.stages.pack import pack
from stickslip_workers.stages.publish import create_array, publish
from stickslip_workers.stages.run import Records, encode_records, run_tasks

BUILDS = Builds(sim_core="0" * 64, simulate="1" * 64, render="2" * 64, pack="3" * 64)
SIDE = 5


@dataclass
class Core:
    """A core that moves a sheet at once: slides it with mu, and breaks where it is set to."""

    calls: list[tuple[Any, ...]] = field(default_factory=list)
    changes: dict[str, Any] = field(default_factory=dict)

    def scene(
        self,
        material: Fabric,
        mu: float,
        *,
        self_friction: float | None,
        preset: str,
        mesh: int,
        frames: int,
        seed: int,
        **_factors: float,
    ) -> Any:
        self.calls.append((material.name, mu, self_friction, preset, mesh, frames, seed))
        square = meshes.grid(0.2, 0.2, mesh - 1, mesh - 1)
        return Scene(
            mesh=square,
            fabrics=[material],
            preset=preset_named(preset),
            start=np.zeros((len(square.rest), 3)),
            motion=lambda _time: ([], [], []),
            frames=frames,
            frame_rate=2.4,
            record={"mu": np.array(mu)},
        )

    def run(self, scene: Scene, on_frame: Callable[[int, int], None]) -> ClothRun:
        on_frame(scene.frames, scene.frames)
        mu, t = float(scene.record["mu"]), np.linspace(0.0, 1.0, scene.frames)
        positions = np.zeros((scene.frames, len(scene.mesh.rest), 3))
        positions[..., 0] = mu * t[:, None]
        positions[..., 1:] = scene.mesh.rest + np.array([0.0, 0.11])
        run = ClothRun(
            positions=positions,
            rest=scene.mesh.rest,
            triangles=scene.mesh.triangles,
            times=t,
            record={
                "contact_force": np.outer(t, (mu, 0.0, 1.0)),
                "holder_force": np.outer(t, (-mu, 0.0, -1.0)),
            },
            labels={
                "kernel": "baseline",
                "steps": 1200,
                "unconverged_steps": 3,
                "worst_residual": 2e-4,
                **dict.fromkeys(CHECKS, 0.0),
                "bias_side": -1,
                "landed_side": 1,
                "bias": 1e-5,
                "areal_density": fabric("gray-interlock").density,
                "bending_rigidity": np.diag(fabric("gray-interlock").rigidity).tolist(),
                "softening_length": 0.0,
                "stretching_stiffness": fabric("gray-interlock").stretching[0].tolist(),
            },
            self_intersections=(np.arange(scene.frames) * 1000).astype(np.int32),
            least_distance=np.inf,
            rest_time=np.nan,
            code="",
            reason="",
        )
        return replace(run, **self.changes)


@pytest.fixture
def core(monkeypatch: pytest.MonkeyPatch) -> Core:
    """A core that answers at once, instead of the one that takes minutes."""
    core = Core()
    monkeypatch.setattr(cloth_drag, "KIND", cloth_kind(core.scene))
    monkeypatch.setattr(Scene, "begin", lambda scene: None)
    monkeypatch.setattr(Scene, "run", lambda scene, on_frame, begun: core.run(scene, on_frame))
    return core


def _task(**changes: Any) -> SimulateTask:
    cloth = {
        "material": "gray-interlock",
        "fabric": None,
        "mu": 0.25,
        "preset": "fast",
        "mesh": SIDE,
        "frames": 300,
        "seed": 7,
        "self_friction": 0.5,
    }
    return SimulateTask(simulation=ClothDragSimulation(**(cloth | changes)))


def test_a_trajectory_becomes_a_record_and_labels(core: Core, store: DirectoryStore) -> None:
    (result,) = run_tasks([_task()], store)
    assert core.calls == [("gray-interlock", 0.25, 0.5, "fast", SIDE, 300, 7)]
    assert result.outcome == "succeeded"
    assert result.output.labels == {
        "areal_density": fabric("gray-interlock").density,
        "bending_rigidity": np.diag(fabric("gray-interlock").rigidity).tolist(),
        "softening_length": 0.0,
        "stretching_stiffness": fabric("gray-interlock").stretching[0].tolist(),
        "kernel": "baseline",
        "bias_side": -1,
        "landed_side": 1,
        "bias": 1e-5,
        "steps": 1200,
        "unconverged_steps": 3,
        "worst_residual": 2e-4,
        **dict.fromkeys(CHECKS, 0.0),
    }
    with np.load(io.BytesIO(store.read(result.output.record.digest))) as arrays:
        record = {name: values[result.output.record.row] for name, values in arrays.items()}
    assert {name: (values.shape, values.dtype) for name, values in record.items()} == {
        "positions": ((300, 25, 3), np.float32),
        "rest": ((25, 2), np.float32),
        "triangles": ((32, 3), np.int32),
        "self_intersections": ((300,), np.int16),
        "contact_force": ((300, 3), np.float32),
        "holder_force": ((300, 3), np.float32),
    }
    assert record["positions"][-1, :, 0] == pytest.approx(0.25)
    assert record["self_intersections"][[1, 50]].tolist() == [
        1000,
        32767,
    ]  # more than fits is still many


def test_a_run_that_is_not_valid_is_rejected_with_the_reason_of_the_core(
    core: Core, store: DirectoryStore
) -> None:
    core.changes = {"code": "stretch", "reason": "stretch: must be at most 1.25, got 2.5"}
    (result,) = run_tasks([_task()], store)
    assert (result.outcome, result.reason) == ("rejected", Reason.stretch)
    worst = ", ".join(f"{check.name} 0" for check in checks.CHECKS)
    assert result.message == (
        f"stretch: must be at most 1.25, got 2.5; worst values: {worst} at "
        "material = gray-interlock, density = 1, bending = 1, stretching = 1, mu = 0.25, "
        "preset = fast, mesh = 5, frames = 300, seed = 7, self_friction = 0.5"
    )
    assert not (store.root / "artifacts").exists()


@dataclass
class Clips:
    """A dataset of 3 trajectories x 2 textures before it is packed, and its expected arrays."""

    spec: ClothDragSpec
    pack_tasks: list[PackTask]
    arrays: dict[str, np.ndarray[Any, Any]]
    publish_task: Callable[[list[PackOutput]], PublishTask]


@pytest.fixture
def make_clips(core: Core, store: DirectoryStore) -> Callable[..., Clips]:
    def make(rejected: tuple[int, ...] = (), per_shard: int = 4, **changes: Any) -> Clips:
        document = {
            "kind": "cloth_drag",
            "axes": {
                "material": "gray-interlock",
                "mu": [0.1, 0.2, 0.3],
                "texture": ["dots", "plaid"],
                "viewpoint": "right",
            },
            "mesh": SIDE,
            "frames": 2,
            "samples_per_shard": per_shard,
        }
        spec = ClothDragSpec.model_validate(document | changes)
        members = list(samples(spec, BUILDS))
        arrays = {
            array.name: np.full((len(members), *array.shape), array.fill, dtype=array.dtype)
            for array in layout(spec)
        }
        rng = np.random.default_rng(0)
        slots, rejections = [], []
        for i, sample in enumerate(members):
            common = {"slot": i, "sample_key": sample.key, "labels": sample.labels}
            arrays["sample_key"][i] = np.frombuffer(bytes.fromhex(sample.key), dtype=np.uint8)
            arrays["split"][i] = sample.split
            arrays["mu"][i] = sample.labels["mu"]
            arrays["material"][i], arrays["viewpoint"][i] = 2, 2
            arrays["texture"][i] = {"dots": 1, "plaid": 3}[sample.labels["texture"]]
            if i in rejected:
                rejections.append(
                    Rejection(**common, reason=Reason.out_of_frame, message="made up")
                )
                slots.append(PackSlot(**common, split=sample.split, rejection=rejections[-1]))
                continue
            (result,) = run_tasks([SimulateTask(simulation=sample.simulation)], store)
            sizes = {"light": 3, "floor": 8, "creases": (), "frame_share": (), "visible_share": ()}
            sizes |= {f"psnr_{region}": () for region in REGIONS} | {"psnr_deviation": 3}
            measured = {
                name: rng.random(size).astype(np.float32).tolist() for name, size in sizes.items()
            }
            measured |= {"light_seed": i, "lighting": "drawn", "substrate": "ceramic"}
            labels = sample.labels | result.output.labels | measured
            arrays["valid"][i] = True
            codes = {"kernel": 0, "lighting": 0, "substrate": 3}
            for name in (*result.output.labels, *measured):
                arrays[name][i] = codes.get(name, labels[name])
            for name, values in Records(store)(result.output.record.digest).items():
                if name in arrays:
                    arrays[name][i] = values[0]
            arrays["video"][i] = rng.integers(0, 4, arrays["video"].shape[1:])
            arrays["video"][i, 1] += 100
            chunk = encode_clip(arrays["video"][i])
            where = ChunkRef(digest=store.publish(chunk), offset=0, length=len(chunk))
            slots.append(
                PackSlot(
                    slot=i,
                    sample_key=sample.key,
                    split=sample.split,
                    labels=labels,
                    record=result.output.record,
                    chunks={"video": where},
                )
            )
        tasks = [
            PackTask(spec=spec, shard=shard, slots=tuple(slots[first : first + per_shard]))
            for shard, first in enumerate(range(0, len(slots), per_shard))
        ]

        def task_of(packed: list[PackOutput]) -> PublishTask:
            return publish_task(
                spec, BUILDS, [sample.key for sample in members], rejections, packed, store
            )

        return Clips(spec, tasks, arrays, task_of)

    return make


@pytest.mark.parametrize("store_positions", [True, False])
def test_files_are_those_of_zarr_python(
    make_clips: Callable[..., Clips], store: DirectoryStore, tmp_path: Path, store_positions: bool
) -> None:
    clips = make_clips(rejected=(2,), store_positions=store_positions)
    packed = {
        file.path: store.read(file.sha256)
        for task in clips.pack_tasks
        for file in pack(task, store).files
    }
    group = zarr.create_group(tmp_path / "zarr", zarr_format=3)
    for array in layout(clips.spec):
        if array.is_label:  # written by the task that publishes
            continue
        with zarr.config.set({"array.write_empty_chunks": not array.per_sample}):
            create_array(group, array, sample_count=6, samples_per_file=4)[:] = clips.arrays[
                array.name
            ]  # type: ignore[index]
    written = {
        path.relative_to(tmp_path / "zarr").as_posix(): path.read_bytes()
        for path in (tmp_path / "zarr").rglob("*")
        if path.is_file() and path.name != "zarr.json"
    }
    assert ("positions/c/0/0/0/0" in packed) == store_positions
    assert packed.keys() == written.keys()
    assert [path for path in packed if packed[path] != written[path]] == []


def test_three_readers_give_back_what_went_in(
    make_clips: Callable[..., Clips], store: DirectoryStore
) -> None:
    clips = make_clips(rejected=(3,))
    publish(clips.publish_task([pack(task, store) for task in clips.pack_tasks]), store)
    directory = store.dataset_path(clips.spec.dataset_id, 1)
    group = zarr.open_group(directory, mode="r")
    with xarray.open_zarr(directory, chunks=None, mask_and_scale=False) as dataset:
        for name, expected in clips.arrays.items():
            spec = {
                "driver": "zarr3",
                "kvstore": {"driver": "file", "path": f"{directory / name}/"},
            }
            third = tensorstore.open(spec, read=True).result().read().result()
            for got in (group[name][...], dataset[name].values, third):
                assert got.dtype == expected.dtype, name
                assert got.tobytes() == expected.tobytes(), name
        assert dataset["positions"].dims == ("sample", "instant", "vertex", "xyz")
    assert group["video"].attrs["instants"] == [0, 150]
    manifest = Manifest.model_validate_json((directory / "manifest.json").read_bytes())
    assert manifest.pictures == Pictures(
        quality=Quality.standard,
        psnr={
            region: Psnr(
                clips=5,
                median=round(float(np.median(values)), 2),
                worst=round(float(np.quantile(values, 0.01)), 2),
                deviation=round(
                    float(np.median(clips.arrays["psnr_deviation"][clips.arrays["valid"], number])),
                    2,
                ),
            )
            for number, region in enumerate(REGIONS)
            if (values := clips.arrays[f"psnr_{region}"][clips.arrays["valid"]]).size
        },
        frame_share=round(float(clips.arrays["frame_share"][clips.arrays["valid"]].mean()), 4),
        device="cpu",
    )
    card = (directory / "README.md").read_text()
    assert "PSNR of its clips [dB]" in card
    assert "| `gray-interlock` | 13, 16.1 |" in card
    assert "A label `mu` is the mu of this model" in card
    with Image.open(directory / "preview.webp") as picture:
        assert (picture.format, picture.n_frames) == ("WEBP", 2)
    assert manifest.cameras == load_rig("drag")
    assert (
        [camera.name for camera in manifest.cameras]
        == group["viewpoint"].attrs["categories"]
        == list(VIEWPOINTS)
    )


def test_a_trajectory_is_encoded_once_for_all_its_renders(
    make_clips: Callable[..., Clips], store: DirectoryStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoded = []

    def count(array: ArrayLayout, data: np.ndarray[Any, Any]) -> bytes:
        encoded.append(data)
        return encode_sample(array, data)

    monkeypatch.setattr(pack_module, "encode_sample", count)
    for task in make_clips(per_shard=6).pack_tasks:
        pack(task, store)
    assert len(encoded) == 3


def test_a_mesh_of_another_size_is_refused(
    make_clips: Callable[..., Clips], store: DirectoryStore
) -> None:
    (task, *_) = make_clips().pack_tasks
    other = ClothDragSpec.model_validate(task.spec.model_dump() | {"mesh": 7})
    with pytest.raises(
        ValueError,
        match=r"must be float32 of shape \(n, \*\(300, 49, 3\)\) with n > 0; got float32",
    ):
        pack(task.model_copy(update={"spec": other}), store)


def test_records_forget_what_is_too_much(store: DirectoryStore) -> None:
    digests = [store.publish(encode_records({"a": np.full(100, i)})) for i in range(3)]
    records = Records(store, kept_bytes=1700)
    for i in (0, 1, 2, 0):
        assert records(digests[i])["a"].tolist() == [i] * 100
    first = records(digests[0])
    assert records(digests[0]) is first  # kept: it was used last
    assert records(digests[1]) is not records(digests[2])
    store.path(digests[1]).unlink()
    records(digests[2]), records(digests[0])
    with pytest.raises(FileNotFoundError):
        records(digests[1])
