"""Tasks that publish, as the coordinator composes them."""

from collections.abc import Sequence
from typing import Any

from stickslip_schemas.documents.tasks import PackOutput, PublishSection, PublishTask
from stickslip_schemas.format.manifest import Rejection, section_samples
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_schemas.store import Store


def publish_task(
    spec: JobSpec,
    builds: Builds,
    keys: Sequence[str],
    rejections: Sequence[Rejection],
    packed: Sequence[PackOutput],
    store: Store,
) -> PublishTask:
    """Return the task that publishes what was packed, as the coordinator composes it."""
    size, sections = section_samples(spec), []
    for first in range(0, len(keys), size):
        shards = packed[
            first // spec.samples_per_shard : -(-(first + size) // spec.samples_per_shard)
        ]
        section = PublishSection(
            first=first,
            sample_keys=tuple(keys[first : first + size]),
            rejections=tuple(item for item in rejections if first <= item.slot < first + size),
            files=tuple(file for output in shards for file in output.files),
            labels=tuple(output.labels for output in shards),
        )
        sections.append(store.publish(section.model_dump_json().encode()))
    return PublishTask(
        spec=spec, dataset=spec.dataset_id, version=1, builds=builds, sections=tuple(sections)
    )


def changed(task: PublishTask, store: Store, **changes: Any) -> PublishTask:
    """Return the task with other things in its first section."""
    section = PublishSection.model_validate_json(store.read(task.sections[0])).model_copy(
        update=changes
    )
    digest = store.publish(section.model_dump_json().encode())
    return task.model_copy(update={"sections": (digest, *task.sections[1:])})
