"""Datasets to test with, written by zarr-python: an independent implementation."""

import json
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from stickslip_schemas.base import Reason, sha256
from stickslip_schemas.format.manifest import MANIFEST_NAME, FileEntry, Manifest, Rejection, layout
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.kinds.cloth_drag import ClothDragSpec
from stickslip_schemas.kinds.rod_hang import RodHangSpec
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.spec.arrays import FORMAT, SPLITS, ArrayLayout, describe
from stickslip_testing.samples import samples
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec, TransposeCodec, ZstdCodec

POINTS = 150


class MadeDataset:
    """A dataset directory, and what was written into it."""

    def __init__(
        self, root: Path, arrays: dict[str, np.ndarray], spec: RodHangSpec | ClothDragSpec
    ) -> None:
        self.root = root
        self.arrays = arrays
        self.spec = spec

    @property
    def manifest(self) -> Manifest:
        return Manifest.model_validate_json((self.root / MANIFEST_NAME).read_bytes())

    def copy(self, root: Path) -> "MadeDataset":
        shutil.copytree(self.root, root)
        return MadeDataset(root, self.arrays, self.spec)

    def rewrite(self, path: str, data: bytes) -> None:
        """Replace a file and let the manifest agree, as a faulty writer would have it."""
        (self.root / path).write_bytes(data)
        if path == "zarr.json":
            seal(self.root)
            return
        entry = FileEntry(path=path, sha256=sha256(data), size=len(data))
        files = tuple(entry if file.path == path else file for file in self.manifest.files)
        self.edit_manifest(files=files)

    def seal(self) -> None:
        """Let the files that vouch for the others agree with what they are now."""
        seal(self.root)

    def edit_manifest(self, **changes: Any) -> None:
        """Change fields of the manifest."""
        manifest = self.manifest.model_copy(update=changes)
        (self.root / MANIFEST_NAME).write_text(manifest.model_dump_json())
        seal(self.root)


def seal(root: Path) -> None:
    """Write the manifest's digest into the group's metadata, and those of both beside them."""
    group = json.loads((root / "zarr.json").read_bytes())
    group.setdefault("attributes", {})["manifest_sha256"] = sha256(
        (root / MANIFEST_NAME).read_bytes()
    )
    (root / "zarr.json").write_text(json.dumps(group))
    lines = [
        f"{sha256((root / name).read_bytes())}  {name}\n" for name in (MANIFEST_NAME, "zarr.json")
    ]
    (root / "manifest.sha256").write_text("".join(lines))


def write_dataset(
    root: Path,
    spec: RodHangSpec | ClothDragSpec,
    content: dict[str, np.ndarray],
    rejected: tuple[int, ...] = (),
) -> MadeDataset:
    """Write a dataset version with zarr-python.

    `content` has the arrays that are not in every dataset.
    """
    builds = Builds(**{stage: sha256(stage.encode()) for stage in Builds.model_fields})
    planned = list(samples(spec, builds))
    valid = np.ones(len(planned), dtype=bool)
    valid[list(rejected)] = False
    arrays = {
        **content,
        "split": np.array([sample.split for sample in planned], dtype=np.uint8),
        "valid": valid,
        "sample_key": np.array(
            [list(bytes.fromhex(sample.key)) for sample in planned], dtype=np.uint8
        ),
    }
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore"
        )  # consolidated metadata are no part of the Zarr v3 specification yet
        group = zarr.create_group(str(root), zarr_format=3, attributes={"format": FORMAT})
        for array in layout(spec):
            values = arrays[array.name].copy()
            if array.name not in ("valid", "split", "sample_key"):
                values[~valid] = array.fill
            _write_array(group, array, values, spec.samples_per_file(array))
            arrays[array.name] = values
        zarr.consolidate_metadata(group.store)
    files = sorted(
        path for path in root.rglob("*") if path.is_file() and path != root / "zarr.json"
    )
    entries = tuple(
        FileEntry(
            path=str(path.relative_to(root)),
            sha256=sha256(path.read_bytes()),
            size=path.stat().st_size,
        )
        for path in files
    )
    manifest = Manifest(
        dataset=spec.dataset_id,
        version=1,
        spec=spec,
        spec_digest=spec.content_digest,
        builds=builds,
        certificate=sha256(b"certificate"),
        cameras=(),
        sample_count=len(planned),
        valid_count=int(valid.sum()),
        split_counts={
            name: int((valid & (arrays["split"] == code)).sum()) for code, name in enumerate(SPLITS)
        },
        rejection_counts={Reason.out_of_frame: len(rejected)} if len(rejected) else {},
        rejections=tuple(
            Rejection(
                slot=slot,
                sample_key=planned[slot].key,
                reason=Reason.out_of_frame,
                message="leaves view 2",
                labels=planned[slot].labels,
            )
            for slot in rejected
        ),
        sample_keys=tuple(sample.key for sample in planned),
        files=entries,
    )
    (root / MANIFEST_NAME).write_text(manifest.model_dump_json())
    seal(root)
    return MadeDataset(root, arrays, spec)


