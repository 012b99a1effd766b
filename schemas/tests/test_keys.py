"""Content keys: pinned, and sensitive to exactly what a result depends on."""

from dataclasses import replace

import pytest
from stickslip_schemas.base.keys import canonical_json, content_key, derived_seed
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.kinds.cloth.arrays import KERNELS
from stickslip_schemas.kinds.cloth.drag_scene import Viewpoint
from stickslip_schemas.kinds.cloth_drag import ClothDragRender
from stickslip_schemas.kinds.cloth_sphere import SphereViewpoint
from stickslip_schemas.kinds.rod_hang import RodHangRender
from stickslip_schemas.kinds.shawl import ShawlViewpoint
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.plan.grid import dataset_id
from stickslip_schemas.plan.points import pack_key, publish_key
from stickslip_schemas.spec.arrays import SPLITS
from stickslip_schemas.spec.fabrics import Material, Texture
from stickslip_testing.samples import Sample, render_key, samples, simulation_key, split_of

BUILDS = Builds(sim_core="a" * 64, simulate="a" * 64, render="b" * 64, pack="c" * 64)


def one(
    poisson: float = 0.5, seed: int = 0, builds: Builds = BUILDS, name: str | None = None, **more: object
) -> Sample:
    document = {
        "kind": "rod_hang",
        "name": name,
        "axes": {"gamma": 100.0, "phi0": 1.0, "phi1": 6.0},
        "poisson": poisson,
        "seed": seed,
        **more,
    }
    (sample,) = samples(job_spec_adapter.validate_python(document), builds)
    return sample


def test_canonical_json_is_one_text() -> None:
    assert canonical_json({"b": [1, 2.0, -0.0], "a": "µ"}) == '{"a":"\\u00b5","b":[1,2.0,0.0]}'
    with pytest.raises(ValueError, match="not JSON compliant"):
        canonical_json(float("nan"))


def test_purposes_keep_keys_apart() -> None:
    assert content_key("one", 1) != content_key("two", 1)


def test_pinned_keys() -> None:
    """Keys of finished work: if one of these changes, every dataset in the world would be made again."""
    sample = one()
    assert sample.simulation_key == PINNED["simulation"]
    assert sample.split == PINNED["split"]
    assert isinstance(sample.render, RodHangRender)
    assert sample.render.color_seed == PINNED["color_seed"]
    spec = job_spec_adapter.validate_python({"kind": "rod_hang", "axes": {"gamma": 100.0, "phi0": 1.0, "phi1": 6.0}})
    assert spec.content_digest == PINNED["spec"]
    dragged = {
        "kind": "cloth_drag",
        "axes": {"material": "royal-target", "mu": 0.3, "texture": "dots", "viewpoint": "left"},
    }
    (cloth,) = samples(job_spec_adapter.validate_python(dragged), BUILDS)
    assert cloth.simulation_key == PINNED["cloth_simulation"]
    assert cloth.render_key == PINNED["cloth_render"]
    (through,) = samples(job_spec_adapter.validate_python(dragged | {"self_friction": None}), BUILDS)
    assert through.simulation_key == PINNED["cloth_through_itself"]


def test_simulation_depends_on_physics_and_sim_core_only() -> None:
    key = one().simulation_key
    assert one(poisson=0.3).simulation_key != key
    assert one(builds=BUILDS.model_copy(update={"simulate": "d" * 64})).simulation_key != key
    assert one(builds=BUILDS.model_copy(update={"render": "d" * 64})).simulation_key == key
    assert one(seed=1, name="x", views=None, samples_per_shard=2).simulation_key == key


def test_render_depends_on_simulation_look_and_renderer() -> None:
    key = one().render_key
    assert one(poisson=0.3).render_key != key
    assert one(seed=1).render_key != key
    assert one(quality="draft").render_key != key
    assert one(builds=BUILDS.model_copy(update={"render": "d" * 64})).render_key != key
    assert one(name="x", samples_per_shard=2).render_key == key


def test_a_name_is_no_content_and_a_build_makes_no_other_dataset() -> None:
    def spec(**more: object) -> object:
        return job_spec_adapter.validate_python(
            {"kind": "rod_hang", "axes": {"gamma": 1, "phi0": 1, "phi1": 6}, **more}
        )

    assert dataset_id(spec(name="a")) == dataset_id(spec(name="b"))  # type: ignore[arg-type]
    assert dataset_id(spec(seed=1)) != dataset_id(spec())  # type: ignore[arg-type]


