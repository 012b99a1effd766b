"""Closest points, candidates and step bounds: finite differences, brute force, and ipctk as an
oracle.
"""

import math

import ipctk
import numpy as np
import pytest
from numpy.typing import NDArray

from stickslip_sim_core import _testing as core
from stickslip_sim_core import self_intersections
from stickslip_sim_core.cloth import meshes

pytestmark = pytest.mark.physics

Floats = NDArray[np.float64]

KINDS = pytest.mark.parametrize("edges", [False, True], ids=["vertex-triangle", "edge-edge"])


def distance(edges: bool, x: Floats) -> float:
    return math.hypot(*(core.closest_weights(edges, x) @ x))


def oracle(edges: bool, x: Floats) -> float:
    squared = ipctk.edge_edge_distance(*x) if edges else ipctk.point_triangle_distance(*x)
    return float(np.sqrt(squared))


def awkward(rng: np.random.Generator) -> Floats:
    """Four points that are now and then flat, parallel or in line."""
    x = rng.normal(size=(4, 3))
    match rng.integers(5):
        case 0:
            x[:, 2] *= 1e-6
        case 1:
            x[3] = x[2] + rng.normal() * (x[1] - x[0])
        case 2:
            x[3] = x[2] + rng.normal() * (x[1] - x[0]) + 1e-9 * rng.normal(size=3)
        case 3:
            x[0] = x[1] + rng.normal() * (x[2] - x[1]) + 1e-7 * rng.normal(size=3)
    return x


@KINDS
def test_distance_is_that_of_the_oracle(edges: bool) -> None:
    rng = np.random.default_rng(1)
    for _ in range(3000):
        x = awkward(rng)
        assert distance(edges, x) == pytest.approx(oracle(edges, x), rel=1e-7, abs=1e-9)


@KINDS
def test_weights_are_stationary(edges: bool) -> None:
    """The derivative of the distance is n times the weights."""
    rng = np.random.default_rng(2)
    count = 0
    while count < 100:
        x = rng.normal(size=(4, 3))
        w = core.closest_weights(edges, x)
        rho = w @ x
        if np.linalg.norm(rho) < 0.1:
            continue
        count += 1
        gradient = np.zeros((4, 3))
        for i, c in np.ndindex(4, 3):
            step = np.zeros((4, 3))
            step[i, c] = 1e-6
            gradient[i, c] = (distance(edges, x + step) - distance(edges, x - step)) / 2e-6
        assert gradient == pytest.approx(np.outer(w, rho / np.linalg.norm(rho)), abs=2e-5)


