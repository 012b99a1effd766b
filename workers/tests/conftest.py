"""A made-up dataset of rods: its tasks, and what its arrays must hold."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stickslip_schemas.base import Reason
from stickslip_schemas.documents.tasks import (
    ChunkRef,
    PackOutput,
    PackSlot,
    PackTask,
    PublishTask,
    RecordRef,
)
from stickslip_schemas.format.codecs import encode_chunk
from stickslip_schemas.format.manifest import FileEntry, Rejection, layout
from stickslip_schemas.kinds.rod_hang import RodHangSpec
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.store import DirectoryStore
from stickslip_testing.samples import samples
from stickslip_workers.cluster import RayCluster, head_directory
from stickslip_workers.stages.pack import pack
from stickslip_workers.stages.publish import publish
from stickslip_workers.stages.run import encode_records

# Ray looks once, when it is first imported, and test_results imports it.
os.environ |= {"RAY_AUTH_MODE": "token", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
HERE = str(Path(__file__).parent)
sys.path.append(HERE)  # coordinator_double, fake_renderer, publishing

from publishing import publish_task  # noqa: E402

BUILDS = Builds(sim_core="0" * 64, simulate="1" * 64, render="2" * 64, pack="3" * 64)


@dataclass
class PackedDataset:
    """A dataset before it is packed: `arrays` is what every reader must give back."""

    spec: RodHangSpec
    store: DirectoryStore
    pack_tasks: list[PackTask]
    arrays: dict[str, np.ndarray[Any, Any]]
    rejections: tuple[Rejection, ...]
    sample_keys: tuple[str, ...]
    packed: list[PackOutput] = field(default_factory=list)

    @property
    def publish_task(self) -> PublishTask:
        """The task that ends it; packs first where that has not been done."""
        if not self.packed:
            self.packed = [pack(task, self.store) for task in self.pack_tasks]
        return publish_task(
            self.spec, BUILDS, self.sample_keys, self.rejections, self.packed, self.store
        )

    @property
    def files(self) -> list[FileEntry]:
        """What was packed."""
        return [file for output in self.packed for file in output.files]

    def publish(self) -> Path:
        """Pack and publish, and return the directory."""
        publish(self.publish_task, self.store)
        return self.store.dataset_path(self.spec.dataset_id, 1)


@pytest.fixture
def store(tmp_path: Path) -> DirectoryStore:
    return DirectoryStore(tmp_path / "store")


@pytest.fixture
def make_dataset(store: DirectoryStore) -> Callable[..., PackedDataset]:
    """Make up a dataset: `make_dataset(count=7, per_shard=4, rejected=(2,), views=True)`."""

    def make(
        *, count: int = 7, per_shard: int = 4, rejected: tuple[int, ...] = (2,), views: bool = True
    ) -> PackedDataset:
        rng = np.random.default_rng(count)
        spec = RodHangSpec.model_validate(
            {
                "kind": "rod_hang",
                "axes": {"gamma": list(np.linspace(1.0, 50.0, count)), "phi0": 2.0, "phi1": 5.0},
                "samples_per_shard": per_shard,
                "views": "rod-4" if views else None,
            }
        )
        members = list(samples(spec, BUILDS))
        arrays = {
            array.name: np.full((count, *array.shape), array.fill, dtype=array.dtype)
            for array in layout(spec)
        }
        curves = {
            name: rng.standard_normal((count, *arrays[name].shape[1:])).astype(np.float32)
            for name in ("centerline", "curvature", "frame")
        }
        curves |= {
            "multistable": rng.random(count) < 0.5,
            "self_contact_distance": np.where(rng.random(count) < 0.5, np.inf, rng.random(count)),
            "reach": rng.random(count),
        }
        artifact = store.publish(encode_records(curves))
        slots, rejections = [], []
        for sample in members:
            i = sample.slot
            arrays["sample_key"][i] = np.frombuffer(bytes.fromhex(sample.key), dtype=np.uint8)
            arrays["split"][i] = sample.split
            for name in ("gamma", "phi0", "phi1"):
                arrays[name][i] = sample.labels[name]
            common = {"slot": i, "sample_key": sample.key, "labels": sample.labels}
            if i in rejected:
                rejections.append(
                    Rejection(**common, reason=Reason.out_of_frame, message="made up")
                )
                slots.append(PackSlot(**common, split=sample.split, rejection=rejections[-1]))
                continue
            labels = {**sample.labels, "energy": float(rng.standard_normal())}
            arrays["valid"][i] = True
            arrays["energy"][i] = labels["energy"]
            for name, values in curves.items():
                arrays[name][i] = values[i]
            chunks = {}
            if views:
                labels["color"] = [float(value) for value in rng.random(3)]
                arrays["color"][i] = labels["color"]
                picture = np.repeat(
                    rng.integers(0, 255, (4, 224, 28, 3), dtype=np.uint8), 8, axis=2
                )
                arrays["views"][i] = picture
                chunk = encode_chunk(picture)
                # Somewhere in a larger artifact, as a renderer may leave it.
                digest = store.publish(b"#" * i + chunk + b"...")
                chunks["views"] = ChunkRef(digest=digest, offset=i, length=len(chunk))
            slots.append(
                PackSlot(
                    slot=i,
                    sample_key=sample.key,
                    split=sample.split,
                    labels=labels,
                    record=RecordRef(digest=artifact, row=i),
                    chunks=chunks,
                )
            )
        tasks = [
            PackTask(spec=spec, shard=shard, slots=tuple(slots[first : first + per_shard]))
            for shard, first in enumerate(range(0, count, per_shard))
        ]
        return PackedDataset(
            spec, store, tasks, arrays, tuple(rejections), tuple(sample.key for sample in members)
        )

    return make


class Connected(RayCluster):
    """A place of which this process is a driver already."""

    def connect(self) -> None:
        """Do nothing."""


@pytest.fixture(scope="session")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RayCluster]:
    """A Ray of two CPUs for all tests, with `fake_renderer` in reach of its processes."""
    directory = head_directory(tmp_path_factory.mktemp("ray"))
    command = "from pathlib import Path; from stickslip_workers.cluster import run_head; "
    command += f"run_head(Path('{directory}'), 2)"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", HERE, prepend=os.pathsep)
        with subprocess.Popen([sys.executable, "-c", command], stdout=subprocess.DEVNULL) as head:
            try:
                place = Connected(directory)
                RayCluster.connect(place)
                yield place
            finally:
                import ray

                ray.shutdown()
                head.terminate()
    shutil.rmtree(directory)