def _write_array(
    group: zarr.Group, array: ArrayLayout, values: np.ndarray, samples_per_file: int
) -> None:
    shard = (samples_per_file, *array.shape)
    compressor = (
        BloscCodec(typesize=4, cname="zstd", clevel=5, shuffle="shuffle")
        if array.is_trajectory
        else None
    )
    if array.is_clip:
        compressor = BloscCodec(typesize=1, cname="lz4hc", clevel=9, shuffle="noshuffle")
    out = group.create_array(
        array.name,
        shape=values.shape,
        dtype=array.dtype,
        chunks=(1, *array.shape) if array.per_sample else shard,
        shards=shard if array.per_sample else None,
        filters=_turned(array),
        serializer=BytesCodec(),
        compressors=[compressor or ZstdCodec(level=3), Crc32cCodec()],
        fill_value=array.fill,
        dimension_names=("sample", *array.dimensions),
        attributes=describe(array),
        # A rejected sample has no chunk; a label that happens to be the fill value has.
        config={"write_empty_chunks": not array.per_sample},
    )
    out[:] = values


def _turned(array: ArrayLayout) -> list[TransposeCodec]:
    order = (0, 2, 4, 1, 3) if array.is_clip else (0, 3, 2, 1) if array.is_trajectory else None
    return [] if order is None else [TransposeCodec(order=order)]


def cloth_spec(**changes: Any) -> ClothDragSpec:
    """Return the spec of a grid of 3 x 2 x 2 x 1 = 12 clips."""
    spec: dict[str, Any] = {
        "kind": "cloth_drag",
        "axes": {
            "material": ["gray-interlock", "royal-target", "camel-ponte-roma"],
            "mu": [0.1, 0.4],
            "texture": ["plaid", "floral"],
            "viewpoint": "left",
        },
        "frames": 2,
        "mesh": 5,
        "samples_per_shard": 8,
        "splits": {"train": 0.5, "validation": 0.25, "test": 0.25},
        **changes,
    }
    return job_spec_adapter.validate_python(spec)


def rod_spec(**changes: Any) -> RodHangSpec:
    """Return the spec of a grid of 5 x 4 x 3 = 60 rods without views."""
    spec: dict[str, Any] = {
        "kind": "rod_hang",
        "axes": {
            "gamma": {"type": "linspace", "start": 100.0, "stop": 1300.0, "num": 5},
            "phi0": [0.5, 2.0, 6.0, 12.0],
            "phi1": [6.0, 12.0, 20.0],
        },
        "views": None,
        "samples_per_shard": 16,
        "splits": {"train": 0.6, "validation": 0.2, "test": 0.2},
        **changes,
    }
    return job_spec_adapter.validate_python(spec)


