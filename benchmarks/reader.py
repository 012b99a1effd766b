"""CPU time to bring random clips of 30 x 224 x 224 x 3 bytes into a batch: our reader and others, on the same files.

python benchmarks/reader.py [--clips 128] [--batch-size 8] [--epochs 5]

The clips are made here, as no clips of real cloth are in the repository: a textured, shaded square that turns and
slides over a floor with a fixed grain, seen from straight above. The floor that is in sight stays the same to the bit,
as in renders without noise of their own. There are two sets: one that moves all the time, and one that comes to rest
after a quarter of it, as dropped cloth does. Decoding is most of the time, and there is more of it where more moves:
the compression and the share of pixels that change, which are printed, say how kind the clips are to the codec.

Each row is CPU time (user and system, of all threads) for a clip, files in the page cache: the median over epochs,
each a random order of all clips, after one epoch of warming up in which every batch is compared with the clips; in
brackets the least and the most. Rows of others stack the samples of a batch, as Torch's own collate function does.
MosaicML Streaming and WebDataset are peers that are not here: they would need packages that this project does not.
"""

import argparse
import os
import platform
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import tensorstore
import torch
import zarr
from numpy.typing import NDArray
from stickslip_schemas.arrays import FORMAT, ArrayLayout, describe
from stickslip_schemas.builds import Builds
from stickslip_schemas.chunks import encode_shard
from stickslip_schemas.codecs import axes_order, encode_sample, zstd_level
from stickslip_schemas.keys import sha256
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.kinds.cloth_drag import ClothDragSpec
from stickslip_schemas.layout import layout, samples_per_file
from stickslip_schemas.manifest import GROUP_NAME, MANIFEST_NAME, SEAL_NAME, Manifest, seal_text, with_manifest_digest
from stickslip_schemas.samples import SPLITS, dataset_id, samples
from stickslip_schemas.tasks import FileEntry
from stickslip_training.kinds.cloth_drag import ClipDataset
from zarr.codecs import BytesCodec, Crc32cCodec, TransposeCodec, ZstdCodec

Bytes = NDArray[np.uint8]
FRAMES, SIDE = 30, 224
TEXTURES = ("plaid", "dots", "stripes", "checker")


def clip(index: int, moving: float) -> Bytes:
    """Draw one clip, (30, 224, 224, 3), that moves for a share of its time."""
    generator = np.random.default_rng(index)
    v, u = np.mgrid[0:SIDE, 0:SIDE].astype(np.float32) / SIDE - 0.5
    floor = 42 + 6 * np.random.default_rng(0).standard_normal((SIDE, SIDE)).astype(np.float32)
    colors = generator.uniform(60, 230, (2, 3)).astype(np.float32)
    angle, spin = generator.uniform(0, 2 * np.pi), generator.uniform(-1.2, 1.2)
    way, phase = generator.uniform(-0.25, 0.25, 2), generator.uniform(0, 2 * np.pi)
    half, pitch = generator.uniform(0.18, 0.28), generator.uniform(30, 60)
    frames = np.empty((FRAMES, SIDE, SIDE, 3), dtype=np.uint8)
    for number in range(FRAMES):
        t = min(number / FRAMES, moving)
        c, s = np.cos(angle + spin * t), np.sin(angle + spin * t)
        x, y = u - way[0] * (t - 0.5), v - way[1] * (t - 0.5)
        a, b = c * x + s * y, c * y - s * x
        a = a + 0.012 * np.sin(25 * b + phase + 4 * t)  # the outline is not straight
        pattern = _pattern(TEXTURES[index % len(TEXTURES)], a * pitch, b * pitch)[..., None]
        shade = 0.8 + 0.2 * np.sin(18 * a + 9 * b * np.sin(phase) + 5 * t + phase)  # folds that travel
        cloth = (colors[0] * pattern + colors[1] * (1 - pattern)) * shade[..., None]
        inside = (np.maximum(np.abs(a), np.abs(b)) < half)[..., None]
        frames[number] = np.where(inside, cloth, floor[..., None]).clip(0, 255)
    return frames


