"""Pack: the files of one shard group, one for each array, byte for byte as zarr-python would write them."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from stickslip_schemas.chunks import check_chunk, encode_chunk, encode_shard
from stickslip_schemas.layout import ArrayLayout, layout
from stickslip_schemas.store import Store
from stickslip_schemas.tasks import FileEntry, PackOutput, PackSlot, PackTask

from stickslip_workers.stages.kinds import kind_of
from stickslip_workers.stages.records import Array, Records


def pack(task: PackTask, store: Store) -> PackOutput:
    """Make the file of shard `task.shard` of every array."""
    _check_slots(task)
    records = Records(store)
    record_arrays = kind_of(task.spec.kind).record_arrays
    size = task.spec.samples_per_shard
    files = []
    for array in layout(task.spec):
        if array.per_sample:
            data = encode_shard(_chunks(array, task.slots, size, store))
        else:
            # Slots beyond the last sample keep the fill value: a chunk is always whole.
            column: Array = np.full((size, *array.shape), array.fill, dtype=array.dtype)
            for row, slot in enumerate(task.slots):
                if array.name in record_arrays:
                    _fill_record(column, row, array, slot, records)
                else:
                    column[row] = _label(array, slot)
            data = encode_chunk(column)
        digest = store.publish(data)
        files.append(FileEntry(path=array.shard_path(task.shard), sha256=digest, size=len(data)))
    return PackOutput(files=tuple(files))


def _check_slots(task: PackTask) -> None:
    size = task.spec.samples_per_shard
    first = task.shard * size
    slots = [slot.slot for slot in task.slots]
    if len(slots) > size or slots != list(range(first, first + len(slots))):
        raise ValueError(
            f"slots of shard {task.shard} must be consecutive from {first} and at most {size}; "
            f"got {len(slots)} from {slots[0]} to {slots[-1]}"
        )


def _chunks(array: ArrayLayout, slots: Sequence[PackSlot], size: int, store: Store) -> list[bytes | None]:
    """Return the encoded chunks as the renderer wrote them; None where there is nothing."""
    chunks: list[bytes | None] = [None] * size
    for position, slot in enumerate(slots):
        if not slot.valid:
            continue
        if array.name not in slot.chunks:
            raise ValueError(f"chunks of slot {slot.slot} must have {array.name!r}; got {sorted(slot.chunks)}")
        where = slot.chunks[array.name]
        chunk = store.read(where.digest, offset=where.offset, length=where.length)
        check_chunk(chunk)
        chunks[position] = chunk
    return chunks


def _fill_record(column: Array, row: int, array: ArrayLayout, slot: PackSlot, records: Records) -> None:
    if not slot.valid:
        return
    if slot.record is None:
        raise ValueError(f"record of slot {slot.slot} must be there, for the slot is valid")
    values = records(slot.record.digest)[array.name]
    if values.shape[1:] != array.shape or values.dtype != array.dtype or slot.record.row >= len(values):
        raise ValueError(
            f"{array.name!r} of artifact {slot.record.digest} must be {array.dtype} of shape (n, *{array.shape}) "
            f"with n > {slot.record.row}; got {values.dtype} of shape {values.shape}"
        )
    column[row] = values[slot.record.row]


def _label(array: ArrayLayout, slot: PackSlot) -> npt.ArrayLike:
    """Return the value of a label. A rejected slot has its parameters too; what no stage could add is fill."""
    if array.name == "valid":
        return slot.valid
    if array.name == "split":
        return slot.split
    if array.name == "sample_key":
        return np.frombuffer(bytes.fromhex(slot.sample_key), dtype=np.uint8)
    labels = slot.labels if slot.rejection is None else {**slot.rejection.labels, **slot.labels}
    if array.name not in labels:
        if slot.valid:
            raise ValueError(f"labels of slot {slot.slot} must have {array.name!r}; got {sorted(labels)}")
        return array.fill
    value: npt.ArrayLike = labels[array.name]
    return array.categories.index(str(value)) if array.categories else value
