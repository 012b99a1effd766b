"""CPU time to bring random rendered clips into a batch: our reader, and others on the same clips.

python benchmarks/reader.py DATASET [--clips 128] [--batch-size 8] [--epochs 5]

DATASET is a directory of `cloth_drag` clips, as `stickslip pull` gives it. Each row is CPU time
(user and system, of all threads) for a clip, files in the page cache: the median over epochs, each
a random order of all clips, after one epoch of warming up in which every batch is compared with the
clips; in brackets the least and the most. Samples are stacked into a batch, as Torch's own collate
function does. WebDataset reads its tar files in their order; its own shuffling is left out, which
is to its advantage. All but the first four rows read raw pixels, without compression.

A peer that is not installed has no row. MosaicML Streaming wants numpy < 2.2, so it needs an
environment of its own (docs/export.md says how to make one).
"""

import argparse
import os
import platform
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stickslip_training.data.samples import Samples

Bytes = NDArray[np.uint8]
Draw = Callable[[list[int]], Any]


def stickslip_reader(root: Path, clips: Bytes, scratch: Path) -> Iterator[tuple[str, Draw]]:
    """Yield our reader with new buffers and with a ring of two, which training uses."""
    fresh, ring = Samples(root), Samples(root, ring=2)
    yield "ours, new buffers", lambda indices: fresh.__getitems__(indices)["video"]
    yield "ours, ring of 2 buffers", lambda indices: ring.__getitems__(indices)["video"]


def zarr_python(root: Path, clips: Bytes, scratch: Path) -> Iterator[tuple[str, Draw]]:
    """Yield zarr-python on our files."""
    import zarr

    array = zarr.open_group(str(root), mode="r")["video"]
    assert isinstance(array, zarr.Array)
    yield "zarr-python", lambda indices: np.stack([np.asarray(array[index]) for index in indices])


def tensorstore(root: Path, clips: Bytes, scratch: Path) -> Iterator[tuple[str, Draw]]:
    """Yield tensorstore on our files, in one thread."""
    import tensorstore as library

    location = {"driver": "zarr3", "kvstore": {"driver": "file", "path": str(root / "video")}}
    context = library.Context({"data_copy_concurrency": {"limit": 1}})
    store = library.open(location, read=True, context=context).result()
    yield (
        "tensorstore",
        lambda indices: np.stack([store[index].read().result() for index in indices]),
    )


def npy(root: Path, clips: Bytes, scratch: Path) -> Iterator[tuple[str, Draw]]:
    """Yield one .npy file a clip."""
    for index, clip in enumerate(clips):
        np.save(scratch / f"{index}.npy", clip)
    yield (
        "np.load, raw",
        lambda indices: np.stack([np.load(scratch / f"{index}.npy") for index in indices]),
    )


def h5py(root: Path, clips: Bytes, scratch: Path) -> Iterator[tuple[str, Draw]]:
    """Yield HDF5 with a chunk for each clip: raw, and with a checksum.

    `stickslip export --hdf5` adds the checksum.
    """
    import h5py as library

    for title, checked in (("HDF5, raw", False), ("HDF5, raw, with Fletcher's checksum", True)):
        path = scratch / f"{checked}.h5"
        with library.File(path, "w") as file:
            file.create_dataset(
                "video", data=clips, chunks=(1, *clips.shape[1:]), fletcher32=checked
            )
        video = library.File(path)["video"]

        def draw(indices: list[int], video: Any = video) -> Bytes:
            return np.stack([video[index] for index in indices])

        yield title, draw


def streaming(root: Path, clips: Bytes, scratch: Path) -> Iterator[tuple[str, Draw]]:
    """Yield MosaicML Streaming with columns of fixed type and shape."""
    # torchvision, which it imports, cannot register its operators with PyTorch's build for CPUs.
    operators: Any = torch.library.Library("torchvision", "FRAGMENT")  # type: ignore[no-untyped-call]
    for name in ("nms", "qnms"):
        operators.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    import streaming as library

    shape = ",".join(map(str, clips.shape[1:]))
    with library.MDSWriter(
        out=str(scratch / "mds"), columns={"video": f"ndarray:uint8:{shape}"}
    ) as writer:
        for clip in clips:
            writer.write({"video": clip})
    rows = library.StreamingDataset(local=str(scratch / "mds"), shuffle=False, batch_size=1)
    yield "MDS, raw", lambda indices: np.stack([rows[index]["video"] for index in indices])


