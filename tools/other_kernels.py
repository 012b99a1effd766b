"""Print the levels of cloth kernels that `make test` leaves out on this machine."""

import os

from stickslip_sim_core._sim_core import kernels
from stickslip_sim_core.cloth.solver import KERNEL_VARIABLE


def other_levels() -> list[str]:
    """Return the levels that the processor runs, without the one that is in use."""
    levels = kernels()
    # Cloth takes the widest level unless the environment names another one.
    in_use = os.environ.get(KERNEL_VARIABLE) or levels[-1]
    return [level for level in levels if level != in_use]


if __name__ == "__main__":
    print(*other_levels())