@KINDS
def test_weights_of_a_corner_are_exactly_zero(edges: bool) -> None:
    x = np.array([[0.0, 0.0, 1.0], [-2.0, 0.0, 1.0], [0.5, 0.0, 0.0], [3.0, 1.0, 0.0]])
    if not edges:
        x = np.array([[0.0, -3.0, 1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert sorted(np.abs(core.closest_weights(edges, x))) == [0.0, 0.0, 1.0, 1.0]


@KINDS
@pytest.mark.parametrize("most", [np.inf, 0.5])
def test_safe_fraction_keeps_the_distance_and_is_not_timid(edges: bool, most: float) -> None:
    rng = np.random.default_rng(3)
    ways = np.linspace(0.0, 1.0, 400)
    stopped = 0
    for _ in range(400):
        x, keep = awkward(rng), 0.2
        start = distance(edges, x)
        if start < 1e-4:
            continue
        to = x + rng.normal(size=(4, 3)) * rng.choice([0.1, 1.0, 10.0]) + rng.normal(size=3) * 10.0
        safe, least = core.safe_fraction(edges, x, to, keep, most), keep * min(start, most)
        along = np.array([distance(edges, x + s * (to - x)) for s in ways])
        inside = along[ways <= safe]
        assert inside.min() > 0.0
        assert distance(edges, x + safe * (to - x)) >= least * (1.0 - 1e-9)
        near = np.flatnonzero(along < least)
        if len(near):
            stopped += 1
            assert 0.8 * ways[near[0]] - 0.01 <= safe <= ways[near[0]]
        else:
            assert safe > 0.9  # between two samples it may have come near
    assert stopped > (15 if most == np.inf else 1)


@KINDS
def test_safe_fraction_takes_nothing_of_a_small_distance(edges: bool) -> None:
    """Else halves of halves end at rounding, and what presses on is on the other side."""
    rng = np.random.default_rng(7)
    stopped = 0
    for _ in range(400):
        x = awkward(rng)
        start = distance(edges, x)
        if start < 1e-4:
            continue
        to = x + rng.normal(size=(4, 3))
        safe = core.safe_fraction(edges, x, to, 0.5, np.inf, 2.0 * start)
        left = distance(edges, x + safe * (to - x))
        assert left >= start * (1.0 - 1e-9)
        stopped += safe < 1.0
    assert stopped > 5


@KINDS
def test_safe_fraction_is_that_of_the_oracle(edges: bool) -> None:
    """Which leaves a tenth of the distance, too, and stops a little before."""
    rng = np.random.default_rng(4)
    oracle_of = ipctk.AdditiveCCD()
    find = oracle_of.edge_edge_ccd if edges else oracle_of.point_triangle_ccd
    hits = 0
    for _ in range(500):
        x = rng.normal(size=(4, 3))
        to = x + 3.0 * rng.normal(size=(4, 3))
        hit, time = find(*x, *to)
        safe = core.safe_fraction(edges, x, to, 0.1, np.inf)
        assert hit == (safe < 1.0)
        if hit:
            hits += 1
            assert -0.01 < safe - time < 0.1
    assert hits > 40


def crumpled(seed: int, size: float = 0.03) -> tuple[Floats, NDArray[np.int32]]:
    rng = np.random.default_rng(seed)
    mesh = meshes.unstructured(0.1, 0.1, 0.0125, seed)
    return np.column_stack([mesh.rest * 0.5, np.zeros(len(mesh.rest))]) + size * rng.normal(
        size=(len(mesh.rest), 3)
    ), mesh.triangles


@pytest.fixture(scope="module")
def apart() -> dict[tuple[int, ...], float]:
    """The distance of each pair of a crumpled sheet: (0, vertex, triangle), (1, edge, edge)."""
    x, triangles = crumpled(5)
    edges = np.unique(
        np.sort(np.concatenate([triangles[:, p] for p in ([0, 1], [1, 2], [2, 0])]), axis=1), axis=0
    )
    pairs = [(0, vertex, *corners) for vertex in range(len(x)) for corners in triangles.tolist()]
    pairs += [(1, *a, *b) for i, a in enumerate(edges.tolist()) for b in edges[i + 1 :].tolist()]
    return {
        pair: distance(pair[0] == 1, x[[*pair[1:]]]) for pair in pairs if len(set(pair[1:])) == 4
    }


@pytest.mark.parametrize("reach", [1e-3, 5e-3, 0.02])
def test_candidates_are_those_of_brute_force(
    apart: dict[tuple[int, ...], float], reach: float
) -> None:
    x, triangles = crumpled(5)
    listed = [tuple(pair) for pair in core.contact_candidates(triangles, x, reach)]
    assert len(listed) > 10
    assert listed == [pair for pair, gap in apart.items() if gap <= reach]


def test_candidates_of_a_flat_sheet_are_none() -> None:
    mesh = meshes.grid(0.1, 0.1, 10, 10)
    flat = np.column_stack([mesh.rest, np.zeros(len(mesh.rest))])
    assert core.contact_candidates(mesh.triangles, flat, 0.0025) == []


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("way", [0.003, 0.03, 0.3])
def test_nothing_crosses_on_a_capped_way(seed: int, way: float) -> None:
    """Two sheets are thrown through each other, every vertex its own way."""
    rng = np.random.default_rng(seed)
    a, b = meshes.unstructured(0.1, 0.1, 0.0125, seed), meshes.grid(0.1, 0.1, 8, 8)
    triangles = np.concatenate([a.triangles, b.triangles + len(a.rest)]).astype(np.int32)
    x = np.concatenate(
        [
            np.column_stack([a.rest, 0.002 * np.sin(90.0 * a.rest[:, 0])]),
            np.column_stack([b.rest, np.full(len(b.rest), 0.006)]),
        ]
    )
    towards = np.where(np.arange(len(x)) < len(a.rest), 1.0, -1.0)[:, None] * np.array(
        [0.0, 0.0, way]
    )
    to = x + towards + way * rng.normal(size=x.shape) + 3.0 * way
    assert self_intersections(to, triangles) > 0
    end = core.cap_motion(triangles, x, to, 5e-4, 0.002)
    for share in np.linspace(0.0, 1.0, 200 if way < 0.1 else 50):
        if way < 0.02:  # longer ways go in hops, each straight
            assert self_intersections(x + share * (end - x), triangles) == 0
    assert self_intersections(end, triangles) == 0
    assert np.linalg.norm(end - x, axis=1).max() > 0.1 * way
    if way < 0.02:
        free = (np.linalg.norm(end - to, axis=1) == 0.0).mean()
        assert free > 0.05  # who is not in the way of others goes all the way


def test_a_common_way_is_not_capped() -> None:
    """Two sheets nearly touch and travel together."""
    mesh = meshes.grid(0.1, 0.1, 8, 8)
    triangles = np.concatenate([mesh.triangles, mesh.triangles + 81]).astype(np.int32)
    x = np.concatenate([np.column_stack([mesh.rest, np.full(81, z)]) for z in (0.0, 5e-4)])
    to = x + np.array([0.3, -0.2, 0.1])
    assert (core.cap_motion(triangles, x, to, 5e-4, 0.001) == to).all()