def test_neighbours_in_the_grid_change_no_sample() -> None:
    """Extending a grid must find the old samples again: nothing of them depends on their slot."""
    small = {"kind": "rod_hang", "axes": {"gamma": [100, 200], "phi0": 1, "phi1": 6}}
    large = {"kind": "rod_hang", "axes": {"gamma": [50, 100, 200], "phi0": [0.5, 1], "phi1": 6}}
    before = {sample.key: sample for sample in samples(job_spec_adapter.validate_python(small), BUILDS)}
    after = {sample.key: sample for sample in samples(job_spec_adapter.validate_python(large), BUILDS)}
    assert set(before) < set(after)
    assert all(after[key].split == sample.split for key, sample in before.items())


def test_pack_and_publish_keys_hold_what_they_are_made_of() -> None:
    spec = job_spec_adapter.validate_python({"kind": "rod_hang", "axes": {"gamma": [1, 2], "phi0": 1, "phi1": 6}})
    first, second = samples(spec, BUILDS)
    key = pack_key(spec, 0, [first, second], BUILDS)
    assert key != pack_key(spec, 0, [second, first], BUILDS)
    assert key != pack_key(spec, 1, [first, second], BUILDS)
    assert key != pack_key(spec, 0, [first, second], BUILDS.model_copy(update={"pack": "d" * 64}))
    assert publish_key(spec, [key], BUILDS) != publish_key(spec, [key, key], BUILDS)


GRID = {
    "kind": "cloth_drag",
    "axes": {
        "material": ["royal-target", "gray-interlock"],
        "mu": {"type": "linspace", "start": 0, "stop": 1.5, "num": 16},
        "texture": ["dots", "checker", "plaid"],
        "viewpoint": ["left", "right"],
    },
}


def test_splits_by_clip_part_the_renders_of_a_simulation_and_change_no_other_key() -> None:
    """For comparison with the thesis, whose test clips very likely show simulations that were trained on."""
    spec = job_spec_adapter.validate_python(GRID)
    by_clip = job_spec_adapter.validate_python(GRID | {"splits": {"by": "clip"}})
    found: dict[str, set[int]] = {}
    for plain, sample in zip(samples(spec, BUILDS), samples(by_clip, BUILDS), strict=True):
        assert sample.key == plain.key
        assert sample.split == split_of(by_clip, sample.labels)
        found.setdefault(sample.simulation_key, set()).add(sample.split)
    assert sum(len(splits) > 1 for splits in found.values()) > 10


def test_renders_of_one_simulation_share_its_split() -> None:
    spec = job_spec_adapter.validate_python(GRID)
    split_of: dict[str, set[int]] = {}
    for sample in samples(spec, BUILDS):
        split_of.setdefault(sample.simulation_key, set()).add(sample.split)
    assert len(split_of) == 32
    assert all(len(splits) == 1 for splits in split_of.values())
    assert {split for splits in split_of.values() for split in splits} == {0, 1, 2}


def test_split_shares_come_out() -> None:
    spec = job_spec_adapter.validate_python(
        {
            "kind": "rod_hang",
            "axes": {"gamma": {"type": "linspace", "start": 0, "stop": 1, "num": 4000}, "phi0": 1, "phi1": 6},
            "views": None,
        }
    )
    counts = [0, 0, 0]
    for sample in samples(spec, BUILDS):
        counts[sample.split] += 1
    # Binomial: five standard deviations of 4000 draws.
    assert abs(counts[0] / 4000 - 0.8) < 5 * (0.8 * 0.2 / 4000) ** 0.5
    assert abs(counts[2] / 4000 - 0.1) < 5 * (0.1 * 0.9 / 4000) ** 0.5


def test_seed_zero_is_a_seed() -> None:
    assert derived_seed(0, "color", 1) != derived_seed(1, "color", 1)
    assert derived_seed(0, "color", 1) == derived_seed(0, "color", 1)


PINNED: dict[str, object] = {
    "simulation": "0d76b7c90598207274ab9510adbb58fa2d82fef780b8da497c232a2ac9247c2a",
    "split": 0,
    "color_seed": 1423131992,
    "spec": "473d8dc6dc2024b5e3f18fbc9953dca6f325c8f53e87629de6d8277bf2b4c8db",
    "cloth_simulation": "789307b6d058b495f6cb68d128e117725f930fd1eeb607576e3139c9ab7a18e8",
    "cloth_through_itself": "cd4fa25293c36d85fe5571770462b8652db024c0f2440f95bd8cdbc7d335d872",
    "cloth_render": "20ac91ca63472c7a6dab29d93cab25bed346a0cf15547c92da2515c5218ad95b",
}


