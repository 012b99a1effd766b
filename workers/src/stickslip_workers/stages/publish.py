"""Publish: metadata, manifest and directory of a dataset version. The manifest is written last."""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.chunks import decode_chunk, decode_shard_index, shard_index_size
from stickslip_schemas.keys import canonical_json
from stickslip_schemas.layout import layout
from stickslip_schemas.manifest import (
    GROUP_NAME,
    MANIFEST_NAME,
    SEAL_NAME,
    Manifest,
    Pictures,
    seal_text,
    with_manifest_digest,
)
from stickslip_schemas.samples import SPLITS, dataset_id
from stickslip_schemas.store import CorruptArtifactError, Store
from stickslip_schemas.tasks import FileEntry, PublishOutput, PublishTask, TaskResult

from stickslip_workers.settings import CPU, RENDER_DEVICE
from stickslip_workers.stages.card import CARD_NAME, card
from stickslip_workers.stages.metadata import metadata_files
from stickslip_workers.stages.preview import PREVIEW_NAME, pictured, preview


def run(tasks: Sequence[PublishTask], store: Store) -> list[TaskResult]:
    """Run publish tasks, one after the other."""
    return [TaskResult(outcome="succeeded", output=publish(task, store)) for task in tasks]


def publish(task: PublishTask, store: Store) -> PublishOutput:
    """Write what makes the shards a dataset. Doing it twice, or again after a crash, gives the same bytes."""
    _check_complete(task, store)
    files = list(task.files)
    metadata = metadata_files(task.spec, dataset=task.dataset, version=task.version, sample_count=len(task.sample_keys))
    group = metadata.pop(GROUP_NAME)
    for path, data in metadata.items():
        files.append(FileEntry(path=path, sha256=store.publish(data), size=len(data)))
    manifest = Manifest(
        dataset=task.dataset,
        version=task.version,
        spec=task.spec,
        spec_digest=task.spec.content_digest,
        builds=task.builds,
        certificate=task.certificate,
        cameras=task.spec.cameras(),
        sample_count=len(task.sample_keys),
        valid_count=len(task.sample_keys) - len(task.rejections),
        pictures=_pictures(task, store),
        split_counts=_split_counts(task, store),
        rejections=task.rejections,
        sample_keys=task.sample_keys,
        files=tuple(files),
    )
    if (picture := _preview(task, store)) is not None:
        files.append(FileEntry(path=PREVIEW_NAME, sha256=store.publish(picture), size=len(picture)))
        manifest = manifest.model_copy(update={"files": tuple(files)})
    text = card(manifest)
    files.append(FileEntry(path=CARD_NAME, sha256=store.publish(text), size=len(text)))
    manifest = manifest.model_copy(update={"files": tuple(sorted(files, key=lambda file: file.path))})
    version = task.dataset, task.version
    for file in manifest.files:
        store.show(file.sha256, *version, file.path)
    data = canonical_json(manifest.model_dump(mode="json")).encode()
    digest = store.publish(data)
    group = with_manifest_digest(group, digest)
    group_digest = store.publish(group)
    seal = seal_text(digest, group_digest)
    store.show(group_digest, *version, GROUP_NAME)
    store.show(store.publish(seal), *version, SEAL_NAME)
    store.show(digest, *version, MANIFEST_NAME)
    return PublishOutput(manifest=digest, group=group_digest, bytes=manifest.size + len(data) + len(group) + len(seal))


def _check_complete(task: PublishTask, store: Store) -> None:
    """Refuse a version that lacks a file: a Zarr reader would take it for fill values and say nothing."""
    if task.dataset != dataset_id(task.spec):
        raise ValueError(f"dataset must be the id of its spec, {dataset_id(task.spec)}; got {task.dataset!r}")
    shards = -(-len(task.sample_keys) // task.spec.samples_per_shard)
    expected = {array.shard_path(shard) for array in layout(task.spec) for shard in range(shards)}
    given = {file.path for file in task.files}
    if given != expected or len(task.files) != len(given):
        odd = sorted(given ^ expected) or ["one path twice"]
        raise ValueError(f"files must be those of {shards} shards; missing or unknown are {odd[:3]} and so on")
    for file in task.files:
        if not store.holds(file.sha256, size=file.size):
            raise CorruptArtifactError(
                f"artifact {file.sha256} of {file.path} must have {file.size} bytes and the digest that names it"
            )


def _split_counts(task: PublishTask, store: Store) -> dict[str, int]:
    """Count the valid samples of each split from what the shards say, and check it against the rejections."""
    valid = _column("valid", task, store)
    rejected = sorted(rejection.slot for rejection in task.rejections)
    if np.flatnonzero(~valid).tolist() != rejected:
        raise ValueError(f"rejections must be the slots that are not valid; got {rejected[:5]} and so on")
    counts = np.bincount(_column("split", task, store)[valid], minlength=len(SPLITS))
    return {name: int(number) for name, number in zip(SPLITS, counts, strict=True)}


def _pictures(task: PublishTask, store: Store) -> Pictures | None:
    """Return how good the pictures are: what their quality is worth, and what the image gate said of each sample."""
    measured = task.spec.picture_decibels()
    if measured is None:
        return None
    gate, share, direct = None, None, np.empty(0, dtype=int)
    if any(array.name == "gate_db" for array in layout(task.spec)):
        valid = _column("valid", task, store)
        if valid.any():
            gate = round(float(_column("gate_db", task, store)[valid].min()), 2)
            share = round(float(_column("frame_share", task, store)[valid].mean()), 4)
        direct = np.flatnonzero(valid & ~_column("composed", task, store))
    return Pictures(
        quality=task.spec.quality,
        psnr_db=measured,
        gate_db=gate,
        frame_share=share,
        device=os.environ.get(RENDER_DEVICE) or CPU,  # all workers of this version's builds have the same
        direct_slots=tuple(direct.tolist()),
    )


def _preview(task: PublishTask, store: Store) -> bytes | None:
    """Return the picture of the version; None where nothing is rendered, or valid."""
    array = pictured(task.spec)
    if array is None:
        return None
    files = {file.path: file for file in task.files}
    size = task.spec.samples_per_shard

    def chunk(slot: int) -> bytes:
        file = files[array.shard_path(slot // size)]
        tail = shard_index_size(size)
        index = decode_shard_index(store.read(file.sha256, offset=file.size - tail, length=tail), size)
        offset, length = index[slot % size].tolist()
        return store.read(file.sha256, offset=offset, length=length)

    valid = np.flatnonzero(_column("valid", task, store)).tolist()
    return preview(task.spec, array, valid, chunk)


def _column(name: str, task: PublishTask, store: Store) -> npt.NDArray[Any]:
    """Return the values of a label, by slot, from the shards."""
    (array,) = (array for array in layout(task.spec) if array.name == name)
    digests = {file.path: file.sha256 for file in task.files}
    count = len(task.sample_keys)
    shards = range(-(-count // task.spec.samples_per_shard))
    chunks = [bytes(decode_chunk(store.read(digests[array.shard_path(shard)]))) for shard in shards]
    return np.frombuffer(b"".join(chunks), dtype=array.dtype)[:count]
