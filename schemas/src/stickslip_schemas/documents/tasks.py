"""Tasks of the stages and their results; bulk data is named by digest and never part of them."""

from collections.abc import Callable
from contextlib import suppress
from typing import Annotated, Any, Literal, Self

from pydantic import Field, TypeAdapter, model_validator

from stickslip_schemas.base import Bool, Document, Float, Int, Reason, Sha256, artifact_digest
from stickslip_schemas.format.manifest import FileEntry, ManifestSection, Rejection
from stickslip_schemas.kinds import AnyJobSpec, AnyRender, AnySimulation
from stickslip_schemas.plan.builds import Builds


class RecordRef(Document):
    """One record of an artifact that holds several (`.npz`, first dimension = record)."""

    digest: Sha256
    row: Int = Field(ge=0)


class ChunkRef(Document):
    """An encoded chunk: `length` bytes from `offset` of an artifact."""

    digest: Sha256
    offset: Int = Field(ge=0)
    length: Int = Field(gt=0)


class SimulateTask(Document):
    """Make one trajectory."""

    stage: Literal["simulate"] = "simulate"
    simulation: AnySimulation


class SimulateOutput(Document):
    """A trajectory in the store, and the labels that the solver gives."""

    stage: Literal["simulate"] = "simulate"
    record: RecordRef
    labels: dict[str, Any]


class RenderTask(Document):
    """Make the pictures of one sample, or of all samples that share a shading.

    `preview` asks for small ones, too.
    """

    stage: Literal["render"] = "render"
    render: AnyRender
    record: RecordRef
    preview: Bool = False
    textures: tuple[str, ...] = Field(
        default=(),
        description="textures to make clips of, one sample each, by name or `sha256:` and digest; "
        "none: that of the "
        "render document",
    )


class RenderOutput(Document):
    """Encoded chunks by array name, and labels such as the colour.

    `preview` is the digest of the preview, if there is one.

    With `textures` in the task there are only `clips`.
    """

    stage: Literal["render"] = "render"
    chunks: dict[str, ChunkRef]
    preview: Sha256 | None = None
    labels: dict[str, Any]
    clips: dict[str, "TaskResult"] = Field(default_factory=dict, description="results by texture")


class PackSlot(Document):
    """One slot of a shard: the location of its data, or its rejection."""

    slot: Int = Field(ge=0)
    sample_key: Sha256
    split: Int
    labels: dict[str, Any] = Field(
        description="parameters and what the stages added, by array name"
    )
    record: RecordRef | None = None
    chunks: dict[str, ChunkRef] = Field(default_factory=dict)
    rejection: Rejection | None = None

    @property
    def valid(self) -> bool:
        """True if there is data."""
        return self.rejection is None


class PackTask(Document):
    """Make the files of shard `shard` of every array."""

    stage: Literal["pack"] = "pack"
    spec: AnyJobSpec
    shard: Int = Field(ge=0)
    slots: tuple[PackSlot, ...] = Field(min_length=1)


class PackOutput(Document):
    """Files of the shard, in the store, and its labels.

    Labels go into files together with the labels of other shards.
    """

    stage: Literal["pack"] = "pack"
    files: tuple[FileEntry, ...] = Field(description="of the arrays that are no labels")
    labels: Sha256 = Field(
        description="artifact: a shard whose chunks are the labels, in the order of the layout"
    )


class PublishSection(ManifestSection):
    """A section for the publish task, with the labels of each shard; a temporary artifact."""

    labels: tuple[Sha256, ...] = Field(description="see `PackOutput`; by shard")


class PublishTask(Document):
    """Write the metadata and the manifest of a dataset version; its result is the commit."""

    stage: Literal["publish"] = "publish"
    spec: AnyJobSpec
    dataset: str
    version: Int = Field(ge=1)
    builds: Builds
    sections: tuple[Sha256, ...] = Field(
        min_length=1, description="artifacts, each a `PublishSection`, by slot"
    )
    certificate: Sha256 | None = Field(
        default=None, description="digest of the certificate that vouches for it"
    )


class PublishOutput(Document):
    """The manifest in the store: when the coordinator has it, the version exists."""

    stage: Literal["publish"] = "publish"
    manifest: Sha256
    group: Sha256 = Field(description="of the root's zarr.json, which names the manifest")
    bytes: Int = Field(ge=0, description="size of all files of the version")


AnyTask = SimulateTask | RenderTask | PackTask | PublishTask
Task = Annotated[AnyTask, Field(discriminator="stage")]
Output = Annotated[
    SimulateOutput | RenderOutput | PackOutput | PublishOutput, Field(discriminator="stage")
]


class TaskResult(Document):
    """Outcome of a task."""

    outcome: Literal["succeeded", "rejected", "failed"]
    reason: Reason | None = None
    message: str = ""
    output: Output | None = None
    damaged_inputs: tuple[Sha256, ...] = Field(
        default=(),
        description="artifacts that the task needed and that are damaged or not in the store",
    )
    cpu_seconds: Float = Field(default=0.0, ge=0)
    wall_seconds: Float = Field(default=0.0, ge=0)
    call_seconds: Float | None = Field(
        default=None,
        ge=0,
        description=(
            "duration of the call, which may include other tasks [s]; null: not usable for "
            "estimates"
        ),
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        # Output, reason and damaged inputs each belong to certain outcomes.
        if (self.outcome == "succeeded") != (self.output is not None):
            raise ValueError("output is there exactly when the outcome is succeeded")
        if (self.outcome == "succeeded") != (self.reason is None):
            raise ValueError("reason is there exactly when the outcome is not succeeded")
        if self.outcome != "failed" and self.damaged_inputs:
            raise ValueError("damaged_inputs are those of a task that has failed")
        if (
            self.outcome == "rejected"
            and self.reason is not None
            and not self.reason.is_deterministic
        ):
            raise ValueError(
                f"a sample is rejected for a reason of its own, and {self.reason} is not one"
            )
        return self


task_adapter: TypeAdapter[AnyTask] = TypeAdapter(Task)
"""Validates and dumps a task of any stage."""
tasks_adapter: TypeAdapter[list[AnyTask]] = TypeAdapter(list[Task])
results_adapter = TypeAdapter(list[TaskResult])


def input_digests(task: AnyTask, read: Callable[[Sha256], bytes]) -> tuple[Sha256, ...]:
    """Return the artifacts that a task needs.

    `read` reads artifacts that list others, which may be damaged or lost.
    """
    if isinstance(task, RenderTask):
        # Textures of users are artifacts; built-in ones are names.
        pictures = map(artifact_digest, task.textures or (task.render.variant,))
        return tuple(
            dict.fromkeys([task.record.digest, *filter(None, pictures), *task.render.artifacts])
        )
    if isinstance(task, PublishTask):
        # The sections, and the files that they list.
        digests = list(task.sections)
        for digest in task.sections:
            # A section that is lost is itself an input, and the worker reports it.
            with suppress(OSError, ValueError):
                section = PublishSection.model_validate_json(read(digest))
                digests += [*(file.sha256 for file in section.files), *section.labels]
        return tuple(dict.fromkeys(digests))
    if isinstance(task, SimulateTask):
        return task.simulation.artifacts
    # A pack task reads the records and the chunks of its slots.
    inputs: list[Sha256] = []
    for slot in task.slots:
        if slot.record is not None:
            inputs.append(slot.record.digest)
        inputs += [chunk.digest for chunk in slot.chunks.values()]
    return tuple(dict.fromkeys(inputs))
