"""Content keys: pinned, and sensitive to exactly what a result depends on."""

import json
from collections import Counter
from collections.abc import Sequence

import pytest
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.kinds.cloth_drag import ClothDragRender
from stickslip_schemas.kinds.rod_hang import RodHangRender
from stickslip_schemas.plan import points as plan
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.plan.points import KeyedPoint, keyed_points, publish_key, shards
from stickslip_schemas.spec.arrays import SPLITS
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_testing.samples import Sample, samples, split_of

BUILDS = Builds(sim_core="9" * 64, simulate="a" * 64, render="b" * 64, pack="c" * 64)


def pack_key(spec: JobSpec, shard: int, members: Sequence[KeyedPoint], builds: Builds) -> str:
    return plan.pack_key(spec, shard, [(point.key, point.split) for point in members], builds)


def single_point(
    poisson: float = 0.5,
    seed: int = 0,
    builds: Builds = BUILDS,
    name: str | None = None,
    **more: object,
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


def test_pinned_keys() -> None:
    """Keys of finished work: if one of these changes, every dataset in the world would be
    recomputed.
    """
    sample = single_point()
    assert sample.simulation_key == PINNED["simulation"]
    assert sample.split == PINNED["split"]
    assert isinstance(sample.render, RodHangRender)
    assert sample.render.color_seed == PINNED["color_seed"]
    spec = job_spec_adapter.validate_python(
        {"kind": "rod_hang", "axes": {"gamma": 100.0, "phi0": 1.0, "phi1": 6.0}}
    )
    assert spec.content_digest == PINNED["spec"]
    dragged = {
        "kind": "cloth_drag",
        "axes": {"material": "royal-target", "mu": 0.3, "texture": "dots", "viewpoint": "left"},
    }
    (cloth,) = samples(job_spec_adapter.validate_python(dragged), BUILDS)
    assert cloth.simulation_key == PINNED["cloth_simulation"]
    assert cloth.render_key == PINNED["cloth_render"]
    (through,) = samples(
        job_spec_adapter.validate_python(dragged | {"self_friction": None}), BUILDS
    )
    assert through.simulation_key == PINNED["cloth_through_itself"]


def test_simulation_depends_on_physics_and_sim_core_only() -> None:
    key = single_point().simulation_key
    assert single_point(poisson=0.3).simulation_key != key
    assert (
        single_point(builds=BUILDS.model_copy(update={"simulate": "d" * 64})).simulation_key != key
    )
    assert single_point(builds=BUILDS.model_copy(update={"render": "d" * 64})).simulation_key == key
    assert single_point(seed=1, name="x", views=None, samples_per_shard=2).simulation_key == key


def test_render_depends_on_simulation_look_and_renderer() -> None:
    key = single_point().render_key
    assert single_point(poisson=0.3).render_key != key
    assert single_point(seed=1).render_key != key
    assert single_point(quality="draft").render_key != key
    assert single_point(builds=BUILDS.model_copy(update={"render": "d" * 64})).render_key != key
    assert single_point(name="x", samples_per_shard=2).render_key == key


def test_a_name_is_no_content_and_a_build_makes_no_other_dataset() -> None:
    def spec(**more: object) -> JobSpec:
        return job_spec_adapter.validate_python(
            {"kind": "rod_hang", "axes": {"gamma": 1, "phi0": 1, "phi1": 6}, **more}
        )

    assert spec(name="a").dataset_id == spec(name="b").dataset_id
    assert spec(seed=1).dataset_id != spec().dataset_id


def test_neighbours_in_the_grid_change_no_sample() -> None:
    """Extending a grid must find the old samples again: nothing of them depends on their slot."""
    small = {"kind": "rod_hang", "axes": {"gamma": [100, 200], "phi0": 1, "phi1": 6}}
    large = {"kind": "rod_hang", "axes": {"gamma": [50, 100, 200], "phi0": [0.5, 1], "phi1": 6}}
    before = {
        sample.key: sample for sample in samples(job_spec_adapter.validate_python(small), BUILDS)
    }
    after = {
        sample.key: sample for sample in samples(job_spec_adapter.validate_python(large), BUILDS)
    }
    assert set(before) < set(after)
    assert all(after[key].split == sample.split for key, sample in before.items())


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
    """For comparison with the thesis, whose test clips very likely show simulations that were
    trained on.
    """
    spec = job_spec_adapter.validate_python(GRID)
    by_clip = job_spec_adapter.validate_python(GRID | {"splits": {"by": "clip"}})
    splits_of_clip: dict[str, set[int]] = {}
    for plain, sample in zip(samples(spec, BUILDS), samples(by_clip, BUILDS), strict=True):
        assert sample.key == plain.key
        assert sample.split == split_of(by_clip, sample.labels)
        splits_of_clip.setdefault(sample.simulation_key, set()).add(sample.split)
    assert sum(len(splits) > 1 for splits in splits_of_clip.values()) > 10


def test_renders_of_one_simulation_share_its_split() -> None:
    spec = job_spec_adapter.validate_python(GRID)
    split_of: dict[str, set[int]] = {}
    for sample in samples(spec, BUILDS):
        split_of.setdefault(sample.simulation_key, set()).add(sample.split)
    assert len(split_of) == 32
    assert all(len(splits) == 1 for splits in split_of.values())
    assert {split for splits in split_of.values() for split in splits} == {0, 1, 2}


SPLIT_SPEC = {
    "kind": "rod_hang",
    "axes": {
        "gamma": {"type": "linspace", "start": 0, "stop": 1, "num": 4000},
        "phi0": 1,
        "phi1": 6,
    },
    "splits": {"train": 0.5, "validation": 0.35, "test": 0.15},
    "views": None,
}


def test_each_split_has_its_share() -> None:
    """Code 0 is train, 1 validation and 2 test.

    Shares are within five standard deviations of 4000 draws.
    """
    drawn = Counter(
        point.split for point in keyed_points(job_spec_adapter.validate_python(SPLIT_SPEC), BUILDS)
    )
    for split, share in enumerate((0.5, 0.35, 0.15)):
        assert abs(drawn[split] / 4000 - share) < 5 * (share * (1 - share) / 4000) ** 0.5, SPLITS[
            split
        ]


@pytest.mark.parametrize("alone", SPLITS)
def test_a_share_of_one_is_everything(alone: str) -> None:
    shares = {name: float(name == alone) for name in SPLITS}
    spec = job_spec_adapter.validate_python(GRID | {"splits": shares})
    assert {SPLITS[point.split] for point in keyed_points(spec, BUILDS)} == {alone}


def test_a_larger_training_share_only_takes_samples_from_validation() -> None:
    """Validation follows train: the interval of test stays where it is."""
    wide = SPLIT_SPEC | {"splits": {"train": 0.6, "validation": 0.25, "test": 0.15}}
    moves = Counter(
        (before.split, after.split)
        for before, after in zip(
            keyed_points(job_spec_adapter.validate_python(SPLIT_SPEC), BUILDS),
            keyed_points(job_spec_adapter.validate_python(wide), BUILDS),
            strict=True,
        )
    )
    assert set(moves) == {(0, 0), (1, 1), (1, 0), (2, 2)}


def test_another_seed_draws_other_splits() -> None:
    first, second = (
        [
            point.split
            for point in keyed_points(
                job_spec_adapter.validate_python(GRID | {"seed": seed}), BUILDS
            )
        ]
        for seed in (0, 1)
    )
    assert first != second


def _rods(count: int = 5, **more: object) -> JobSpec:
    axes = {"gamma": list(range(1, count + 1)), "phi0": 1, "phi1": 6}
    return job_spec_adapter.validate_python(
        {"kind": "rod_hang", "axes": axes, "samples_per_shard": 2, **more}
    )


def test_shards_are_whole_and_have_their_keys() -> None:
    spec = _rods()
    points = tuple(keyed_points(spec, BUILDS))
    shards_of_job = list(shards(spec, BUILDS))
    assert [shard.number for shard in shards_of_job] == [0, 1, 2]
    assert [shard.points for shard in shards_of_job] == [points[:2], points[2:4], points[4:]]
    assert [shard.pack_key for shard in shards_of_job] == [
        pack_key(spec, shard.number, shard.points, BUILDS) for shard in shards_of_job
    ]


@pytest.mark.parametrize("combine", ["product", "zip"])
@pytest.mark.parametrize("first", [0, 1, 2, 3])
def test_shards_go_on_from_any_number(first: int, combine: str) -> None:
    axes = {"gamma": [1, 2, 3, 4, 5], "phi0": [1, 2, 3, 4, 5] if combine == "zip" else 1, "phi1": 6}
    if combine == "zip":
        axes["phi1"] = [6, 7, 8, 9, 10]
    spec = _rods(axes=axes, combine=combine)
    assert list(shards(spec, BUILDS, first=first)) == list(shards(spec, BUILDS))[first:]


def test_a_pack_key_holds_what_a_shard_is_made_of() -> None:
    spec = _rods(2)
    first, second = keyed_points(spec, BUILDS)
    key = pack_key(spec, 0, [first, second], BUILDS)
    other_keys = {
        "order": pack_key(spec, 0, [second, first], BUILDS),
        "number": pack_key(spec, 1, [first, second], BUILDS),
        "samples": pack_key(spec, 0, [first], BUILDS),
        "split": pack_key(spec, 0, [first._replace(split=(first.split + 1) % 3), second], BUILDS),
        "build": pack_key(spec, 0, [first, second], BUILDS.model_copy(update={"pack": "d" * 64})),
        "samples_per_shard": pack_key(_rods(2, samples_per_shard=3), 0, [first, second], BUILDS),
    }
    assert len({key, *other_keys.values()}) == 1 + len(other_keys), other_keys
    assert key == pack_key(
        spec, 0, [first, second], BUILDS.model_copy(update={"sim_core": "d" * 64})
    )


def test_a_pack_key_holds_the_codes_of_labels() -> None:
    document = {
        "kind": "cloth_drag",
        "materials": {"mine": {"density": 0.2, "young": 1e6, "poisson": 0.3, "thickness": 5e-4}},
        "axes": {"material": "royal-target", "mu": 0.3, "texture": "dots", "viewpoint": "left"},
    }
    (single_point,) = shards(job_spec_adapter.validate_python(document), BUILDS)
    (two,) = shards(job_spec_adapter.validate_python(document | {"materials": {}}), BUILDS)
    assert single_point.points == two.points
    assert single_point.pack_key != two.pack_key


def test_a_publish_key_holds_what_a_version_is_made_of() -> None:
    spec = _rods(2)
    key = publish_key(spec, ["a", "b"], BUILDS)
    other_keys = {
        "order": publish_key(spec, ["b", "a"], BUILDS),
        "shards": publish_key(spec, ["a"], BUILDS),
        "spec": publish_key(_rods(2, seed=1), ["a", "b"], BUILDS),
        "certificate": publish_key(spec, ["a", "b"], BUILDS, "c" * 64),
        "other certificate": publish_key(spec, ["a", "b"], BUILDS, "d" * 64),
        **{
            stage: publish_key(spec, ["a", "b"], BUILDS.model_copy(update={stage: "e" * 64}))
            for stage in ("sim_core", "simulate", "render", "pack")
        },
    }
    assert len({key, *other_keys.values()}) == 1 + len(other_keys), other_keys
    assert key == publish_key(_rods(2, name="x"), ["a", "b"], BUILDS)


PINNED: dict[str, object] = {
    "simulation": "0d76b7c90598207274ab9510adbb58fa2d82fef780b8da497c232a2ac9247c2a",
    "split": 0,
    "color_seed": 1423131992,
    "spec": "473d8dc6dc2024b5e3f18fbc9953dca6f325c8f53e87629de6d8277bf2b4c8db",
    "cloth_simulation": "789307b6d058b495f6cb68d128e117725f930fd1eeb607576e3139c9ab7a18e8",
    "cloth_through_itself": "cd4fa25293c36d85fe5571770462b8652db024c0f2440f95bd8cdbc7d335d872",
    "cloth_render": "a5b309ef092106b9a0a655c0601937fab842d5b74ddfce33e99e65f78f221455",
}


def test_points_are_the_samples_of_the_models() -> None:
    """The fast way over texts and the plain way over models give the same keys, for every kind and
    optional axis.
    """
    custom = {"density": 0.2, "young": 1e6, "poisson": 0.3, "thickness": 5e-4}
    cloth = {"material": ["mine", "royal-target"], "mu": [0.3, 1.0], "texture": ["dots", "plaid"]}
    looks = {"texture": ["dots", "plaid"], "viewpoint": "high"}
    documents = [
        {"kind": "rod_hang", "axes": {"gamma": [1, 2.5], "phi0": [-1.0, 1], "phi1": 6}},
        GRID | {"splits": {"by": "clip"}},
        {
            "kind": "cloth_drag",
            "materials": {"mine": custom},
            "axes": cloth
            | {"viewpoint": "left", "bending": [0.5, 2.0], "substrate": ["matt", "ceramic"]},
        },
        {
            "kind": "cloth_scene",
            "scene": "turning-ball",
            "axes": looks | {"speed": 2.0, "mu": [0.3, 1.0]},
        },
        {
            "kind": "cloth_scene",
            "scene": "on-cloth",
            "set": {"materials": {"mine": custom}},
            "axes": looks | {"mu": 0.3, "stretched_fabric": ["mine", "camel-ponte-roma"]},
        },
        {
            "kind": "cloth_scene",
            "scene": "shawl",
            "axes": looks | {"self_friction": [0.2, 0.4], "swing": [0.5, 1.0]},
        },
    ]
    for document in documents:
        spec = job_spec_adapter.validate_python(document)
        for slot, (point, sample) in enumerate(
            zip(keyed_points(spec, BUILDS), samples(spec, BUILDS), strict=True)
        ):
            assert point.slot == sample.slot == slot
            assert point.labels == sample.labels
            assert json.loads(point.labels_text) == sample.labels
            assert json.loads(point.simulation_text) == sample.simulation.model_dump(mode="json")
            assert point.simulation_key == sample.simulation_key
            assert sample.render is not None
            assert point.render_text is not None
            assert json.loads(point.render_text) == sample.render.model_dump(mode="json")
            assert point.render_key == sample.render_key
            assert point.split == sample.split
            assert job_spec_adapter.validate_json(spec.model_dump_json()) == spec


def test_textures_share_light_and_simulations_do_not() -> None:
    axes = {
        "material": "royal-target",
        "mu": [0.3, 0.4],
        "texture": ["dots", "plaid"],
        "viewpoint": ["left", "right"],
    }
    spec = job_spec_adapter.validate_python({"kind": "cloth_drag", "axes": axes})
    lights: dict[tuple[str, str], set[int]] = {}
    for sample in samples(spec, BUILDS):
        assert isinstance(sample.render, ClothDragRender)
        place = sample.simulation_key, sample.labels["viewpoint"]
        lights.setdefault(place, set()).add(sample.render.light_seed)
    assert all(len(seeds) == 1 for seeds in lights.values())
    assert len(set().union(*lights.values())) == 4
