"""A worker that runs no simulation.

It finishes tasks at once with invented data, which it stores as a real worker does.
"""

import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import prod
from typing import Any

import numpy as np
from stickslip_schemas.base import Reason, Stage
from stickslip_schemas.documents.tasks import (
    ChunkRef,
    PackOutput,
    PackTask,
    PublishOutput,
    PublishSection,
    PublishTask,
    RecordRef,
    RenderOutput,
    SimulateOutput,
    TaskResult,
    input_digests,
)
from stickslip_schemas.documents.worker_api import (
    Heartbeat,
    HeartbeatAnswer,
    Lease,
    LeaseRequest,
    LeaseState,
    Report,
    ReportBatch,
    WorkerCondition,
    WorkerRegistration,
)
from stickslip_schemas.format.codecs import (
    decode_chunk,
    decode_shard_index,
    encode_chunk,
    encode_sample,
    encode_shard,
)
from stickslip_schemas.format.manifest import (
    GROUP_NAME,
    MANIFEST_NAME,
    SEAL_NAME,
    FileEntry,
    Manifest,
    ManifestSection,
    has_sections,
    layout,
    seal_text,
    section_path,
    with_manifest_digest,
)
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.spec.arrays import ArrayLayout
from stickslip_schemas.store import Store
from stickslip_services.queue.context import Context
from stickslip_services.queue.heartbeat import reconcile_leases, renew_leases
from stickslip_services.queue.lease import lease_tasks, register_worker
from stickslip_services.queue.results import report_results

BUILDS = Builds(sim_core="9" * 64, simulate="a" * 64, render="b" * 64, pack="c" * 64)


ALL_STAGES = dict.fromkeys(Stage, 1000)


def failure(reason: Reason = Reason.renderer_crash, message: str = "it crashed") -> TaskResult:
    """Return the result of a failed attempt."""
    return TaskResult(outcome="failed", reason=reason, message=message, wall_seconds=1.0)


def rejection(message: str = "it diverged", reason: Reason = Reason.solver_diverged) -> TaskResult:
    """Return the result of a rejected sample."""
    return TaskResult(outcome="rejected", reason=reason, message=message, wall_seconds=1.0)


def heartbeat(context: Context, message: Heartbeat) -> HeartbeatAnswer:
    """Answer a heartbeat alone."""
    (left,) = renew_leases(context, [message])
    return HeartbeatAnswer(drop=()) if left is None else reconcile_leases(context, message, left)


class DirectApi:
    """The worker API as calls within this process."""

    def __init__(self, context: Context) -> None:
        self.register = partial(register_worker, context)
        self.lease = partial(lease_tasks, context)
        self.heartbeat = partial(heartbeat, context)
        self.report = partial(report_results, context)


