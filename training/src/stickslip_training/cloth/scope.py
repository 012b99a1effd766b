"""Scope of the weights of the package: the datasets that they can read.

The network was tuned on simulations with the preset `certified` on a mesh of 41 x 41. A coarser
mesh is stiffer, and drags in another way. On 50 simulations of mesh 21 and preset `fast` the
estimate of mu is 0.01 too high below 0.4, 0.06 too low from there to 0.8, and 0.11 too low above.
On mesh 41 and `certified` the mean of the errors is within 0.03 of 0 below 1.2. The clips of
training, and those of the test `cloth-2`, have the quality `draft`; those of `cloth-1` `standard`.
"""

from dataclasses import dataclass

from stickslip_schemas.kinds.cloth_drag import ClothDragSpec

MU_MAX = 1.6
"""Largest friction coefficient of the training."""


@dataclass(frozen=True)
class Scope:
    """Settings of simulations that a model can read."""

    mesh_min: int
    """Coarsest mesh, in vertices along a side. A finer one moves a vertex by less than 0.4 mm."""
    presets: tuple[str, ...]
    qualities: tuple[str, ...]
    """Qualities of pictures."""
    materials: tuple[str, ...]
    mu_max: float = MU_MAX

    def outside(self, spec: ClothDragSpec, materials: set[str], mu: float) -> list[str]:
        """Return the settings of a dataset that the model does not know, each with its value.

        `materials` are the clips' materials, and `mu` is their largest friction coefficient.
        """
        unknown = []
        if spec.mesh < self.mesh_min:
            unknown.append(f"mesh {spec.mesh} (known: {self.mesh_min} and finer)")
        if spec.preset not in self.presets:
            unknown.append(f"preset {spec.preset} (known: {', '.join(self.presets)})")
        if spec.quality not in self.qualities:
            unknown.append(f"quality {spec.quality} (known: {', '.join(self.qualities)})")
        strangers = sorted(materials - set(self.materials))
        if strangers:
            known = ", ".join(self.materials)
            unknown.append(f"material {', '.join(strangers)} (known: {known})")
        if mu > self.mu_max:
            unknown.append(f"mu {mu:g} (known: 0 to {self.mu_max:g})")
        return unknown

    def check(self, spec: ClothDragSpec, materials: set[str], mu: float) -> None:
        """Raise ValueError, with a remedy, if the model does not know a dataset."""
        unknown = self.outside(spec, materials, mu)
        if unknown:
            raise ValueError(
                f"outside of what the weights of the package know: {', '.join(unknown)}. Make the "
                "dataset as examples/friction-cloth.yaml does, or train a model on yours "
                "(stickslip-train cloth train) and name it with --model"
            )


def package_scope(materials: tuple[str, ...]) -> Scope:
    """Return the scope of the weights of the package, which know these materials."""
    return Scope(
        mesh_min=41,
        presets=("certified", "fine"),
        qualities=("draft", "standard"),
        materials=materials,
    )