def webdataset(root: Path, clips: Bytes, scratch: Path) -> Iterator[tuple[str, Draw]]:
    """Yield WebDataset on a tar file of .npy files, in its order."""
    import webdataset as library

    with library.TarWriter(str(scratch / "clips.tar")) as writer:
        for index, clip in enumerate(clips):
            writer.write({"__key__": f"{index:06d}", "video.npy": clip})
    rows = library.WebDataset(str(scratch / "clips.tar"), shardshuffle=False).decode()
    stream = iter(())

    def draw(indices: list[int]) -> Bytes:
        nonlocal stream
        if indices[0] == 0:
            stream = iter(rows)
        return np.stack([next(stream)["video.npy"] for _ in indices])

    yield "WebDataset, .npy", draw


READERS = (stickslip_reader, zarr_python, tensorstore, npy, h5py, streaming, webdataset)
PACKAGES = {"ours": None, "zarr_python": "zarr", "npy": None}


def measure(
    draw: Draw, clips: Bytes, batch_size: int, epochs: int, *, in_order: bool
) -> tuple[float, float, float]:
    """Return the CPU time for a clip [ms]: median, least and most over the epochs."""
    generator = np.random.default_rng(0)
    times = []
    for epoch in range(epochs + 1):
        order = (np.arange(len(clips)) if in_order else generator.permutation(len(clips))).tolist()
        batches = [order[start : start + batch_size] for start in range(0, len(order), batch_size)]
        spent = 0.0
        for indices in batches:
            started = time.process_time()
            batch = draw(indices)
            spent += time.process_time() - started
            if epoch == 0:
                assert np.array_equal(np.asarray(batch), clips[indices])
            del batch
        times.append(1e3 * spent / len(clips))
    times = times[1:]
    return statistics.median(times), min(times), max(times)


def packages() -> str:
    names = (
        "numpy",
        "numcodecs",
        "google-crc32c",
        "zarr",
        "tensorstore",
        "h5py",
        "mosaicml-streaming",
        "webdataset",
        "torch",
    )
    versions = []
    for name in names:
        try:
            versions.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return ", ".join(versions)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--clips", type=int, default=128)
    parser.add_argument("--batch-size", type=int, default=8)
    parser.add_argument("--epochs", type=int, default=5)
    options = parser.parse_args()

    torch.set_num_threads(1)
    warnings.simplefilter("ignore", ResourceWarning)  # webdataset closes no file
    print(
        f"benchmarks/reader.py --clips {options.clips} --batch-size {options.batch_size} --epochs "
        f"{options.epochs}"
    )
    print(f"python {platform.python_version()}, {packages()}")
    print(f"{os.cpu_count()} CPUs, load average {os.getloadavg()[0]:.1f}")

    everything = Samples(options.dataset)
    count = min(options.clips, len(everything))
    clips = np.stack([np.asarray(everything[index]["video"]) for index in range(count)])
    stored = sum(
        path.stat().st_size for path in (options.dataset / "video").rglob("*") if path.is_file()
    )
    raw = clips[0].nbytes * len(everything)
    ratio = (
        f"{raw / 1e6:.0f} MB raw, {stored / 1e6:.0f} MB in shards: {raw / stored:.2f} times less"
    )
    print(f"{count} of {len(everything)} clips; all have {ratio}")
    print(f"{'CPU ms a clip':40}median  [least - most]  of MDS")
    rows: dict[str, tuple[float, float, float]] = {}
    with tempfile.TemporaryDirectory(prefix="stickslip-reader-") as scratch:
        for reader in READERS:
            package = PACKAGES.get(reader.__name__, reader.__name__)
            if package is not None and find_spec(package) is None:
                continue
            for title, draw in reader(options.dataset, clips, Path(scratch)):
                in_order = reader is webdataset
                rows[title] = measure(
                    draw, clips, options.batch_size, options.epochs, in_order=in_order
                )
    peer = rows.get("MDS, raw")
    for title, (median, least, most) in rows.items():
        ratio = f"{median / peer[0]:8.2f}" if peer else ""
        print(f"{title:40}{median:6.2f}  [{least:.2f} - {most:.2f}]{ratio}")


if __name__ == "__main__":
    main()
