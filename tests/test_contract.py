"""The contract in the schemas agrees with the core and the renderer."""

import inspect
from pathlib import Path
from typing import Any

import pytest
import stickslip_sim_core
import yaml
from pydantic import ValidationError
from stickslip_schemas.documents.certificate import Certificate
from stickslip_schemas.format.manifest import layout
from stickslip_schemas.kinds import KINDS, UnknownKindError, job_spec_adapter
from stickslip_schemas.kinds.cloth.arrays import KERNELS
from stickslip_schemas.kinds.cloth_drag import SELF_FRICTION, ClothDragSpec
from stickslip_schemas.kinds.rod_hang import ROD_PRESET, RodHangSpec
from stickslip_schemas.plan.points import keyed_points
from stickslip_schemas.spec.fabrics import FabricNumbers
from stickslip_schemas.spec.jobs import CONTACT_PROTOCOLS, JobSpec, PresetName
from stickslip_schemas.spec.names import Material
from stickslip_services.queue.plan import expand, plan_inputs_for
from stickslip_services.queue.rows import PlanInputs
from stickslip_sim_core._sim_core import kernels
from stickslip_sim_core.cloth.contact import MU_MAX
from stickslip_sim_core.cloth.contact import SELF_FRICTION as CORE_SELF_FRICTION
from stickslip_sim_core.protocols import CERTIFICATION
from stickslip_sim_core.scenes import cloth_drag
from stickslip_testing.samples import samples
from stickslip_testing.worker import BUILDS
from stickslip_training.benchmark.sets import load_set
from stickslip_workers.builds import kind

ROOT = Path(__file__).parents[1]


def test_materials_presets_and_kernels_have_one_name() -> None:
    assert tuple(Material) == stickslip_sim_core.fabric_names()
    assert [preset.value for preset in PresetName] == list(stickslip_sim_core.PRESETS)
    assert {ROD_PRESET, *PresetName} == set(CERTIFICATION)
    assert tuple(kernels()) == KERNELS[: len(kernels())]
    assert Certificate.model_fields["sim_core"].annotation is str


def test_instants_are_those_of_the_scenes() -> None:
    assert (ClothDragSpec.instants, ClothDragSpec.instants_per_second) == (
        cloth_drag.FRAMES,
        cloth_drag.FRAME_RATE,
    )


def test_self_contact_has_one_default_and_certified_protocols() -> None:
    assert CORE_SELF_FRICTION == SELF_FRICTION
    asked = inspect.signature(cloth_drag.scene).parameters["self_friction"].default
    assert ClothDragSpec.model_fields["self_friction"].default == asked == SELF_FRICTION
    for name, preset in CERTIFICATION.items():
        has = set(CONTACT_PROTOCOLS) & set(preset.protocols)
        assert has == (
            set() if name == ROD_PRESET or name.startswith("thesis-") else set(CONTACT_PROTOCOLS)
        ), name


def test_the_example_of_clips_is_the_published_test_set() -> None:
    example = yaml.safe_load((ROOT / "examples/thesis-cloth-clips.yaml").read_text())
    published = load_set("cloth-1").parsed_spec
    assert isinstance(published, ClothDragSpec)
    assert published.self_friction is None  # its clips show cloth that passes through itself
    assert job_spec_adapter.validate_python(example).content_digest == published.content_digest


def test_friction_has_one_range() -> None:
    axes = {"material": "gray-interlock", "mu": MU_MAX, "texture": "dots", "viewpoint": "left"}
    ClothDragSpec.model_validate({"kind": "cloth_drag", "axes": axes})
    with pytest.raises(ValidationError, match=f"less than or equal to {MU_MAX:g}"):
        ClothDragSpec.model_validate({"kind": "cloth_drag", "axes": axes | {"mu": MU_MAX + 1e-9}})


@pytest.mark.parametrize(
    "numbers",
    [
        {
            "density": 0.01,
            "young": 1e4,
            "poisson": 0.49,
            "thickness": 2.1e-5,
            "bending": (1e-9, 1e-9, 1e-12),
        },
        {
            "density": 5.0,
            "young": 1e8,
            "poisson": 0.49,
            "thickness": 0.0044,
            "bending": (0.049, 0.049, 1.0),
            "damping": 10.0,
        },
        {"density": 0.2, "stretching": ((1e6, 0.0, 1e6, 1e6),) * 6, "bending": (1e-5, 1e-5, 1e-6)},
        {"density": 0.2, "stretching": "navy-sparkle-sweat", "bending": (1e-5, 1e-5, 1e-6)},
    ],
)
def test_the_core_takes_every_fabric_that_a_spec_may_have(numbers: dict[str, Any]) -> None:
    fabric_numbers = FabricNumbers.model_validate(numbers)
    stickslip_sim_core.custom_fabric("own", **fabric_numbers.numbers())
    stiffer = {"young": 1e9, "thickness": 0.01, "poisson": 0.3, "density": 0.2}
    with pytest.raises(ValidationError, match="young times thickness must be at most 1e"):
        FabricNumbers.model_validate(stiffer)


@pytest.mark.parametrize("name", KINDS)
def test_every_layer_knows_every_kind(name: str) -> None:
    assert kind(name).batch >= 1
    assert (ROOT / f"workers/blender/src/stickslip_blender/scenes/{name}.py").is_file()


class SilkFlySpec(RodHangSpec):
    """A spec that nobody registered, complete though it is."""


class OtherClothSpec(ClothDragSpec):
    """Another one."""


@pytest.mark.parametrize("of", [SilkFlySpec, OtherClothSpec])
def test_a_class_of_spec_that_nobody_registered_is_refused_everywhere(of: type[JobSpec]) -> None:
    rods = {"gamma": 1.0, "phi0": 1.0, "phi1": 1.0}
    cloth = {"material": "gray-interlock", "mu": 0.3, "texture": "dots", "viewpoint": "left"}
    name = "cloth_drag" if issubclass(of, ClothDragSpec) else "rod_hang"
    spec = of.model_validate(
        {"kind": name, "axes": cloth if issubclass(of, ClothDragSpec) else rods}
    )
    with pytest.raises(UnknownKindError, match="kind must be one of"):
        expand(spec, PlanInputs(BUILDS, None))
    with pytest.raises(UnknownKindError, match="kind must be one of"):
        layout(spec)
    with pytest.raises(UnknownKindError, match="kind must be one of"):
        next(iter(samples(spec, BUILDS)))
    with pytest.raises(UnknownKindError, match="kind must be one of"):
        next(iter(keyed_points(spec, BUILDS)))
    with pytest.raises(UnknownKindError, match="kind must be one of"):
        plan_inputs_for(None, spec)  # type: ignore[arg-type]  # it is refused before anything is looked up
