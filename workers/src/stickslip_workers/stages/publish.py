"""Publish: metadata, which zarr-python makes, manifest and directory of a dataset version.

The manifest is last.
"""

import os
import warnings
from collections import Counter
from collections.abc import Sequence
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from stickslip_schemas.base import canonical_json
from stickslip_schemas.documents.tasks import PublishOutput, PublishSection, PublishTask
from stickslip_schemas.format.codecs import (
    ZSTD_LEVEL,
    axes_order,
    decode_chunk,
    decode_shard_index,
    encode_chunk,
    packing,
    shard_index_size,
)
from stickslip_schemas.format.manifest import (
    GROUP_NAME,
    MANIFEST_NAME,
    SEAL_NAME,
    FileEntry,
    Manifest,
    ManifestSection,
    Pictures,
    Psnr,
    Rejection,
    has_sections,
    layout,
    seal_text,
    section_path,
    section_samples,
    with_manifest_digest,
)
from stickslip_schemas.spec.arrays import FORMAT, REGIONS, SPLITS, ArrayLayout, describe
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_schemas.store import CorruptArtifactError, Store, in_parallel

from stickslip_workers.settings import CPU, RENDER_DEVICE
from stickslip_workers.stages.card import CARD_NAME, PREVIEW_NAME, card, pictured, preview

WORST_QUANTILE = 0.01
"""Quantile of the PSNR that stands for the worst clips: 99 % of them are better."""


def metadata_files(
    spec: JobSpec, *, dataset: str, version: int, sample_count: int
) -> dict[str, bytes]:
    """Return the metadata files of a dataset by path: the group, consolidated, and every array."""
    import zarr
    from zarr.storage import MemoryStore

    files: dict[str, object] = {}
    origin = {"format": FORMAT, "dataset": dataset, "version": version}
    group = zarr.create_group(
        MemoryStore(files),  # type: ignore[arg-type]  # the values are zarr's own buffers
        zarr_format=3,
        attributes=origin | {"kind": spec.kind, "spec_digest": spec.content_digest},
    )
    for array in layout(spec):
        create_array(
            group, array, sample_count=sample_count, samples_per_file=spec.samples_per_file(array)
        )
    with warnings.catch_warnings():
        # The Zarr v3 text does not have it yet, but it is the only way to open a group over plain
        # HTTP [zarr-specs #383].
        warnings.filterwarnings("ignore", message="Consolidated metadata", category=UserWarning)
        zarr.consolidate_metadata(group.store)
    return {path: buffer.to_bytes() for path, buffer in files.items()}  # type: ignore[attr-defined]


def create_array(
    group: object, array: ArrayLayout, *, sample_count: int, samples_per_file: int
) -> object:
    """Create `array` in a zarr group, empty, with the codecs that the packer writes."""
    from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec, TransposeCodec, ZstdCodec

    group_shape = (samples_per_file, *array.shape)
    order = axes_order(array)
    compressor: object = ZstdCodec(level=ZSTD_LEVEL, checksum=False)
    blosc = packing(array)
    if blosc is not None:
        itemsize = np.dtype(array.dtype).itemsize
        compressor = BloscCodec(typesize=itemsize, blocksize=0, **blosc._asdict())
    return group.create_array(  # type: ignore[attr-defined]  # zarr.Group; zarr is imported late
        array.name,
        shape=(sample_count, *array.shape),
        dtype=array.dtype,
        chunks=(1, *array.shape) if array.per_sample else group_shape,
        shards=group_shape
        if array.per_sample
        else None,  # the index has crc32c and is at the end, the default of zarr
        filters=() if order is None else (TransposeCodec(order=order),),
        serializer=BytesCodec(endian="little"),
        compressors=(compressor, Crc32cCodec()),
        fill_value=array.fill,
        dimension_names=("sample", *array.dimensions),
        attributes=describe(array),
    )


def publish(task: PublishTask, store: Store) -> PublishOutput:
    """Turn the shards into a dataset version.

    A repetition, even after a crash, gives the same bytes.
    """
    parts = [PublishSection.model_validate_json(store.read(digest)) for digest in task.sections]
    _check_complete(task, parts, store)
    labels = _Labels(task, parts, store)
    metadata = metadata_files(
        task.spec, dataset=task.dataset, version=task.version, sample_count=labels.count
    )
    # The group's metadata will have the digest of the manifest, so it is written after the
    # manifest.
    group = metadata.pop(GROUP_NAME)

    # Store the files that the shards do not have: labels, metadata and the preview.
    files = labels.files()
    for path, data in metadata.items():
        files.append(_stored(store, path, data))
    picture = _preview(task, parts, labels, store)
    if picture is not None:
        files.append(_stored(store, PREVIEW_NAME, picture))

    # The card is made from the manifest, and listed in it.
    sections = _sections(task, parts, store)
    manifest = _manifest(task, parts, labels, files, sections)
    files.append(_stored(store, CARD_NAME, card(manifest)))
    of_shards = list(chain.from_iterable(part.files for part in parts))
    # If the manifest has sections, they list the files of the shards.
    listed = files if sections else [*files, *of_shards]
    in_order = tuple(sorted(listed, key=lambda file: file.path))
    manifest = manifest.model_copy(update={"files": in_order})

    everything = [*of_shards, *files, *sections]
    seal = _show(task, store, everything, manifest, group)
    total = sum(file.size for file in everything)
    return PublishOutput(manifest=seal.manifest, group=seal.group, bytes=total + seal.size)


