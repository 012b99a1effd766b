"""Simulate: one artifact a batch, the same numbers in any batch, rejections with reasons."""

import io
from typing import Any

import numpy as np
import pytest
from stickslip_schemas.base import Reason
from stickslip_schemas.documents.tasks import SimulateTask, TaskResult
from stickslip_schemas.kinds import UnknownKindError
from stickslip_schemas.kinds.rod_hang import RodHangSimulation
from stickslip_schemas.store import DirectoryStore
from stickslip_sim_core.scenes import rod_hang
from stickslip_workers.builds import kind
from stickslip_workers.stages.run import run_tasks


def _rods(count: int) -> list[SimulateTask]:
    gammas = np.linspace(1, 300, count)
    return [
        SimulateTask(
            simulation=RodHangSimulation(gamma=float(gamma), phi0=2.0, phi1=8.0, poisson=0.5)
        )
        for gamma in gammas
    ]


def _curves(store: DirectoryStore, result: TaskResult) -> dict[str, Any]:
    record = result.output.record
    with np.load(io.BytesIO(store.read(record.digest))) as arrays:
        return {name: values[record.row] for name, values in arrays.items()}


def test_a_batch_is_one_artifact_and_the_same_again(store: DirectoryStore) -> None:
    first, second = run_tasks(_rods(20), store), run_tasks(_rods(20), store)
    assert {result.outcome for result in first} == {"succeeded"}
    assert len({result.output.record.digest for result in first}) == 1
    assert [result.output for result in first] == [result.output for result in second]
    assert sum(result.cpu_seconds for result in first) > 0
    curves = _curves(store, first[3])
    assert {name: (values.shape, values.dtype) for name, values in curves.items()} == {
        "centerline": ((150, 3), np.float32),
        "curvature": ((150, 3), np.float32),
        "frame": ((150, 3, 3), np.float32),
        "multistable": ((), np.bool_),
        "self_contact_distance": ((), np.float64),
        "reach": ((), np.float64),
    }


def test_labels_say_what_a_rod_looks_like(store: DirectoryStore) -> None:
    both_hands = SimulateTask(
        simulation=RodHangSimulation(gamma=600.0, phi0=0.3, phi1=15.0, poisson=0.5)
    )
    one_hand = SimulateTask(
        simulation=RodHangSimulation(gamma=600.0, phi0=10.0, phi1=15.0, poisson=0.5)
    )
    coil = SimulateTask(simulation=RodHangSimulation(gamma=0.0, phi0=2.0, phi1=30.0, poisson=0.5))
    labels = [_curves(store, result) for result in run_tasks([both_hands, one_hand, coil], store)]
    assert [bool(rod["multistable"]) for rod in labels] == [True, False, False]
    assert [np.isinf(rod["self_contact_distance"]) for rod in labels] == [True, True, False]
    # A helix of curvature 30 and torsion 2: its pitch is 2 pi 2 / (4 + 900), the next turn a little
    # nearer.
    assert labels[2]["self_contact_distance"] == pytest.approx(4 * np.pi / 904, rel=0.01)
    for rod in labels:
        assert rod["reach"] == pytest.approx(np.hypot(*rod["centerline"][:, :2].T).max(), rel=1e-6)


def test_a_rod_does_not_depend_on_its_batch(store: DirectoryStore) -> None:
    tasks = _rods(7)
    # Rods of other settings are solved apart, and may be stored together.
    odd = SimulateTask(simulation=RodHangSimulation(gamma=9.0, phi0=1.0, phi1=1.0, poisson=0.3))
    together = run_tasks([odd, *tasks], store)[1:]
    for task, result in zip(tasks, together, strict=True):
        (alone,) = run_tasks([task], store)
        assert alone.output.labels == result.output.labels
        single, many = _curves(store, alone), _curves(store, result)
        assert all(np.array_equal(single[name], many[name]) for name in single)


def test_a_rod_without_a_stable_shape_is_rejected(
    store: DirectoryStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    solve = rod_hang.solve_rods

    def fail_some(*args: Any, **kwargs: Any) -> Any:
        solution = solve(*args, **kwargs)
        solution.converged[1] = False
        solution.stable[1:3] = False
        return solution

    monkeypatch.setattr(rod_hang, "solve_rods", fail_some)
    results = run_tasks(_rods(4), store)
    assert [result.outcome for result in results] == [
        "succeeded",
        "rejected",
        "rejected",
        "succeeded",
    ]
    assert {result.reason for result in results[1:3]} == {Reason.solver_diverged}
    assert results[1].message.startswith("the solver did not converge at gamma = 100.667, phi0 = 2")
    assert results[2].message.startswith("no stable equilibrium was found")
    assert [results[0].output.record.row, results[3].output.record.row] == [0, 1]


def test_all_rejected_makes_no_artifact(
    store: DirectoryStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    solve = rod_hang.solve_rods

    def fail(*args: Any, **kwargs: Any) -> Any:
        solution = solve(*args, **kwargs)
        solution.stable[:] = False
        return solution

    monkeypatch.setattr(rod_hang, "solve_rods", fail)
    assert {result.outcome for result in run_tasks(_rods(2), store)} == {"rejected"}
    assert not (store.root / "artifacts").exists()


@pytest.mark.parametrize("name", ["custom", "scene", "rod"])
def test_an_unknown_kind_is_refused(name: str) -> None:
    """Also where sim_core has a module of that name."""
    with pytest.raises(UnknownKindError):
        kind(name)
