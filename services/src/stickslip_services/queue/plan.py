"""The plan of a job: its tasks simulate -> render -> pack -> publish, each keyed by what its result depends on.

Planning is pure and slow: `planner` plans a job of many samples piece by piece, outside any transaction.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, NamedTuple

from sqlalchemy import Connection
from stickslip_schemas.base import Sha256, Stage
from stickslip_schemas.kinds import registered
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.plan.points import Shard, publish_key, shards
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.catalog.certificates import standing_certificate
from stickslip_services.errors import PresetNotCertifiedError
from stickslip_services.queue.workers import builds_for

_SIMULATE, _RENDER, _PACK, _PUBLISH = (stage.value for stage in Stage)


@dataclass(frozen=True, slots=True)
class Terms:
    """The builds of the workers that make a job, and the certificate of their physics, if there is one."""

    builds: Builds
    certificate: Sha256 | None


def terms_for(connection: Connection, spec: JobSpec) -> Terms | None:
    """Return builds and certificate for a job of `spec`, None if no worker has ever registered.

    Raises KindNotAvailableError where no worker makes the kind, UnknownKindError where its class is not registered,
    and PresetNotCertifiedError where the spec needs a certificate and its preset has none that passed for the workers'
    build with all protocols that the spec needs.
    """
    builds = builds_for(connection, registered(spec).kind)
    if builds is None:
        return None
    standing = standing_certificate(connection, spec.certified_preset, builds.sim_core)
    missing = [] if standing is None else [name for name in spec.certified_protocols if name not in standing[1]]
    certificate = None if standing is None or missing else standing[0]
    if certificate is None and spec.needs_certificate:
        raise PresetNotCertifiedError(spec.certified_preset, builds.sim_core, missing)
    return Terms(builds, certificate)


class PlannedTask(NamedTuple):
    """A task as a job needs it."""

    stage: str  # a plain str: sqlite3 binds it three times as fast as a member of Stage
    build: str
    payload: str
    depends_on: tuple[bytes, ...] = ()
    preview: bool = False
    cost_group: str = ""


class PlannedSample(NamedTuple):
    """A slot of the dataset."""

    slot: int
    key: bytes
    simulate_task: bytes
    render_task: bytes | None
    split: int
    labels: str


@dataclass(slots=True)
class Plan:
    """Tasks by content key, in the order of execution, and samples: of a whole job, or of one piece."""

    spec: JobSpec
    first: int
    """The first slot."""
    tasks: dict[bytes, PlannedTask] = field(default_factory=dict)
    samples: list[PlannedSample] = field(default_factory=list)

    @property
    def end(self) -> int:
        """The slot after the last one."""
        return self.first + len(self.samples)

    @property
    def is_last(self) -> bool:
        """True where it ends with the task that publishes."""
        return self.end == self.spec.sample_count

    @property
    def publish_key(self) -> bytes:
        """Key of the last task, of the last piece."""
        return next(reversed(self.tasks))


def expand(spec: JobSpec, terms: Terms, *, previews: int = 0) -> Plan:
    """Return the whole plan of `spec` as one piece."""
    return next(pieces(spec, terms, size=spec.sample_count, previews=previews))


def pieces(
    spec: JobSpec, terms: Terms, *, size: int, previews: int = 0, first: int = 0, packed: Sequence[str] = ()
) -> Iterator[Plan]:
    """Yield the plan of `spec` in pieces of whole shards, of about `size` samples each.

    Together the pieces are the plan that `expand` returns, for any `size`. To continue from slot `first`, pass the keys
    of the pack tasks before it as `packed`, in order.
    """
    per_shard = spec.samples_per_shard
    count = min(spec.sample_count, previews)
    previewed = {position * spec.sample_count // count for position in range(count)}  # the first, and evenly spread
    pack_keys = list(packed)
    waiting = shards(spec, terms.builds, first=first // per_shard)
    while some := list(islice(waiting, -(-size // per_shard))):
        yield _piece(spec, terms, some, previewed, pack_keys)


def _piece(spec: JobSpec, terms: Terms, some: Sequence[Shard], previewed: set[int], pack_keys: list[str]) -> Plan:
    """Return the plan of some shards; add the keys of their pack tasks to `pack_keys`."""
    builds = terms.builds
    plan = Plan(spec, some[0].points[0].slot)
    tasks_by_key = plan.tasks
    packs: dict[bytes, PlannedTask] = {}
    renders: dict[tuple[Any, ...], dict[bytes, PlannedTask]] = {}  # by shading: those that can be made together
    for shard in some:
        last: dict[bytes, None] = {}  # an ordered set: a grid may have one sample in two slots
        for point in shard.points:
            key = simulate = bytes.fromhex(point.simulation_key)
            render: bytes | None = None
            if simulate not in tasks_by_key:
                cost = spec.cost_group(Stage.simulate, point.labels)
                tasks_by_key[simulate] = PlannedTask(_SIMULATE, builds.simulate, point.simulation_text, cost_group=cost)
            if point.render_key is not None and point.render_text is not None:
                key = render = bytes.fromhex(point.render_key)
                shared = (value for axis, value in point.labels.items() if axis != spec.variant_axis)
                group = renders.setdefault((simulate, *shared), {})
                if render not in group:
                    preview = point.slot in previewed
                    cost = spec.cost_group(Stage.render, point.labels)
                    group[render] = PlannedTask(_RENDER, builds.render, point.render_text, (simulate,), preview, cost)
            last[key] = None
            plan.samples.append(PlannedSample(point.slot, key, simulate, render, point.split, point.labels_text))
        pack_keys.append(shard.pack_key)
        payload = json.dumps({"shard": shard.number})
        packs[bytes.fromhex(shard.pack_key)] = PlannedTask(_PACK, builds.pack, payload, tuple(last))
    for group in renders.values():
        tasks_by_key.update(group)
    tasks_by_key.update(packs)
    if plan.is_last:
        publish = bytes.fromhex(publish_key(spec, pack_keys, builds, terms.certificate))
        payload = json.dumps({} if terms.certificate is None else {"certificate": terms.certificate})
        depends_on = tuple(map(bytes.fromhex, pack_keys))
        tasks_by_key[publish] = PlannedTask(_PUBLISH, builds.digest, payload, depends_on)
    return plan