def curves(gamma: np.ndarray, phi0: np.ndarray, phi1: np.ndarray) -> dict[str, np.ndarray]:
    """Return curves that are like hanging rods, and are not: strains of a made-up form, and their
    exact centrelines.

    kappa(s) = (phi0 (1 - a (1 - s)), b sin(phi0 s) (1 - s), phi1 (1 - a (1 - s))), with a and b
    that grow with gamma. The frame follows R' = R [kappa]_x in small rotations, the centreline x' =
    d1.
    """
    fine = 8
    count = fine * (POINTS - 1)
    s = np.linspace(0.0, 1.0, count + 1)
    a = (gamma / 2600.0)[:, None]
    strains = np.stack(
        [
            phi0[:, None] * (1 - a * (1 - s)),
            4 * a * np.sin(phi0[:, None] * s) * (1 - s),
            phi1[:, None] * (1 - a * (1 - s)),
        ],
        axis=-1,
    )
    frame = np.empty((len(gamma), count + 1, 3, 3))
    frame[:, 0] = [[0, 1, 0], [0, 0, -1], [-1, 0, 0]]  # columns d1 = -z, d2 = x, d3 = -y
    for i in range(count):
        frame[:, i + 1] = frame[:, i] @ _rotation((strains[:, i] + strains[:, i + 1]) / (2 * count))
    tangent = frame[..., 0]
    centerline = np.zeros((len(gamma), count + 1, 3))
    centerline[:, 1:] = np.cumsum((tangent[:, 1:] + tangent[:, :-1]) / (2 * count), axis=1)
    return {
        "centerline": centerline[:, ::fine].astype(np.float32),
        "curvature": strains[:, ::fine].astype(np.float32),
        "frame": frame[:, ::fine].astype(np.float32),
    }


def _rotation(vector: np.ndarray) -> np.ndarray:
    """Return exp([vector]_x) [Rodrigues], (n, 3, 3)."""
    angle = np.linalg.norm(vector, axis=-1)[:, None, None] + 1e-300
    x, y, z = (vector / angle[:, 0]).T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def write_rods(root: Path, spec: RodHangSpec, rejected: tuple[int, ...] = ()) -> MadeDataset:
    """Write a dataset of made-up rods, with noise for pictures where the spec asks for views."""
    builds = Builds(**{stage: sha256(stage.encode()) for stage in Builds.model_fields})
    labels = [sample.labels for sample in samples(spec, builds)]
    parameters = {
        name: np.array([label[name] for label in labels]) for name in ("gamma", "phi0", "phi1")
    }
    content = {**parameters, **curves(**parameters), "energy": np.linspace(-1.0, 1.0, len(labels))}
    content["multistable"] = np.arange(len(labels)) % 3 == 0
    content["self_contact_distance"] = np.where(content["multistable"], 0.02, np.inf)
    content["reach"] = np.linspace(0.0, 0.3, len(labels))
    if spec.views is not None:
        generator = np.random.default_rng(1)
        content["views"] = generator.integers(0, 256, (len(labels), 4, 224, 224, 3), dtype=np.uint8)
        content["color"] = generator.random((len(labels), 3), dtype=np.float32)
    return write_dataset(root, spec, content, rejected)