@dataclass
class PretendWorker:
    """A dispatcher that finishes tasks at once and stores invented data.

    `judge` may give other results.
    """

    api: Any  # DirectApi or HttpApi
    store: Store
    name: str = "pretend"
    builds: Builds = BUILDS
    kinds: tuple[str, ...] = ("rod_hang",)
    slots: int = 2
    judge: Callable[[Any], TaskResult | None] = lambda _task: None
    id: str = ""
    finished_ids: list[str] = field(default_factory=list)
    whole: bool = False
    """Whether its datasets have all arrays of their kind, or only `views` and `sample_key`."""
    record: Mapping[str, Any] = field(default_factory=dict)
    """Arrays, by name, that all samples of its datasets have alike; the others are invented."""

    @property
    def condition(self) -> WorkerCondition:
        """How it says that it is."""
        return WorkerCondition(slots=self.slots)

    def register(self) -> "PretendWorker":
        """Register with the coordinator."""
        registration = WorkerRegistration(
            name=self.name,
            builds=dict.fromkeys(self.kinds, self.builds),
            condition=self.condition,
            versions={},
        )
        self.id = self.api.register(registration).worker_id
        return self

    def lease(self, **wanted: int) -> tuple[Lease, ...]:
        """Lease tasks: so many of each named stage, by default all."""
        stages = {Stage(stage): count for stage, count in wanted.items()} or ALL_STAGES
        leases: tuple[Lease, ...] = self.api.lease(
            LeaseRequest(worker_id=self.id, wanted=stages)
        ).leases
        return leases

    def start(self, *leases: Lease) -> tuple[str, ...]:
        """Report tasks as started; return the ids of tasks to drop."""
        return self.beat(*leases, started=True)

    def beat(self, *leases: Lease, started: bool = False) -> tuple[str, ...]:
        """Renew leases; return the ids of tasks to drop."""
        states = tuple(
            LeaseState(task_id=lease.task_id, token=lease.token, started=started)
            for lease in leases
        )
        drop: tuple[str, ...] = self.api.heartbeat(
            Heartbeat(worker_id=self.id, leases=states, condition=self.condition)
        ).drop
        return drop

    def report(self, *ended: tuple[Lease, TaskResult | None]) -> list[str]:
        """Report results; return the verdicts."""
        reports = tuple(
            Report(task_id=lease.task_id, token=lease.token, result=result)
            for lease, result in ended
        )
        answer = self.api.report(ReportBatch(worker_id=self.id, reports=reports))
        return [verdict.verdict for verdict in answer.verdicts]

    def finish(self, *leases: Lease) -> list[str]:
        """Run tasks and report their results; return the verdicts."""
        self.finished_ids += [lease.task_id for lease in leases]
        return self.report(*((lease, self.result(lease.task)) for lease in leases))

    def work(self, rounds: int = 1000) -> int:
        """Run tasks until none is left; return their number."""
        count = 0
        for _ in range(rounds):
            leases = self.lease()
            if not leases:
                return count
            count += len(leases)
            self.finish(*leases)
        raise AssertionError(f"tasks are left after {rounds} rounds")

    def result(self, task: Any) -> TaskResult:
        """Return the result of a task."""
        judged = self.judge(task)
        if judged is not None:
            return judged
        needed = input_digests(task, self.store.read)
        damaged = tuple(digest for digest in needed if not self.store.holds(digest))
        if damaged:
            return failure(Reason.storage_error, "inputs are damaged").model_copy(
                update={"damaged_inputs": damaged}
            )
        output: Any
        if task.stage == "simulate":
            digest = self.store.publish(task.model_dump_json().encode())
            output = SimulateOutput(record=RecordRef(digest=digest, row=0), labels={"energy": 0.5})
        elif task.stage == "render":
            data = task.model_dump_json().encode()
            digest = self.store.publish(data)
            preview = self.store.publish(b"\x89PNG" + data) if task.preview else None
            where = ChunkRef(digest=digest, offset=0, length=len(data))
            output = RenderOutput(
                chunks={"views": where}, preview=preview, labels={"color": [1.0, 0.5, 0.0]}
            )
        elif task.stage == "pack" and self.whole:
            arrays = [array for array in layout(task.spec) if not array.is_label]
            shards = (
                (array.shard_path(task.shard), _encoded(array, task, self.record))
                for array in arrays
            )
            output = PackOutput(
                files=tuple(
                    FileEntry(path=path, sha256=self.store.publish(data), size=len(data))
                    for path, data in shards
                ),
                labels=self.store.publish(
                    encode_shard(
                        [
                            _encoded(array, task, self.record)
                            for array in layout(task.spec)
                            if array.is_label
                        ]
                    )
                ),
            )
        elif task.stage == "pack":
            data = b"".join(slot.sample_key.encode() for slot in task.slots) * 50
            entry = FileEntry(
                path=f"views/c/{task.shard}/0", sha256=self.store.publish(data), size=len(data)
            )
            keys = bytes.fromhex("".join(slot.sample_key for slot in task.slots))
            labels = self.store.publish(encode_shard([encode_chunk(keys)]))
            output = PackOutput(files=(entry,), labels=labels)
        else:
            output = self._publish(task)
        return TaskResult(
            outcome="succeeded", output=output, cpu_seconds=2.0, wall_seconds=1.0, call_seconds=1.0
        )

    def _publish(self, task: PublishTask) -> PublishOutput:
        sections_of_task = [
            PublishSection.model_validate_json(self.store.read(digest)) for digest in task.sections
        ]
        count = task.spec.sample_count
        zarr = {file.path: file for file in self._zarr(count)}
        group = self.store.read(zarr.pop(GROUP_NAME).sha256)
        own_files = [*zarr.values(), *self._label_files(task, sections_of_task)]
        listed = [file for section in sections_of_task for file in section.files]
        rejections = tuple(
            rejection for section in sections_of_task for rejection in section.rejections
        )
        sections: list[FileEntry] = []
        if has_sections(task.spec):
            for number, section in enumerate(sections_of_task):
                section_document = ManifestSection(
                    **{name: getattr(section, name) for name in ManifestSection.model_fields}
                )
                data = section_document.model_dump_json().encode()
                path = section_path(number)
                sections.append(
                    FileEntry(path=path, sha256=self.store.publish(data), size=len(data))
                )
        manifest = Manifest(
            dataset=task.dataset,
            version=task.version,
            spec=task.spec,
            spec_digest=task.spec.content_digest,
            builds=task.builds,
            certificate=task.certificate,
            cameras=(),
            sample_count=count,
            valid_count=count - len(rejections),
            split_counts={},
            rejection_counts=Counter(str(rejection.reason) for rejection in rejections),
            sections=tuple(sections),
            rejections=() if sections else rejections,
            sample_keys=()
            if sections
            else tuple(key for section in sections_of_task for key in section.sample_keys),
            files=tuple(
                sorted(own_files if sections else [*own_files, *listed], key=lambda file: file.path)
            ),
        )
        content = manifest.model_dump_json().encode()
        digest = self.store.publish(content)
        group_digest = self.store.publish(with_manifest_digest(group, digest))
        seal = self.store.publish(seal_text(digest, group_digest))
        named = {MANIFEST_NAME: digest, GROUP_NAME: group_digest, SEAL_NAME: seal}
        every = [*own_files, *listed, *sections]
        for path, artifact in (named | {file.path: file.sha256 for file in every}).items():
            self.store.show(artifact, task.dataset, task.version, path)
        return PublishOutput(
            manifest=digest, group=group_digest, bytes=sum(file.size for file in every)
        )

    def _label_files(
        self, task: PublishTask, sections_of_task: Sequence[PublishSection]
    ) -> Iterator[FileEntry]:
        """Yield the files of the labels of the packed shards: all labels, or only `sample_key`."""
        labels = [array for array in layout(task.spec) if array.is_label]
        labels = labels if self.whole else [array for array in labels if array.name == "sample_key"]
        columns: dict[str, list[bytes]] = {array.name: [] for array in labels}
        for digest in (digest for section in sections_of_task for digest in section.labels):
            data = self.store.read(digest)
            for array, (offset, length) in zip(
                labels, decode_shard_index(data, len(labels)).tolist(), strict=True
            ):
                columns[array.name].append(bytes(decode_chunk(data[offset : offset + length])))
        for array in labels:
            values = b"".join(columns[array.name])
            size = task.spec.samples_per_file(array) * array.sample_bytes
            for number in range(-(-len(values) // size)):
                data = encode_chunk(values[number * size : (number + 1) * size].ljust(size, b"\0"))
                yield FileEntry(
                    path=array.shard_path(number), sha256=self.store.publish(data), size=len(data)
                )

    def _zarr(self, count: int) -> list[FileEntry]:
        """Return the files of a small Zarr group."""
        import zarr
        from zarr.storage import MemoryStore

        memory: dict[str, Any] = {}
        group = zarr.open_group(MemoryStore(memory), mode="w")
        array = group.create_array(
            "mu", shape=(count,), chunks=(count,), dtype="float64", dimension_names=["sample"]
        )
        array[:] = range(count)
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # consolidated metadata is not in the Zarr v3 specification yet
            zarr.consolidate_metadata(group.store)
        entries = []
        for path, value in memory.items():
            data = value.to_bytes()
            entries.append(FileEntry(path=path, sha256=self.store.publish(data), size=len(data)))
        return entries


def _encoded(array: ArrayLayout, task: PackTask, record: Mapping[str, Any]) -> bytes:
    """Return the file of an array.

    Its values are an axis of the grid, recorded, or growing from sample to sample.
    """
    size = task.spec.samples_per_shard
    ramp, of_axis = (
        np.arange(prod(array.shape)).reshape(array.shape),
        array.name in task.spec.named_axes,
    )
    known = [{**record, **(slot.labels if of_axis else {})}.get(array.name) for slot in task.slots]
    values = [
        np.asarray(
            (ramp + slot.slot) % 251
            if code is None
            else array.categories.index(code)
            if array.categories
            else code,
            array.dtype,
        )
        for slot, code in zip(task.slots, known, strict=True)
        if slot.valid or of_axis
    ]
    if array.name == "sample_key":
        keys = [
            np.frombuffer(bytes.fromhex(slot.sample_key), dtype=np.uint8) for slot in task.slots
        ]
        values = keys
    if array.per_sample:
        rows = iter(values)
        chunks = [encode_sample(array, next(rows)) if slot.valid else None for slot in task.slots]
        return encode_shard([*chunks, *[None] * (size - len(chunks))])
    if array.name == "valid":
        values = [np.asarray(slot.valid) for slot in task.slots]
    elif array.name != "sample_key" and len(values) < len(task.slots):
        rows = iter(values)
        values = [
            next(rows) if slot.valid else np.full(array.shape, array.fill, array.dtype)
            for slot in task.slots
        ]
    rows_held = len(task.slots) if array.is_label else size
    column = np.full((rows_held, *array.shape), array.fill, dtype=array.dtype)
    column[: len(values)] = values
    return encode_chunk(column)
