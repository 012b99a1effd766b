import json
from itertools import pairwise

import numpy as np
import pytest
from stickslip_training.cloth.runs import between, grid_order, load_runs


def test_the_packed_file_is_small_and_says_what_it_holds(packed, runs):
    assert packed.stat().st_size < 3e6
    with np.load(packed) as file:
        about = [json.loads(str(line)) for line in file["about"]]
        assert all(run["valid"] and run["vertices"] == 21 and run["build"] for run in about)
    assert len(runs) == len(about) >= 50
    assert runs.positions.shape == (len(runs), 30, 21, 21, 3)
    assert [runs.materials[code] for code in runs.material] == [run["material"] for run in about]
    assert runs.mu.tolist() == [run["mu"] for run in about]
    assert runs.instants == tuple(range(0, 300, 10))
    assert set(runs.landed) == {-1, 1}


def test_positions_are_a_grid_of_cloth_to_ten_micrometres(runs):
    height = runs.positions[:, 0, :, 10, 2]
    assert (np.diff(height, axis=1) > 0).all()  # rows go up the hanging cloth
    y = runs.positions[:, 0, -1, :, 1]
    assert (np.diff(y, axis=1) > 0).all()  # columns along y
    assert y[:, [0, -1]] == pytest.approx(np.broadcast_to([-0.1, 0.1], (len(runs), 2)), abs=1e-5)
    assert runs.positions[..., 2].min() > -1e-3
    steps = runs.positions / 1e-5
    assert np.abs(steps - steps.round()).max() < 0.1


def test_meshes_are_taken_between_neighbours_of_one_fabric_and_side(runs):
    pairs = between(runs, 0.3)
    assert len(pairs) > len(runs) // 3
    for a, b in pairs:
        assert runs.material[a] == runs.material[b]
        assert runs.landed[a] == runs.landed[b]
        assert 0 <= runs.mu[b] - runs.mu[a] <= (0.3 if runs.mu[a] >= 0.4 else 0.15)
        inner = (runs.mu > runs.mu[a]) & (runs.mu < runs.mu[b])
        assert not (
            inner & (runs.material == runs.material[a]) & (runs.landed == runs.landed[a])
        ).any()


def test_a_mesh_between_two_is_near_the_simulation_that_lies_there(runs):
    """Leave one out, above a friction of 0.4 and along a leg: to 0.1 mm in the median."""
    off = []
    for code in range(len(runs.materials)):
        for side in (-1, 1):
            chosen = np.flatnonzero(
                (runs.material == code) & (runs.landed == side) & (runs.mu > 0.4)
            )
            chosen = chosen[np.argsort(runs.mu[chosen])]
            for (a, b), (_, c) in pairwise(pairwise(chosen.tolist())):
                share = (runs.mu[b] - runs.mu[a]) / (runs.mu[c] - runs.mu[a])
                mean = (1 - share) * runs.positions[a, 8] + share * runs.positions[c, 8]
                off.append(np.linalg.norm(mean - runs.positions[b, 8], axis=-1).mean())
    assert len(off) > 10
    assert np.median(off) < 1e-4


def test_what_is_no_grid_is_refused():
    y, z = (values.ravel() for values in np.meshgrid(np.linspace(-1, 1, 3), np.linspace(-1, 1, 3)))
    rest = np.stack([y, z], axis=1).astype(np.float32)
    assert grid_order(rest[::-1]).tolist() == [[8, 7, 6], [5, 4, 3], [2, 1, 0]]
    bent = rest.copy()
    bent[4] += 0.1
    for bad in (rest[:-1], bent):
        with pytest.raises(ValueError, match="rest must be a square grid of vertices"):
            grid_order(bad)


def test_a_damaged_packed_file_is_refused(packed, tmp_path):
    damaged = tmp_path / "runs.npz"
    data = bytearray(packed.read_bytes())
    data[len(data) // 2] ^= 1
    damaged.write_bytes(data)
    with pytest.raises(ValueError, match=r"runs\.npz must be a packed file .*CRC"):
        load_runs(damaged)
