"""Friction on what is round against a cell obeys the capstan equation, whatever the cell."""

import pytest

from stickslip_sim_core import preset_named
from stickslip_sim_core.protocols import edge


@pytest.mark.physics
class TestEdges:
    @pytest.mark.parametrize("mu", [0.1, 0.6])
    @pytest.mark.parametrize("cells", [1.0, 2.0])
    def test_a_rounded_box(self, cells: float, mu: float) -> None:
        radius = cells * edge.CELL
        pulled = edge.pull_over(edge.box_table(mu, radius), radius, mu, preset_named("certified"))
        assert pulled.cloth.total.unconverged == 0
        assert pulled.measured == pytest.approx(pulled.needed, rel=0.03)

    @pytest.mark.parametrize("cells", [1.0, 2.0])
    def test_the_skin_of_a_sharp_mesh(self, cells: float) -> None:
        """Vertices keep half of both thicknesses, so the skin rounds the edge."""
        mu, radius = 0.6, cells * edge.CELL
        pulled = edge.pull_over(edge.skin_table(mu, radius), radius, mu, preset_named("certified"))
        assert pulled.cloth.total.unconverged == 0
        assert pulled.measured == pytest.approx(pulled.needed, rel=0.03)
