"""Constants of the cloth solver, halved and doubled: results move within a bound, and the cost
within a factor.

Where contact makes a cloth choose, as which way a fold falls, any change of rounding may choose
otherwise: the bounds of such scenes are the size of that, and of the others a share of the
thickness.
"""

import pytest
from stickslip_testing import constants
from stickslip_testing.constants import SCENES, change, default, scaled

from stickslip_sim_core import Cloth, SolverSettings, fabric
from stickslip_sim_core._sim_core import cloth_constants
from stickslip_sim_core.cloth import meshes

MOVED = {
    "pile": 2e-4,
    "fold": 5e-4,  # the thickness: up to 0.33 mm since steps are staggered, halved `newton.window`
    "squeeze": 2e-4,
    "strip": 2e-4,
    "let down": 1e-3,
    "ball": 0.01,
    "edges": 0.01,
    "valley": 2e-3,
    "crumple": 0.04,
    "push": 0.04,
}
"""Largest distance of a vertex from where it is with the default, at the end of each scene [m]."""

COST = 3.0
"""Factor by which iterations may grow, of Newton's method and of GMRES."""

CASES: dict[str, str] = {
    name: scene
    for scene, names in {
        "pile": """contact.closing_gap contact.crossing_least contact.proximal contact.turn_max
            contact.law_stiffness factor.changed_share newton.longest
            newton.pairs_tolerance stepping.inside""",
        "fold": """contact.end_share contact.match_cosine contact.merge_radius
            contact.penalty_growth contact.transfer_radius contact.length_tolerance
            contact.stall_ratio
            contact.stall_up_to contact.mean_share factor.hold_change factor.hold_least
            factor.missing_share factor.stiffening_change newton.halving_iterations
            newton.hops newton.linear_share newton.reversals_from newton.nearly
            newton.rounds_max newton.cuts_max newton.window contact.penalty path.rest
            path.floor path.keep path.margin""",
        "squeeze": "contact.surface_share",
        "crumple": """contact.detection_range contact.penalty_max contact.smooth_proximal
            contact.stiff_mean_share smooth.body_first path.rounds_max
            factor.fold_smallest newton.common_least newton.slow newton.smooth_hops
            newton.smooth_near newton.smooth_tolerance newton.smoothing_ratio
            stepping.easy stepping.smooth_iterations stepping.stalled_long""",
        "strip": """stepping.lag control.dearer control.factor_work control.forgiven control.grow_at
            control.newton_work control.looks control.novelty control.reject_at
            control.rejected_work factor.pool""",
        "ball": """smooth.between smooth.beyond_edge smooth.curvature_max smooth.fold_over
            smooth.reach smooth.same_normal""",
        "edges": "stepping.sweep",
        "valley": "contact.fillet",
        "push": "stepping.near_patience stepping.stalled_soon",
        "let down": "control.halvings",
    }.items()
    for name in names.split()
}
"""The scene in which each constant matters, and which is quick."""

DEARER = {
    ("stepping.stalled_soon", 0.5): 20.0,
}
"""Factors of the cost beyond COST."""

OTHERWISE = {("newton.cuts_max", 0.5), ("contact.penalty", 2.0), ("control.grow_at", 2.0)}
"""Changes with which the fold falls, or the strip buckles, another way."""


def test_every_constant_has_a_case() -> None:
    assert set(CASES) == set(cloth_constants())


def test_counts_are_those_of_the_solver() -> None:
    mesh, material = meshes.grid(0.1, 0.1, 2, 2), fabric("gray-interlock")
    for name in cloth_constants():
        settings = SolverSettings("own", 0.02, constants={name: 1.5})
        if name in constants.COUNTS:
            with pytest.raises(ValueError, match=f"{name}: must be an integer >= 1, got 1.5"):
                Cloth(mesh, material, settings)
        else:
            Cloth(mesh, material, settings)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"contact.nothing": 1.0}, "constants: there is no contact.nothing"),
        ({"contact.proximal": 0.0}, "contact.proximal: must be finite and > 0, got 0"),
        ({"contact.proximal": float("nan")}, "contact.proximal: must be finite and > 0, got nan"),
    ],
)
def test_constants_that_break_a_rule_are_refused(changed: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Cloth(
            meshes.grid(0.1, 0.1, 2, 2),
            fabric("gray-interlock"),
            SolverSettings("own", 0.02, constants=changed),
        )


def test_numbers_of_a_preset_are_those_of_its_solver() -> None:
    numbers = SolverSettings("own", 0.02, constants={"contact.proximal": 20.0}).numbers()
    assert numbers == {
        **{
            name: value
            for name, value in vars(SolverSettings("own", 0.02)).items()
            if name != "constants"
        },
        **cloth_constants(),
        "contact.proximal": 20.0,
    }


@pytest.fixture(autouse=True)
def same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cloth that chooses must choose alike on every processor."""
    monkeypatch.setenv("STICKSLIP_CLOTH_KERNEL", "baseline")


@pytest.mark.slow  # 50 CPU s in all
@pytest.mark.parametrize("factor", [0.5, 2.0])
@pytest.mark.parametrize("name", sorted(CASES))
def test_halved_and_doubled(name: str, factor: float) -> None:
    if scaled(name, factor) == scaled(name, 1.0):
        pytest.skip("a count of 1 has no half")
    scene = CASES[name]
    assert scene in SCENES
    found = change(scene, name, factor)
    assert found.unconverged == default(scene).unconverged == 0
    assert found.moved < (0.25 if (name, factor) in OTHERWISE else MOVED[scene])
    limit = DEARER.get((name, factor), COST)
    assert max(found.newton, found.krylov) < limit
    # Half the share that pairs with surfaces keep is half the distance; nodes that miss a surface
    # are left to these.
    assert found.least_distance >= 0.4 * default(scene).least_distance
