"""What two packages both say: the contract in the schemas, and what the core and the renderer do."""

from pathlib import Path

import pytest
import stickslip_sim_core
from pydantic import ValidationError
from stickslip_schemas.certificate import Certificate
from stickslip_schemas.cloth import KERNELS, ClothSpec, PresetName
from stickslip_schemas.fabrics import Material
from stickslip_schemas.jobs import JobSpec
from stickslip_schemas.kinds import KINDS, UnknownKindError
from stickslip_schemas.kinds.cloth_drag import ClothDragSpec
from stickslip_schemas.kinds.cloth_sphere import ClothSphereSpec
from stickslip_schemas.kinds.rod_hang import ROD_PRESET, RodHangSpec
from stickslip_schemas.layout import layout
from stickslip_schemas.samples import keyed_points, samples
from stickslip_services.queue.planning import expand
from stickslip_services.queue.terms import terms_for
from stickslip_services.testing import BUILDS
from stickslip_sim_core._sim_core import cloth_kernels
from stickslip_sim_core.cloth.solver import MU_MAX
from stickslip_sim_core.protocols import CERTIFICATION
from stickslip_sim_core.scenes import cloth_drag, cloth_sphere
from stickslip_training.kinds import dataset_class
from stickslip_workers.kinds import kind

ROOT = Path(__file__).parents[1]


def test_materials_presets_and_kernels_have_one_name() -> None:
    assert tuple(Material) == stickslip_sim_core.fabric_names()
    assert [preset.value for preset in PresetName] == list(stickslip_sim_core.PRESETS)
    assert {ROD_PRESET, *PresetName} == set(CERTIFICATION)
    assert tuple(cloth_kernels()) == KERNELS[: len(cloth_kernels())]
    assert Certificate.model_fields["sim_core"].annotation is str


def test_instants_are_those_of_the_scenes() -> None:
    assert (ClothDragSpec.instants, ClothDragSpec.instants_per_second) == (cloth_drag.FRAMES, cloth_drag.FRAME_RATE)
    assert (ClothSphereSpec.instants, ClothSphereSpec.instants_per_second) == (
        cloth_sphere.FRAMES,
        cloth_sphere.FRAME_RATE,
    )
    source = (ROOT / "workers/blender/src/stickslip_blender/scenes/cloth_sphere.py").read_text()
    assert f"RADIUS = {cloth_sphere.RADIUS}\n" in source
    assert f"SETTLING, FRAMES_PER_SECOND = {cloth_sphere.SETTLING}, {cloth_sphere.FRAME_RATE}\n" in source


def test_friction_has_one_range() -> None:
    axes = {"material": "gray-interlock", "mu": MU_MAX, "texture": "dots", "viewpoint": "left"}
    ClothDragSpec.model_validate({"kind": "cloth_drag", "axes": axes})
    with pytest.raises(ValidationError, match=f"less than or equal to {MU_MAX:g}"):
        ClothDragSpec.model_validate({"kind": "cloth_drag", "axes": axes | {"mu": MU_MAX + 1e-9}})


@pytest.mark.parametrize("name", KINDS)
def test_every_layer_knows_every_kind(name: str) -> None:
    assert kind(name).batch >= 1
    assert dataset_class(name).kind == name
    assert (ROOT / f"workers/blender/src/stickslip_blender/scenes/{name}.py").is_file()


class SilkFlySpec(RodHangSpec):
    """A spec that nobody registered, complete though it is."""


class OtherClothSpec(ClothDragSpec):
    """Another one."""


@pytest.mark.parametrize("of", [SilkFlySpec, OtherClothSpec])
def test_a_class_of_spec_that_nobody_registered_is_refused_everywhere(of: type[JobSpec]) -> None:
    rods = {"gamma": 1.0, "phi0": 1.0, "phi1": 1.0}
    cloth = {"material": "gray-interlock", "mu": 0.3, "texture": "dots", "viewpoint": "left"}
    name = "cloth_drag" if issubclass(of, ClothSpec) else "rod_hang"
    spec = of.model_validate({"kind": name, "axes": cloth if issubclass(of, ClothSpec) else rods})
    with pytest.raises(UnknownKindError, match="kind must be one of"):
        expand(spec, BUILDS)
    with pytest.raises(UnknownKindError, match="kind must be one of"):
        layout(spec)
    with pytest.raises(UnknownKindError, match="kind must be one of"):
        next(iter(samples(spec, BUILDS)))
    with pytest.raises(UnknownKindError, match="kind must be one of"):
        next(iter(keyed_points(spec, BUILDS)))
    with pytest.raises(UnknownKindError, match="kind must be one of"):
        terms_for(None, spec)  # type: ignore[arg-type]  # it is refused before anything is looked up
