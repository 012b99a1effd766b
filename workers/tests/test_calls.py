"""What becomes of calls when a node of the cluster is lost, without Ray."""

import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import ray
from stickslip_schemas.base import Stage
from stickslip_schemas.documents.tasks import RecordRef, RenderTask
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_workers.batching import Call
from stickslip_workers.ray_calls import Failed, NotRun, RayCalls
from stickslip_workers.settings import Settings


class Remote:
    """A remote function that only notes its options."""

    def options(self, **options: Any) -> "Remote":
        self.last_options = options
        return self

    def remote(self, *_: Any) -> object:
        return self


def test_calls_that_have_not_started_are_given_again_when_a_node_is_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    nodes: list[dict[str, Any]] = [
        {"NodeID": name, "Alive": True, "Resources": {}} for name in "ab"
    ]
    cancelled: list[object] = []
    monkeypatch.setattr(ray, "nodes", lambda: nodes)
    monkeypatch.setattr(ray, "cancel", lambda reference, force: cancelled.append(reference))
    monkeypatch.setattr(ray, "wait", lambda *_, **__: ([], []))
    calls = RayCalls(
        Settings(urls=(), store="nowhere", name="test"), {"builds": {}}, {"builds": {}}
    )
    here, lost, waiting = (
        Call(Stage.simulate, [], reference=name, node=node)
        for name, node in zip("hlw", ("a", "b", ""), strict=True)
    )
    here.started_at = lost.started_at = time.monotonic()
    calls._in_progress = {call.reference: call for call in (here, lost, waiting)}
    assert list(calls.check_nodes()) == []
    nodes[1]["Alive"] = False
    errors = {id(call): type(error) for call, error in calls.check_nodes()}
    assert errors == {id(lost): Failed, id(waiting): NotRun}
    assert cancelled == ["w"]
    assert list(calls) == [here]
    assert list(calls.check_nodes()) == []

    # They differ from earlier ones, for Ray would let them wait behind its requests to the lost
    # node.
    remote = Remote()
    calls._stages = replace(calls._stages, remote=remote)
    calls.submit(Call(Stage.simulate, []))
    assert remote.last_options["label_selector"] == {"ray.io/node-id": "!in(b)"}


def _render_call(resolution: tuple[int, int], frames: int) -> Call:
    """Return a call with one render of dragged cloth."""
    axes = {"material": "gray-interlock", "mu": 0.3, "texture": "dots", "viewpoint": "left"}
    document = {"kind": "cloth_drag", "axes": axes, "resolution": resolution, "frames": frames}
    spec = job_spec_adapter.validate_python(document)
    render = spec.render(next(spec.grid()))
    task = RenderTask(render=render, record=RecordRef(digest="0" * 64, row=0))
    lease: Any = SimpleNamespace(task=task)
    return Call(Stage.render, [[lease]])


def test_memory_of_a_render_grows_with_its_pictures() -> None:
    """Measured: a renderer of three frames of 1,280 x 720 took 1.3 GB at its peak."""
    usual = _render_call((224, 224), 30).memory
    assert usual == 2**30
    assert _render_call((1280, 720), 3).memory > 1.4e9
    assert _render_call((1280, 720), 30).memory > 3e9