def write_clips(root: Path, spec: ClothDragSpec, rejected: tuple[int, ...] = ()) -> MadeDataset:
    """Write a dataset of clips that are noise over a few bits, so that they compress a little."""
    builds = Builds(**{stage: sha256(stage.encode()) for stage in Builds.model_fields})
    names = {array.name: array.categories for array in layout(spec)}
    labels = [sample.labels for sample in samples(spec, builds)]
    generator = np.random.default_rng(2)
    content = {
        name: np.array([names[name].index(label[name]) for label in labels], dtype=np.int16)
        for name in ("material", "texture", "viewpoint")
    }
    content["mu"] = np.array([label["mu"] for label in labels])
    width, height = spec.frame_size
    content["video"] = generator.integers(
        1, 6, (len(labels), spec.frames, height, width, 3), dtype=np.uint8
    )
    if spec.ground_truth:
        codes = generator.integers(0, 4, (len(labels), spec.frames, height, width))
        content["segmentation"] = codes.astype(np.uint8)
    if spec.canvas:
        sizes = [spec.picture_size(label["viewpoint"]) for label in labels]
        content["picture_size"] = np.array(sizes, dtype=np.int32)
    for array in layout(spec):
        if array.name in content or array.name in ("valid", "split", "sample_key"):
            continue
        values = generator.standard_normal((len(labels), *array.shape))
        content[array.name] = (0 * values if array.categories else 10 * values).astype(array.dtype)
    if spec.store_positions:  # one mesh for all samples
        content["rest"][:], content["triangles"][:] = content["rest"][0], content["triangles"][0]
    return write_dataset(root, spec, content, rejected)


@pytest.fixture(scope="session")
def clips(tmp_path_factory: pytest.TempPathFactory) -> MadeDataset:
    """12 clips in a full and a half-full shard; 3 and 9 are rejected.

    Do not write into it: copy it.
    """
    return write_clips(tmp_path_factory.mktemp("clips") / "v1", cloth_spec(), rejected=(3, 9))


@pytest.fixture(scope="session")
def rods(tmp_path_factory: pytest.TempPathFactory) -> MadeDataset:
    """60 rods without views; 5 and 59 are rejected. Do not write into it: copy it."""
    return write_rods(tmp_path_factory.mktemp("rods") / "v1", rod_spec(), rejected=(5, 59))


@pytest.fixture(scope="session")
def seen_rods(tmp_path_factory: pytest.TempPathFactory) -> MadeDataset:
    """6 rods with views; 2 is rejected. Do not write into it: copy it."""
    axes = {"gamma": [200.0, 400.0, 800.0], "phi0": [1.0, 3.0], "phi1": 8.0}
    spec = rod_spec(axes=axes, views="rod-4", samples_per_shard=4)
    return write_rods(tmp_path_factory.mktemp("seen") / "v1", spec, rejected=(2,))


@pytest.fixture(scope="session")
def make_rods(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., MadeDataset]:
    """Return a function that writes rods of `rod_spec(**changes)`."""

    def make(rejected: tuple[int, ...] = (), **changes: Any) -> MadeDataset:
        return write_rods(tmp_path_factory.mktemp("rods") / "v1", rod_spec(**changes), rejected)

    return make


@pytest.fixture(scope="session")
def make_clips(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., MadeDataset]:
    """Return a function that writes clips of `cloth_spec(**changes)`."""

    def make(rejected: tuple[int, ...] = (), **changes: Any) -> MadeDataset:
        return write_clips(tmp_path_factory.mktemp("clips") / "v1", cloth_spec(**changes), rejected)

    return make


@pytest.fixture(scope="session")
def sized_clips(tmp_path_factory: pytest.TempPathFactory) -> MadeDataset:
    """6 clips with ground truth, of 66 x 90 and 120 x 66 in frames of 120 x 90; 1 is rejected.

    Do not write into it: copy it.
    """
    lab = {
        "image_size": [640, 480],
        "camera_matrix": [[700.0, 0.0, 319.5], [0.0, 700.0, 239.5], [0.0, 0.0, 1.0]],
        "rvec": [np.pi / 2, 0.0, 0.0],
        "tvec": [0.0, 0.2, 1.0],
        "resolution": [120, 66],
    }
    axes = {
        "material": "gray-interlock",
        "mu": [0.1, 0.5, 0.9],
        "texture": "dots",
        "viewpoint": ["left", "lab"],
    }
    spec = cloth_spec(
        axes=axes,
        viewpoints={"lab": lab},
        resolution=[66, 90],
        ground_truth=["depth", "segmentation"],
    )
    return write_clips(tmp_path_factory.mktemp("sizes") / "v1", spec, rejected=(1,))
