"""Pack: byte for byte what zarr-python writes, and nothing that is not sound goes in."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from stickslip_schemas.base import Reason
from stickslip_schemas.documents.tasks import ChunkRef, PackTask
from stickslip_schemas.format.codecs import decode_chunk, decode_shard_index
from stickslip_schemas.format.manifest import layout
from stickslip_schemas.store import DirectoryStore
from stickslip_workers.stages.pack import pack
from stickslip_workers.stages.publish import create_array
from stickslip_workers.stages.run import run_tasks


@pytest.mark.parametrize("views", [True, False])
def test_files_are_those_of_zarr_python(
    make_dataset: Callable[..., Any], tmp_path: Path, views: bool
) -> None:
    dataset = make_dataset(count=7, per_shard=4, rejected=(2,), views=views)
    packed = {
        file.path: dataset.store.read(file.sha256)
        for task in dataset.pack_tasks
        for file in pack(task, dataset.store).files
    }
    group = zarr.create_group(tmp_path / "zarr", zarr_format=3)
    for array in layout(dataset.spec):
        if array.is_label:  # written by the task that publishes
            continue
        # A rejected sample has no chunk in the shard, but a chunk of curves is always there.
        with zarr.config.set({"array.write_empty_chunks": not array.per_sample}):
            target = create_array(group, array, sample_count=7, samples_per_file=4)
            target[:] = dataset.arrays[array.name]  # type: ignore[index]
    written = {
        path.relative_to(tmp_path / "zarr").as_posix(): path.read_bytes()
        for path in (tmp_path / "zarr").rglob("*")
        if path.is_file() and path.name != "zarr.json"
    }
    assert packed.keys() == written.keys()
    assert [path for path in packed if packed[path] != written[path]] == []


def test_packing_again_gives_the_same_files(make_dataset: Callable[..., Any]) -> None:
    dataset = make_dataset()
    assert [pack(task, dataset.store) for task in dataset.pack_tasks] == [
        pack(task, dataset.store) for task in dataset.pack_tasks
    ]


def test_a_rejected_slot_keeps_its_labels(make_dataset: Callable[..., Any]) -> None:
    """Labels of stages before the rejection are kept; only those of later stages are missing."""
    dataset = make_dataset(count=4, per_shard=4, rejected=(2,))
    (task,) = dataset.pack_tasks
    slots = list(task.slots)
    rejection = slots[2].rejection.model_copy(update={"labels": slots[2].labels | {"energy": 1.5}})
    slots[2] = slots[2].model_copy(update={"rejection": rejection})
    output = pack(task.model_copy(update={"slots": tuple(slots)}), dataset.store)
    arrays = [array for array in layout(dataset.spec) if array.is_label]
    data = dataset.store.read(output.labels)
    read = {}
    for array, (offset, length) in zip(arrays, decode_shard_index(data, len(arrays)), strict=True):
        read[array.name] = np.empty((4, *array.shape), array.dtype)
        decode_chunk(data[offset : offset + length], read[array.name])
    assert read["valid"].tolist() == [True, True, False, True]
    for name in ("gamma", "phi0", "phi1", "split", "sample_key"):
        assert np.array_equal(read[name], dataset.arrays[name]), name
    assert read["gamma"][2] == task.slots[2].labels["gamma"]
    assert read["energy"][2] == 1.5
    assert np.isnan(read["color"][2]).all()


def _with_first_slot(task: PackTask, **changes: Any) -> PackTask:
    first, *further = task.slots
    return task.model_copy(update={"slots": (first.model_copy(update=changes), *further)})


def test_a_corrupt_chunk_is_refused(
    make_dataset: Callable[..., Any], store: DirectoryStore
) -> None:
    (task, *_) = make_dataset().pack_tasks
    where = task.slots[0].chunks["views"]
    chunk = bytearray(store.read(where.digest, offset=where.offset, length=where.length))
    chunk[100] ^= 1
    digest = store.publish(bytes(chunk))
    bad = ChunkRef(digest=digest, offset=0, length=len(chunk))
    with pytest.raises(ValueError, match="crc32c of the chunk"):
        pack(_with_first_slot(task, chunks={"views": bad}), store)


def test_a_record_that_was_damaged_on_disk_is_refused(
    make_dataset: Callable[..., Any], store: DirectoryStore
) -> None:
    (task, *_) = make_dataset().pack_tasks
    path = store.path(task.slots[0].record.digest)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(OSError, match="other bytes than its name says"):
        pack(task, store)


def test_a_missing_artifact_is_refused(
    make_dataset: Callable[..., Any], store: DirectoryStore
) -> None:
    (task, *_) = make_dataset().pack_tasks
    store.path(task.slots[0].chunks["views"].digest).unlink()
    with pytest.raises(FileNotFoundError):
        pack(task, store)


def test_what_is_wrong_is_named(make_dataset: Callable[..., Any], store: DirectoryStore) -> None:
    (task, *_) = make_dataset().pack_tasks
    slot = task.slots[0]
    with pytest.raises(ValueError, match="consecutive from 4 and at most 4; got 4 from 0 to 3"):
        pack(task.model_copy(update={"shard": 1}), store)
    with pytest.raises(ValueError, match="chunks of slot 0 must have 'views'"):
        pack(_with_first_slot(task, chunks={}), store)
    with pytest.raises(ValueError, match="labels of slot 0 must have 'energy'"):
        pack(
            _with_first_slot(task, labels={"gamma": 1, "phi0": 1, "phi1": 1, "color": [0] * 3}),
            store,
        )
    with pytest.raises(ValueError, match="with n > 99; got float32"):
        pack(_with_first_slot(task, record=slot.record.model_copy(update={"row": 99})), store)


def test_a_failed_task_names_all_its_damaged_inputs(
    make_dataset: Callable[..., Any], store: DirectoryStore
) -> None:
    task = make_dataset().pack_tasks[1]
    (whole,) = run_tasks([task], store)
    assert whole.outcome == "succeeded"
    chunks = [slot.chunks["views"].digest for slot in task.slots if slot.valid]
    store.path(chunks[0]).unlink()
    store.path(chunks[1]).write_bytes(b"rotten")
    (result,) = run_tasks([task], store)
    assert (result.outcome, result.reason) == ("failed", Reason.storage_error)
    assert set(result.damaged_inputs) == set(chunks[:2])


def test_publishing_a_rotten_shard_names_it(
    make_dataset: Callable[..., Any], store: DirectoryStore
) -> None:
    dataset = make_dataset()
    task = dataset.publish_task
    rotten = dataset.files[3].sha256
    path = store.path(rotten)
    data = bytearray(path.read_bytes())
    data[5] ^= 1
    path.write_bytes(data)
    (result,) = run_tasks([task], store)
    assert (result.outcome, result.reason) == ("failed", Reason.storage_error)
    assert result.damaged_inputs == (rotten,)
    assert not store.dataset_path(task.dataset, 1).exists()


def test_publishing_with_lost_labels_or_lists_names_them(
    make_dataset: Callable[..., Any], store: DirectoryStore
) -> None:
    dataset = make_dataset()
    task = dataset.publish_task
    labels = dataset.packed[1].labels
    store.path(labels).unlink()
    (result,) = run_tasks([task], store)
    assert (result.outcome, result.damaged_inputs) == ("failed", (labels,))
    store.path(task.sections[0]).write_bytes(b"{}")
    (result,) = run_tasks([task], store)
    assert (result.outcome, result.damaged_inputs) == ("failed", (task.sections[0],))