def _pattern(name: str, a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return how much of the first colour there is at each point, 0 to 1."""
    x, y = np.sin(a), np.sin(b)
    patterns = {"plaid": ((x > 0.3) + 1.0 * (y > 0.3)) / 2, "dots": x * y > 0.4, "stripes": x > 0, "checker": x * y > 0}
    return np.asarray(patterns[name], dtype=np.float32)


def write(root: Path, clips: Bytes, samples_per_shard: int = 64) -> ClothDragSpec:
    """Write the clips as a dataset version, its shards as the packer makes them, its metadata by zarr-python."""
    mu = {"type": "linspace", "start": 0.0, "stop": 1.0, "num": len(clips)}
    axes = {"material": "gray-interlock", "mu": mu, "texture": "plaid", "viewpoint": "calibrated"}
    document: dict[str, Any] = {"kind": "cloth_drag", "axes": axes, "frames": FRAMES, "store_positions": False}
    document["samples_per_shard"] = samples_per_shard
    spec = job_spec_adapter.validate_python(document)
    assert isinstance(spec, ClothDragSpec)
    builds = Builds(**dict.fromkeys(Builds.model_fields, "0" * 64))
    planned = list(samples(spec, builds))
    arrays: dict[str, NDArray[Any]] = {
        "video": clips,
        "material": np.zeros(len(clips), dtype=np.int16),
        "mu": np.array([sample.labels["mu"] for sample in planned]),
        "texture": np.zeros(len(clips), dtype=np.int16),
        "viewpoint": np.zeros(len(clips), dtype=np.int16),
        "split": np.zeros(len(clips), dtype=np.uint8),
        "valid": np.ones(len(clips), dtype=bool),
        "sample_key": np.array([list(bytes.fromhex(sample.key)) for sample in planned], dtype=np.uint8),
    }
    group = zarr.create_group(str(root), zarr_format=3)
    for array in layout(spec):
        if array.name not in arrays:
            arrays[array.name] = np.full((len(clips), *array.shape), array.fill, dtype=array.dtype)
        _write_array(group, root, array, arrays[array.name], samples_per_file(array, spec, FORMAT))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # consolidated metadata are no part of the Zarr v3 specification yet
        zarr.consolidate_metadata(group.store)
    files = tuple(
        FileEntry(path=str(path.relative_to(root)), sha256=sha256(path.read_bytes()), size=path.stat().st_size)
        for path in sorted(root.rglob("*"))
        if path.is_file() and path != root / "zarr.json"
    )
    manifest = Manifest(
        dataset=dataset_id(spec),
        version=1,
        spec=spec,
        spec_digest=spec.content_digest,
        builds=builds,
        cameras=(),
        sample_count=len(clips),
        valid_count=len(clips),
        split_counts={SPLITS[0]: len(clips)},
        rejections=(),
        sample_keys=tuple(sample.key for sample in planned),
        files=files,
    )
    (root / MANIFEST_NAME).write_text(manifest.model_dump_json())
    _seal(root)
    return spec


def _seal(root: Path) -> None:
    """Write the manifest's digest into the group's metadata, and those of both beside them."""
    manifest = sha256((root / MANIFEST_NAME).read_bytes())
    group = with_manifest_digest((root / GROUP_NAME).read_bytes(), manifest)
    (root / GROUP_NAME).write_bytes(group)
    (root / SEAL_NAME).write_bytes(seal_text(manifest, sha256(group)))


def _write_array(group: zarr.Group, root: Path, array: ArrayLayout, values: NDArray[Any], shard_size: int) -> None:
    shard = (shard_size, *array.shape)
    order = axes_order(array)
    out = group.create_array(
        array.name,
        shape=values.shape,
        dtype=array.dtype,
        chunks=(1, *array.shape) if array.per_sample else shard,
        shards=shard if array.per_sample else None,
        filters=[TransposeCodec(order=order)] if order else [],
        serializer=BytesCodec(),
        compressors=[ZstdCodec(level=zstd_level(array)), Crc32cCodec()],
        fill_value=array.fill,
        dimension_names=("sample", *array.dimensions),
        attributes=describe(array),
        config={"write_empty_chunks": True},
    )
    if not array.per_sample:
        out[:] = values
        return
    for first in range(0, len(values), shard_size):
        chunks: list[bytes | None] = [encode_sample(array, value) for value in values[first : first + shard_size]]
        chunks += [None] * (shard_size - len(chunks))
        path = root / array.shard_path(first // shard_size)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_shard(chunks))


def measure(draw: Callable[[list[int]], Any], clips: Bytes, batch_size: int, epochs: int) -> str:
    """Return the CPU time for a clip [ms]: median, least and most over the epochs."""
    generator = np.random.default_rng(0)
    times = []
    for epoch in range(epochs + 1):
        order = generator.permutation(len(clips)).tolist()
        batches = [order[start : start + batch_size] for start in range(0, len(order), batch_size)]
        started = time.process_time()
        for indices in batches:
            batch = draw(indices)
            if epoch == 0:
                assert np.array_equal(np.asarray(batch), clips[indices])
        times.append(1e3 * (time.process_time() - started) / len(clips))
    times = times[1:]
    return f"{statistics.median(times):6.2f}  [{min(times):.2f} - {max(times):.2f}]"


def compare(title: str, clips: Bytes, batch_size: int, epochs: int) -> None:
    """Write the clips, and print a row for each way to read them."""
    changed = float((clips[:, 1:] != clips[:, :-1]).any(axis=-1).mean())
    with tempfile.TemporaryDirectory(prefix="stickslip-reader-") as directory:
        root = Path(directory, "v1")
        root.mkdir()
        write(root, clips)
        raw = Path(directory, "raw")
        raw.mkdir()
        for index, value in enumerate(clips):
            np.save(raw / f"{index}.npy", value)
        stored = sum(path.stat().st_size for path in (root / "video").rglob("*") if path.is_file())
        print(
            f"\n{len(clips)} clips, {title}: {clips.nbytes / 1e6:.0f} MB raw, {stored / 1e6:.1f} MB in shards: "
            f"{clips.nbytes / stored:.1f} times less; {changed:.0%} of pixels change from frame to frame"
        )

        fresh, ring = ClipDataset(root), ClipDataset(root, ring=2)
        array = zarr.open_group(str(root), mode="r")["video"]
        assert isinstance(array, zarr.Array)
        location = {"driver": "zarr3", "kvstore": {"driver": "file", "path": str(root / "video")}}
        store = tensorstore.open(
            location, read=True, context=tensorstore.Context({"data_copy_concurrency": {"limit": 1}})
        ).result()
        rows: dict[str, Callable[[list[int]], Any]] = {
            "ours, new buffers": lambda indices: fresh.__getitems__(indices)["video"],
            "ours, ring of 2 buffers": lambda indices: ring.__getitems__(indices)["video"],
            "zarr-python, stacked": lambda indices: np.stack([np.asarray(array[index]) for index in indices]),
            "tensorstore, stacked": lambda indices: np.stack([store[index].read().result() for index in indices]),
            "np.load of raw clips, stacked": lambda indices: np.stack([np.load(raw / f"{i}.npy") for i in indices]),
        }
        print(f"{'CPU ms a clip':34}median  [least - most]")
        for name, draw in rows.items():
            print(f"{name:34}{measure(draw, clips, batch_size, epochs)}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=int, default=128)
    parser.add_argument("--batch-size", type=int, default=8)
    parser.add_argument("--epochs", type=int, default=5)
    options = parser.parse_args()

    torch.set_num_threads(1)
    print(f"benchmarks/reader.py --clips {options.clips} --batch-size {options.batch_size} --epochs {options.epochs}")
    packages = ("stickslip-training", "numpy", "numcodecs", "google-crc32c", "zarr", "tensorstore", "torch")
    print(f"python {platform.python_version()}, " + ", ".join(f"{name} {version(name)}" for name in packages))
    print(f"{os.cpu_count()} CPUs, load average {os.getloadavg()[0]:.1f}")
    for title, moving in {"always moving": 1.0, "at rest after a quarter": 0.25}.items():
        clips = np.stack([clip(index, moving) for index in range(options.clips)])
        compare(title, clips, options.batch_size, options.epochs)


if __name__ == "__main__":
    main()