def test_a_pack_key_holds_the_splits_and_the_arrays() -> None:
    spec = job_spec_adapter.validate_python({"kind": "rod_hang", "axes": {"gamma": [1, 2], "phi0": 1, "phi1": 6}})
    members = list(samples(spec, BUILDS))
    moved = [replace(members[0], split=(members[0].split + 1) % 3), members[1]]
    assert pack_key(spec, 0, moved, BUILDS) != pack_key(spec, 0, members, BUILDS)
    document = {
        "kind": "cloth_drag",
        "materials": {"mine": {"density": 0.2, "young": 1e6, "poisson": 0.3, "thickness": 5e-4}},
        "axes": {"material": "royal-target", "mu": 0.3, "texture": "dots", "viewpoint": "left"},
    }
    one = job_spec_adapter.validate_python(document)
    two = job_spec_adapter.validate_python(document | {"materials": {}})
    members = list(samples(one, BUILDS))
    assert [sample.key for sample in samples(two, BUILDS)] == [sample.key for sample in members]
    assert pack_key(one, 0, members, BUILDS) != pack_key(two, 0, members, BUILDS)  # the codes of materials differ


def test_codes_of_labels_are_pinned() -> None:
    """A code is stored in datasets for good: a name may be added at the end, and none may move."""
    assert {name: code for code, name in enumerate(Material)} == {
        "11oz-black-denim": 0,
        "camel-ponte-roma": 1,
        "gray-interlock": 2,
        "ivory-rib-knit": 3,
        "navy-sparkle-sweat": 4,
        "pink-ribbon-brown": 5,
        "royal-target": 6,
        "tango-red-jet-set": 7,
        "white-dots-on-blk": 8,
        "white-swim-solid": 9,
    }
    textures = ["checker", "dots", "stripes", "plaid", "gingham", "herringbone", "houndstooth", "floral"]
    assert list(Texture)[:8] == textures
    assert list(Viewpoint)[:3] == ["calibrated", "left", "right"]
    assert list(SphereViewpoint) == ["front", "side", "high"]
    assert list(ShawlViewpoint) == ["front", "side", "high"]
    assert KERNELS == ("baseline", "x86-64-v3", "x86-64-v4")
    assert SPLITS == ("train", "validation", "test")


def test_documents_of_samples_are_those_that_are_keyed() -> None:
    """The fast way over texts and the plain way over models give the same keys, for every kind and optional axis."""
    own = {"density": 0.2, "young": 1e6, "poisson": 0.3, "thickness": 5e-4}
    cloth = {"material": ["mine", "royal-target"], "mu": [0.3, 1.0], "texture": ["dots", "plaid"]}
    documents = [
        {"kind": "rod_hang", "axes": {"gamma": [1, 2.5], "phi0": [-1.0, 1], "phi1": 6}},
        {
            "kind": "cloth_drag",
            "materials": {"mine": own},
            "axes": cloth | {"viewpoint": "left", "bending": [0.5, 2.0], "substrate": ["matt", "ceramic"]},
        },
        {
            "kind": "cloth_sphere",
            "materials": {"mine": own},
            "axes": cloth | {"viewpoint": "high", "angular_speed": 2.0},
        },
        {
            "kind": "cloth_on_cloth",
            "materials": {"mine": own},
            "axes": cloth | {"viewpoint": "left", "substrate_material": ["mine", "camel-ponte-roma"]},
        },
        {
            "kind": "shawl",
            "materials": {"mine": own},
            "axes": cloth | {"viewpoint": "front", "self_friction": [0.2, 0.4], "swing": [0.5, 1]},
        },
        {"kind": "shawl", "axes": cloth | {"material": "royal-target", "viewpoint": "side", "self_friction": 0.2}},
    ]
    for document in documents:
        spec = job_spec_adapter.validate_python(document)
        for sample in samples(spec, BUILDS):
            assert sample.simulation_key == simulation_key(sample.simulation, BUILDS)
            assert sample.render is not None
            assert sample.render_key == render_key(sample.render, sample.simulation_key, BUILDS)
            assert sample.split == split_of(spec, sample.labels)
            assert job_spec_adapter.validate_json(spec.model_dump_json()) == spec


def test_textures_share_light_and_simulations_do_not() -> None:
    axes = {"material": "royal-target", "mu": [0.3, 0.4], "texture": ["dots", "plaid"], "viewpoint": ["left", "right"]}
    spec = job_spec_adapter.validate_python({"kind": "cloth_drag", "axes": axes})
    lights: dict[tuple[str, str], set[int]] = {}
    for sample in samples(spec, BUILDS):
        assert isinstance(sample.render, ClothDragRender)
        place = sample.simulation_key, sample.labels["viewpoint"]
        lights.setdefault(place, set()).add(sample.render.light_seed)
    assert all(len(seeds) == 1 for seeds in lights.values())
    assert len(set().union(*lights.values())) == 4
