"""What becomes of calls when a node of the cluster is lost, without Ray."""

import time
from typing import Any

import pytest
import ray
from stickslip_schemas.base import Stage
from stickslip_workers.calls import Call, Calls, NotDoneError
from stickslip_workers.settings import Settings


class Remote:
    """A remote function that only notes its options."""

    def options(self, **options: Any) -> "Remote":
        self.given = options
        return self

    def remote(self, *_: Any) -> object:
        return self


def test_calls_that_have_not_started_are_given_again_when_a_node_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes: list[dict[str, Any]] = [{"NodeID": name, "Alive": True, "Resources": {}} for name in "ab"]
    cancelled: list[object] = []
    monkeypatch.setattr(ray, "nodes", lambda: nodes)
    monkeypatch.setattr(ray, "cancel", lambda reference, force: cancelled.append(reference))
    monkeypatch.setattr(ray, "wait", lambda *_, **__: ([], []))
    calls = Calls(Settings(urls=(), store="nowhere", name="test"), {False: {"builds": {}}, True: {"builds": {}}})
    here, lost, waiting = (
        Call(Stage.simulate, [], reference=name, node=node) for name, node in zip("hlw", ("a", "b", ""), strict=True)
    )
    here.started_at = lost.started_at = time.monotonic()
    calls._calls = {one.reference: one for one in (here, lost, waiting)}
    assert list(calls._look()) == []
    nodes[1]["Alive"] = False
    said = {id(one): type(error) for one, error in calls._look()}
    assert said == {id(lost): RuntimeError, id(waiting): NotDoneError}
    assert cancelled == ["w"]
    assert list(calls) == [here]
    assert list(calls._look()) == []

    # They differ from earlier ones, for Ray would let them wait behind its requests to the lost node.
    remote = Remote()
    calls._remote = {False: remote, True: remote}
    calls.give(Call(Stage.simulate, []))
    assert remote.given["label_selector"] == {"ray.io/node-id": "!in(b)"}