def _stored(store: Store, path: str, data: bytes) -> FileEntry:
    """Store a file of the version, and return its entry in the manifest."""
    return FileEntry(path=path, sha256=store.publish(data), size=len(data))


def _manifest(
    task: PublishTask,
    parts: Sequence[PublishSection],
    labels: "_Labels",
    files: Sequence[FileEntry],
    sections: tuple[FileEntry, ...],
) -> Manifest:
    """Return the manifest.

    If it has sections, they hold the lists of samples.
    """
    rejections = list(chain.from_iterable(part.rejections for part in parts))
    counts = Counter(str(rejection.reason) for rejection in rejections)
    sample_keys = list(chain.from_iterable(part.sample_keys for part in parts))
    return Manifest(
        dataset=task.dataset,
        version=task.version,
        spec=task.spec,
        spec_digest=task.spec.content_digest,
        builds=task.builds,
        certificate=task.certificate,
        cameras=task.spec.cameras(),
        sample_count=labels.count,
        valid_count=labels.count - len(rejections),
        pictures=_pictures(task, labels),
        split_counts=_split_counts(labels, rejections),
        rejection_counts=dict(sorted(counts.items())),
        sections=sections,
        rejections=() if sections else tuple(rejections),
        sample_keys=() if sections else tuple(sample_keys),
        files=tuple(files),
    )


class _Seal(NamedTuple):
    """The files that make a version complete."""

    manifest: str
    """Digest of the manifest."""
    group: str
    """Digest of the group's metadata, which names the manifest."""
    size: int
    """Size of these files and of the seal [bytes]."""


def _show(
    task: PublishTask,
    store: Store,
    files: Sequence[FileEntry],
    manifest: Manifest,
    group: bytes,
) -> _Seal:
    """Put all files into the directory of the version, with the manifest last."""
    version = (task.dataset, task.version)
    in_parallel(lambda file: store.show(file.sha256, *version, file.path), files)
    data = canonical_json(manifest.model_dump(mode="json")).encode()
    digest = store.publish(data)
    group_with_digest = with_manifest_digest(group, digest)
    group_digest = store.publish(group_with_digest)
    seal = seal_text(digest, group_digest)
    # A version with a manifest is complete, so no file may follow the manifest.
    store.show(group_digest, *version, GROUP_NAME)
    store.show(store.publish(seal), *version, SEAL_NAME)
    store.show(digest, *version, MANIFEST_NAME)
    return _Seal(digest, group_digest, len(data) + len(group_with_digest) + len(seal))


