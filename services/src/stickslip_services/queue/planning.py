"""From a spec to tasks: simulate -> render -> pack -> publish, each keyed by exactly what its result depends on.

Planning is pure and slow and runs outside any transaction. A job of many samples is planned piece by piece (`planner`).
"""

import gc
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from typing import Any

from stickslip_schemas.base.states import Stage
from stickslip_schemas.plan.points import Shard, publish_key, shards
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.queue.plan import Plan, PlannedSample, PlannedTask, Terms

_SIMULATE, _RENDER, _PACK, _PUBLISH = (stage.value for stage in Stage)


@contextmanager
def collector_at_rest() -> Iterator[None]:
    """Keep the garbage collector from walking through a plan while it grows.

    A plan is a million small objects and no cycles; looking for some takes a fifth of the time.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def preview_slots(sample_count: int, previews: int) -> set[int]:
    """Return the slots that are rendered with a preview: the first one, and the others evenly spread."""
    count = min(sample_count, previews)
    return {position * sample_count // count for position in range(count)}


def expand(spec: JobSpec, terms: Terms, *, previews: int = 0) -> Plan:
    """Return all tasks and samples that `spec` means; the manifest will carry the certificate's digest."""
    return next(pieces(spec, terms, size=spec.sample_count, previews=previews))


def pieces(
    spec: JobSpec, terms: Terms, *, size: int, previews: int = 0, first: int = 0, packed: Sequence[str] = ()
) -> Iterator[Plan]:
    """Yield the plan of `spec` in pieces of whole shards, of about `size` samples each.

    Together they are the plan that `expand` returns, however they are cut. Who goes on from slot `first` gives the keys
    of the pack tasks before it, in order.
    """
    per_shard = spec.samples_per_shard
    previewed = preview_slots(spec.sample_count, previews)
    pack_keys = list(packed)
    waiting = shards(spec, terms.builds, first=first // per_shard)
    while some := list(islice(waiting, -(-size // per_shard))):
        yield _piece(spec, terms, some, previewed, pack_keys)


def _piece(
    spec: JobSpec,
    terms: Terms,
    some: Sequence[Shard],
    previewed: set[int],
    pack_keys: list[str],
) -> Plan:
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
