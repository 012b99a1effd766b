"""Pack: the files of one shard group, one for each array.

They are byte for byte the files of zarr-python. Labels are not files yet: the task that publishes
writes the labels of many shard groups into one file.
"""

import numpy as np
import numpy.typing as npt
from stickslip_schemas.documents.tasks import PackOutput, PackSlot, PackTask, RecordRef
from stickslip_schemas.format.codecs import check_chunk, encode_chunk, encode_sample, encode_shard
from stickslip_schemas.format.manifest import FileEntry, layout
from stickslip_schemas.spec.arrays import ArrayLayout
from stickslip_schemas.store import Store

from stickslip_workers.stages.run import Array, Records


def pack(task: PackTask, store: Store) -> PackOutput:
    """Make the file of shard `task.shard` of every array, and the artifact with its labels."""
    _check_slots(task)
    shard = _Shard(task, store)
    for row, slot in enumerate(task.slots):
        shard.fill(row, slot)
    files = []
    arrays = layout(task.spec)
    labels = store.publish(
        encode_shard([shard.encode(array) for array in arrays if array.is_label])
    )
    for array in arrays:
        if array.is_label:
            continue
        data = shard.encode(array)
        digest = store.publish(data)
        files.append(FileEntry(path=array.shard_path(task.shard), sha256=digest, size=len(data)))
    return PackOutput(files=tuple(files), labels=labels)


def _check_slots(task: PackTask) -> None:
    size = task.spec.samples_per_shard
    first = task.shard * size
    slots = [slot.slot for slot in task.slots]
    if len(slots) > size or slots != list(range(first, first + len(slots))):
        raise ValueError(
            f"slots of shard {task.shard} must be consecutive from {first} and at most {size}; "
            f"got {len(slots)} from {slots[0]} to {slots[-1]}"
        )


class _Shard:
    """A shard group, filled sample by sample.

    A record has megabytes and is read once.
    """

    def __init__(self, task: PackTask, store: Store) -> None:
        self._store = store
        self._records = Records(store)
        self._arrays = layout(task.spec)
        size = task.spec.samples_per_shard
        # A missing sample has no chunk. In a column it keeps the fill value, because a chunk is
        # always whole.
        self._chunks: dict[str, list[bytes | None]] = {
            array.name: [None] * size for array in self._arrays if array.per_sample
        }
        self._columns: dict[str, Array] = {
            array.name: np.full(
                (len(task.slots) if array.is_label else size, *array.shape), array.fill, array.dtype
            )
            for array in self._arrays
            if not array.per_sample
        }
        self._trajectories: dict[tuple[str, RecordRef], bytes] = {}

    def fill(self, row: int, slot: PackSlot) -> None:
        """Put a sample into its row.

        Raises ValueError if parts of the sample are missing.
        """
        self._check_labels(slot)
        for array in self._arrays:
            if not array.per_sample and not array.is_recorded:
                self._columns[array.name][row] = _label(array, slot)
            elif not slot.valid:
                continue
            elif not array.per_sample:
                self._columns[array.name][row] = self._recorded(array, _record(slot))
            elif array.is_recorded:
                self._chunks[array.name][row] = self._trajectory(array, _record(slot))
            else:
                self._chunks[array.name][row] = self._rendered(array, slot)

    def _check_labels(self, slot: PackSlot) -> None:
        """Raise ValueError for a label without an array: it would be lost silently."""
        columns = {
            array.name for array in self._arrays if not array.per_sample and not array.is_recorded
        }
        unknown = sorted(set(slot.labels) - columns)
        if unknown:
            raise ValueError(
                f"labels of slot {slot.slot} must have an array each; there is none for {unknown}"
            )

    def encode(self, array: ArrayLayout) -> bytes:
        """Return the file of an array, or the chunk of a label."""
        if array.per_sample:
            return encode_shard(self._chunks[array.name])
        return encode_chunk(self._columns[array.name])

    def _rendered(self, array: ArrayLayout, slot: PackSlot) -> bytes:
        """Return an encoded chunk as the renderer wrote it."""
        if array.name not in slot.chunks:
            raise ValueError(
                f"chunks of slot {slot.slot} must have {array.name!r}; got {sorted(slot.chunks)}"
            )
        part = slot.chunks[array.name]
        chunk = self._store.read(part.digest, offset=part.offset, length=part.length)
        check_chunk(chunk)
        return chunk

    def _trajectory(self, array: ArrayLayout, record: RecordRef) -> bytes:
        """Return the encoded chunk of a trajectory.

        The renders of one simulation share the chunk.
        """
        key = array.name, record
        if key not in self._trajectories:
            self._trajectories[key] = encode_sample(array, self._recorded(array, record))
        return self._trajectories[key]

    def _recorded(self, array: ArrayLayout, record: RecordRef) -> Array:
        values = self._records(record.digest)[array.name]
        if (
            values.shape[1:] != array.shape
            or values.dtype != array.dtype
            or record.row >= len(values)
        ):
            raise ValueError(
                f"{array.name!r} of artifact {record.digest} must be {array.dtype} of shape "
                f"(n, *{array.shape}) with n > {record.row}; got {values.dtype} of shape "
                f"{values.shape}"
            )
        row: Array = values[record.row]
        return row


def _record(slot: PackSlot) -> RecordRef:
    if slot.record is None:
        raise ValueError(f"record of slot {slot.slot} must be there, for the slot is valid")
    return slot.record


def _label(array: ArrayLayout, slot: PackSlot) -> npt.ArrayLike:
    """Return the value of a label.

    A rejected slot also has its parameters. A label that no stage could add has the fill value.
    """
    if array.name == "valid":
        return slot.valid
    if array.name == "split":
        return slot.split
    if array.name == "sample_key":
        return np.frombuffer(bytes.fromhex(slot.sample_key), dtype=np.uint8)
    labels = slot.labels if slot.rejection is None else {**slot.rejection.labels, **slot.labels}
    if array.name not in labels:
        if slot.valid:
            raise ValueError(
                f"labels of slot {slot.slot} must have {array.name!r}; got {sorted(labels)}"
            )
        return array.fill
    value: npt.ArrayLike = labels[array.name]
    return array.categories.index(str(value)) if array.categories else value
