"""The plan of a job: its tasks simulate -> render -> pack -> publish.

Each task is keyed by everything that its result depends on.

Planning is pure and slow: a job of many samples is planned piece by piece, outside any transaction.
`insertion` writes the pieces.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import NamedTuple

from sqlalchemy import Connection, select
from stickslip_schemas.base import Sha256, Stage
from stickslip_schemas.kinds import registered
from stickslip_schemas.plan.points import Shard, publish_key, shards
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.database.tables import certificates
from stickslip_services.errors import PresetNotCertifiedError
from stickslip_services.queue.rows import PlanInputs
from stickslip_services.queue.workers import builds_for
from stickslip_services.settings import Settings

# Plain strings: sqlite3 binds them three times as fast as members of Stage.
_SIMULATE, _RENDER, _PACK, _PUBLISH = (stage.value for stage in Stage)


def plan_inputs_for(connection: Connection, spec: JobSpec) -> PlanInputs | None:
    """Return builds and certificate for a job of `spec`, or None if no worker has ever registered.

    Raises KindNotAvailableError if no worker makes the kind, and UnknownKindError if its class is
    not registered. A spec may need a certificate for its preset and the workers' build. Raises
    PresetNotCertifiedError if none passed with all protocols that the spec needs.
    """
    builds = builds_for(connection, registered(spec).kind)
    if builds is None:
        return None
    standing = _standing_certificate(connection, spec.certified_preset, builds.sim_core)
    missing: list[str] = []
    certificate = None
    if standing is not None:
        missing = [name for name in spec.certified_protocols if name not in standing.protocols]
        if not missing:
            certificate = standing.digest
    if certificate is None and spec.needs_certificate:
        raise PresetNotCertifiedError(spec.certified_preset, builds.sim_core, missing)
    return PlanInputs(builds, certificate)


class _StandingCertificate(NamedTuple):
    """The newest full certificate of a preset and a build, which passed."""

    digest: Sha256
    protocols: list[str]


def _standing_certificate(
    connection: Connection, preset: str, sim_core: Sha256
) -> _StandingCertificate | None:
    """Return the newest full certificate of a preset and a build.

    None if there is none, or if it did not pass.
    """
    columns = certificates.c
    row = connection.execute(
        select(columns.digest, columns.passed, columns.protocols)
        .where(columns.preset == preset, columns.sim_core == sim_core, columns.extent == "full")
        .order_by(columns.created_at.desc(), columns.seq.desc())
        .limit(1)
    ).one_or_none()
    if row is None or not row.passed:
        return None
    return _StandingCertificate(row.digest, row.protocols.split())


class PlannedTask(NamedTuple):
    """A task of a plan, without its key."""

    stage: str
    build: str
    payload: str
    depends_on: tuple[bytes, ...] = ()
    preview: bool = False
    cost_group: str = ""


class PlannedSample(NamedTuple):
    """A sample of a plan, with the keys of its tasks."""

    slot: int
    key: bytes
    simulate_task: bytes
    render_task: bytes | None
    split: int
    labels: str


@dataclass(slots=True)
class Plan:
    """Tasks by content key, in the order of execution, and samples: of a job, or of one piece."""

    spec: JobSpec
    first: int
    """The first slot."""
    end: int
    """The slot after the last one."""
    tasks: dict[bytes, PlannedTask] = field(default_factory=dict)
    samples: list[PlannedSample] = field(default_factory=list)
    publish_key: bytes | None = None
    """Key of the task that publishes, in the last piece of a job."""


def plan_at_once(settings: Settings, spec: JobSpec, inputs: PlanInputs) -> Plan | None:
    """Return the plan of a job of few samples, or None if the planner plans it piece by piece."""
    if spec.sample_count > settings.plan_samples:
        return None
    return expand(spec, inputs, previews=settings.previews_per_job)


def expand(spec: JobSpec, inputs: PlanInputs, *, previews: int = 0) -> Plan:
    """Return the whole plan of `spec` as one piece."""
    return next(pieces(spec, inputs, size=spec.sample_count, previews=previews))


def pieces(
    spec: JobSpec,
    inputs: PlanInputs,
    *,
    size: int,
    previews: int = 0,
    first: int = 0,
    packed: Sequence[str] = (),
) -> Iterator[Plan]:
    """Yield the plan of `spec` in pieces of whole shards, of about `size` samples each.

    Together the pieces are the plan that `expand` returns, for any `size`. To continue from slot
    `first`, pass the keys of the pack tasks before it as `packed`, in order.
    """
    # Previews are spread evenly, the first one at the first slot.
    count = min(spec.sample_count, previews)
    preview_slots = {position * spec.sample_count // count for position in range(count)}

    pack_keys = list(packed)
    per_shard = spec.samples_per_shard
    remaining = shards(spec, inputs.builds, first=first // per_shard)
    while batch := list(islice(remaining, -(-size // per_shard))):
        yield _Piece(spec, inputs, preview_slots).plan(batch, pack_keys)


class _Piece:
    """Plans some shards of a job."""

    def __init__(self, spec: JobSpec, inputs: PlanInputs, preview_slots: set[int]) -> None:
        self._spec = spec
        self._inputs = inputs
        self._preview_slots = preview_slots
        self._renders: dict[tuple[object, ...], dict[bytes, PlannedTask]] = {}
        """Renders by simulation and shading: the renders of a group can run together."""

    def plan(self, batch: Sequence[Shard], pack_keys: list[str]) -> Plan:
        """Return the plan; add the keys of its pack tasks to `pack_keys`."""
        first = batch[0].points[0].slot
        plan = Plan(self._spec, first, first + sum(len(shard.points) for shard in batch))
        packs: dict[bytes, PlannedTask] = {}
        for shard in batch:
            dependencies = self._add_samples(plan, shard)
            pack_keys.append(shard.pack_key)
            payload = json.dumps({"shard": shard.number})
            build = self._inputs.builds.pack
            packs[bytes.fromhex(shard.pack_key)] = PlannedTask(_PACK, build, payload, dependencies)
        for group in self._renders.values():
            plan.tasks.update(group)
        plan.tasks.update(packs)
        if plan.end == self._spec.sample_count:
            self._add_publish_task(plan, pack_keys)
        return plan

    def _add_samples(self, plan: Plan, shard: Shard) -> tuple[bytes, ...]:
        """Add the samples of a shard and their simulations; return the tasks that it packs."""
        spec = self._spec
        builds = self._inputs.builds
        last_tasks: dict[bytes, None] = {}  # an ordered set: two slots may have the same sample
        for point in shard.points:
            simulate = bytes.fromhex(point.simulation_key)
            if simulate not in plan.tasks:
                cost_group = spec.cost_group(Stage.simulate, point.labels)
                plan.tasks[simulate] = PlannedTask(
                    _SIMULATE, builds.simulate, point.simulation_text, cost_group=cost_group
                )
            key = simulate
            render: bytes | None = None
            if point.render_key is not None and point.render_text is not None:
                key = render = bytes.fromhex(point.render_key)
                shading = [
                    value for axis, value in point.labels.items() if axis != spec.variant_axis
                ]
                group = self._renders.setdefault((simulate, *shading), {})
                if render not in group:
                    group[render] = PlannedTask(
                        _RENDER,
                        builds.render,
                        point.render_text,
                        (simulate,),
                        point.slot in self._preview_slots,
                        spec.cost_group(Stage.render, point.labels),
                    )
            last_tasks[key] = None
            plan.samples.append(
                PlannedSample(point.slot, key, simulate, render, point.split, point.labels_text)
            )
        return tuple(last_tasks)

    def _add_publish_task(self, plan: Plan, pack_keys: Sequence[str]) -> None:
        builds = self._inputs.builds
        certificate = self._inputs.certificate
        key = bytes.fromhex(publish_key(self._spec, pack_keys, builds, certificate))
        payload = json.dumps({} if certificate is None else {"certificate": certificate})
        dependencies = tuple(bytes.fromhex(pack_key) for pack_key in pack_keys)
        plan.tasks[key] = PlannedTask(_PUBLISH, builds.digest, payload, dependencies)
        plan.publish_key = key