def _check_complete(task: PublishTask, parts: Sequence[PublishSection], store: Store) -> None:
    """Raise if the version lacks a file: a Zarr reader would silently return fill values."""
    if task.dataset != task.spec.dataset_id:
        raise ValueError(
            f"dataset must be the id of its spec, {task.spec.dataset_id}; got {task.dataset!r}"
        )
    bounds = [0, *(section.end for section in parts)]
    if bounds[:-1] != [section.first for section in parts] or bounds[-1] != task.spec.sample_count:
        raise ValueError(
            f"sections must have the samples 0 to {task.spec.sample_count - 1}, and they end at "
            f"{bounds}"
        )
    size = task.spec.samples_per_shard
    arrays = [array for array in layout(task.spec) if not array.is_label]
    for section in parts:
        shards = range(section.first // size, -(-section.end // size))
        expected = {array.shard_path(shard) for array in arrays for shard in shards}
        paths = {file.path for file in section.files}
        if (
            paths != expected
            or len(section.files) != len(paths)
            or len(section.labels) != len(shards)
        ):
            odd = sorted(paths ^ expected) or ["one path twice, or labels"]
            raise ValueError(
                f"files must be those of {len(shards)} shards; missing or unknown are {odd[:3]} "
                "and so on"
            )
        whole = in_parallel(lambda file: store.holds(file.sha256, size=file.size), section.files)
        for file, is_whole in zip(section.files, whole, strict=True):
            if not is_whole:
                raise CorruptArtifactError(
                    f"artifact {file.sha256} of {file.path} must have {file.size} bytes and the "
                    "digest that names it"
                )


class _Labels:
    """The labels of all samples, by name, from the shards."""

    def __init__(self, task: PublishTask, parts: Sequence[PublishSection], store: Store) -> None:
        self.count = task.spec.sample_count
        self._store = store
        self._spec = task.spec
        self.arrays = [array for array in layout(task.spec) if array.is_label]
        self._columns = {
            array.name: np.empty((self.count, *array.shape), array.dtype) for array in self.arrays
        }
        size = task.spec.samples_per_shard
        for section in parts:
            for number, data in enumerate(in_parallel(store.read, section.labels)):
                first = section.first + number * size
                slots = slice(first, min(first + size, self.count))
                index = decode_shard_index(data, len(self.arrays)).tolist()
                for array, (offset, length) in zip(self.arrays, index, strict=True):
                    decode_chunk(data[offset : offset + length], self._columns[array.name][slots])

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        return self._columns[name]

    def files(self) -> list[FileEntry]:
        """Store the files of all labels, and return their entries."""
        array_files = []
        for array in self.arrays:
            file_count = -(-self.count // self._spec.samples_per_file(array))
            array_files += [(array, number) for number in range(file_count)]
        return in_parallel(self._file, array_files)

    def _file(self, array_and_number: tuple[ArrayLayout, int]) -> FileEntry:
        array, number = array_and_number
        size = self._spec.samples_per_file(array)
        chunk = np.full((size, *array.shape), array.fill, array.dtype)  # a chunk is always whole
        values = self._columns[array.name][number * size : (number + 1) * size]
        chunk[: len(values)] = values
        data = encode_chunk(chunk)
        return _stored(self._store, array.shard_path(number), data)


def _sections(
    task: PublishTask, parts: Sequence[PublishSection], store: Store
) -> tuple[FileEntry, ...]:
    """Write the sections of the manifest, or none if the whole manifest fits into one file."""
    if not has_sections(task.spec):
        return ()
    size = section_samples(task.spec)

    def write(part: PublishSection) -> FileEntry:
        fields = {name: getattr(part, name) for name in ManifestSection.model_fields}
        section = ManifestSection(**fields)
        data = canonical_json(section.model_dump(mode="json")).encode()
        return _stored(store, section_path(part.first // size), data)

    return tuple(in_parallel(write, parts))


def _split_counts(labels: _Labels, rejections: Sequence[Rejection]) -> dict[str, int]:
    """Count the valid samples of each split, from the labels in the shards.

    Raises ValueError if they contradict the rejections.
    """
    valid = labels["valid"]
    rejected = sorted(rejection.slot for rejection in rejections)
    if np.flatnonzero(~valid).tolist() != rejected:
        raise ValueError(
            f"rejections must be the slots that are not valid; got {rejected[:5]} and so on"
        )
    counts = np.bincount(labels["split"][valid], minlength=len(SPLITS))
    return {name: int(number) for name, number in zip(SPLITS, counts, strict=True)}


def _pictures(task: PublishTask, labels: _Labels) -> Pictures | None:
    """Return the quality of the pictures, from the measurement of each clip.

    Return None if the version has no pictures.
    """
    if pictured(task.spec) is None:
        return None
    valid = labels["valid"]
    is_measured = any(array.name == "frame_share" for array in labels.arrays) and valid.any()
    share = round(float(labels["frame_share"][valid].mean()), 4) if is_measured else None
    return Pictures(
        quality=task.spec.quality,
        psnr=_psnr_by_region(labels) if is_measured else {},
        frame_share=share,
        # All workers of this version's builds have the same device.
        device=os.environ.get(RENDER_DEVICE) or CPU,
    )


def _psnr_by_region(labels: _Labels) -> dict[str, Psnr]:
    """Return the PSNR of the valid clips in each region with a measurement."""
    valid = labels["valid"]
    psnr: dict[str, Psnr] = {}
    for number, region in enumerate(REGIONS):
        values = labels[f"psnr_{region}"][valid]
        deviations = labels["psnr_deviation"][valid, number]
        # NaN marks a clip without a measurement.
        measured = np.isfinite(values)
        if not measured.any():
            continue
        psnr[region] = Psnr(
            clips=int(measured.sum()),
            median=round(float(np.median(values[measured])), 2),
            worst=round(float(np.quantile(values[measured], WORST_QUANTILE)), 2),
            deviation=round(float(np.median(deviations[measured])), 2),
        )
    return psnr


def _preview(
    task: PublishTask, parts: Sequence[PublishSection], labels: _Labels, store: Store
) -> bytes | None:
    """Return the picture of the version, or None without pictures or valid samples."""
    array = pictured(task.spec)
    if array is None:
        return None
    files = {}
    for section in parts:
        files.update({file.path: file for file in section.files})
    samples_per_shard = task.spec.samples_per_shard
    index_bytes = shard_index_size(samples_per_shard)

    def read_chunk(slot: int) -> bytes:
        # Read only the index of a shard and one chunk, because a shard may have gigabytes.
        shard, row = divmod(slot, samples_per_shard)
        file = files[array.shard_path(shard)]
        tail = store.read(file.sha256, offset=file.size - index_bytes, length=index_bytes)
        offset, length = decode_shard_index(tail, samples_per_shard)[row].tolist()
        return store.read(file.sha256, offset=offset, length=length)

    return preview(task.spec, array, np.flatnonzero(labels["valid"]).tolist(), read_chunk)
