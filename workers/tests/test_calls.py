"""What becomes of calls when a node of the cluster is lost, without Ray."""

import time
from typing import Any

import pytest
import ray
from stickslip_schemas.base.states import Stage
from stickslip_workers import cluster
from stickslip_workers.calls import Call, Calls, LostError, NotDoneError
from stickslip_workers.settings import Settings


def test_calls_that_have_not_started_are_given_again_when_a_node_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes: dict[str, Any] = {name: {"Resources": {}} for name in "ab"}
    cancelled: list[object] = []
    monkeypatch.setattr(cluster, "nodes", lambda: dict(nodes))
    monkeypatch.setattr(ray, "cancel", lambda reference, force: cancelled.append(reference))
    monkeypatch.setattr(ray, "wait", lambda *_, **__: ([], []))
    calls = Calls(Settings(urls=(), store="nowhere", name="test"), {False: {}, True: {}})
    here, lost, waiting = (Call([], Stage.simulate, 60.0, 0.0, False, node=node) for node in ("a", "b", ""))
    here.started_at = lost.started_at = time.monotonic()
    calls._calls = dict(zip("hlw", (here, lost, waiting), strict=True))
    assert list(calls._look()) == []
    del nodes["b"]
    said = {id(one): type(error) for one, error in calls._look()}
    assert said == {id(lost): LostError, id(waiting): NotDoneError}
    assert cancelled == ["w"]
    assert list(calls) == [here]
    assert list(calls._look()) == []
