"""Solver settings refuse what they cannot honour."""

from dataclasses import replace

import pytest

from stickslip_sim_core import PRESETS, SolverSettings, preset_named

CERTIFIED = preset_named("certified")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"newton_before_halving": -3},
            r"newton_before_halving: must be an integer, 1 \.\.\. 1000, got -3",
        ),
        (
            {"newton_before_halving": 1001},
            r"newton_before_halving: must be an integer, 1 \.\.\. 1000, got 1001",
        ),
        (
            {"newton_before_halving": 10.5},
            r"newton_before_halving: must be an integer, 1 \.\.\. 1000, got 10.5",
        ),
        ({"newton_max": 0}, r"newton_max: must be an integer, 1 \.\.\. 1000, got 0"),
        ({"halvings_max": 21}, r"halvings_max: must be an integer, 0 \.\.\. 20, got 21"),
        ({"refactor_after": -1}, r"refactor_after: must be an integer, 0 \.\.\. 10000, got -1"),
        ({"time_step": 0.0}, "time_step: must be above 0 and at most 1, got 0.0"),
        ({"time_step": float("nan")}, "time_step: must be above 0 and at most 1, got nan"),
        ({"tolerance": 2.0}, "tolerance: must be above 0 and at most 1, got 2.0"),
        ({"krylov_tolerance": 0.0}, "krylov_tolerance: must be above 0 and at most 1, got 0.0"),
        ({"unconverged_share_max": 1.5}, r"unconverged_share_max: must be 0 \.\.\. 1, got 1.5"),
        ({"name": ""}, "name: must not be empty"),
    ],
)
def test_refusals(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(CERTIFIED, **change)  # type: ignore[arg-type]


def test_names() -> None:
    assert all(settings.name == name for name, settings in PRESETS.items())
    custom = SolverSettings("own", 0.01)
    assert preset_named(custom) is custom
    with pytest.raises(ValueError, match="preset: must be one of certified"):
        preset_named("best")
