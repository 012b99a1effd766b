import json
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
from stickslip_training.cloth.calibration import covering_temperature, likeliest_temperatures
from stickslip_training.cloth.clips import (
    INSTANTS,
    Clips,
    RenderedClips,
    clips_of_file,
    jittered,
    render_clips,
    training_clips,
)
from stickslip_training.cloth.familiarity import Familiarity
from stickslip_training.cloth.learner import ClothTraining, FrictionLearner, train_friction
from stickslip_training.cloth.model import WEIGHTS, load_friction, mean_model, save_friction
from stickslip_training.cloth.posterior import MU_BINS

SMALL = ClothTraining(steps=6, epoch=6, batch_size=2, width=48)


@pytest.fixture(scope="module")
def few(runs, split_runs):
    train, validation, test = split_runs(runs, 0.12, 0.25)
    return train[np.arange(9)], validation[np.arange(2)], test[np.arange(2)]


@pytest.fixture(scope="module")
def first(few):
    """A model to go on from; nothing may change it."""
    return train_friction(*few[:2], SMALL)


def weights(model):
    return model.net.state_dict()


def equal(first, second):
    return all(torch.equal(value, weights(second)[name]) for name, value in weights(first).items())


@pytest.fixture
def unfamiliar(monkeypatch):
    """Models learn no silhouettes: that takes more than half of a training of few steps."""
    monkeypatch.setattr(Familiarity, "of", lambda *_: None)


@pytest.mark.physics
def test_resume_equals_uninterrupted_to_the_bit_and_another_seed_does_not(
    few, unfamiliar, tmp_path, monkeypatch
):
    from stickslip_training.engine import fit as engine

    straight = train_friction(*few[:2], replace(SMALL, epoch=2))
    loss = FrictionLearner.loss

    def killed(learner, net, step):
        if step == 3:
            raise KeyboardInterrupt
        return loss(learner, net, step)

    with monkeypatch.context() as patch:
        patch.setattr(engine, "_CHECKPOINT_SECONDS", 0.0)  # after every step
        patch.setattr(FrictionLearner, "loss", killed)
        with pytest.raises(KeyboardInterrupt):
            train_friction(*few[:2], replace(SMALL, epoch=2), out=tmp_path)
    resumed = train_friction(*few[:2], replace(SMALL, epoch=2), out=tmp_path, resume=True)
    assert equal(straight, resumed)
    assert straight.temperature == resumed.temperature
    assert not equal(straight, train_friction(*few[:2], replace(SMALL, seed=1, epoch=2)))


@pytest.mark.physics
def test_saved_and_loaded(few, first, tmp_path):
    model = first
    save_friction(tmp_path / "friction.safetensors", model)
    again = load_friction(tmp_path / "friction.safetensors")
    clips = render_clips(few[2], 2, 0)
    assert np.array_equal(again.estimate(clips).joint, model.estimate(clips).joint)
    assert again.judge(clips)[1] == model.judge(clips)[1]
    assert np.array_equal(again.judge(clips)[0], model.judge(clips)[0])
    assert again.card["training_runs"] == 9
    assert (again.materials, again.instants) == (model.materials, model.instants)


def test_the_weights_of_the_package_load_and_say_what_they_are():
    model = load_friction()
    assert len(model.materials) == 10
    assert WEIGHTS.stat().st_size < 6e6
    assert set(model.card) >= {"settings", "runs", "made_from", "certificate", "tested", "limits"}


def test_a_clip_and_its_mirror_image_have_the_same_answer(few):
    model, clips = load_friction(), render_clips(few[2], 1, 0)
    direction = clips.direction * torch.tensor([1.0, -1.0, 1.0])
    mirrored = model.estimate(replace(clips, crops=clips.crops.flip(3), direction=direction))
    np.testing.assert_allclose(mirrored.joint, model.estimate(clips).joint, atol=1e-6)
    turned = model.estimate(replace(clips, direction=direction))
    assert np.abs(turned.joint - mirrored.joint).max() > 1e-3


def test_what_is_no_model_is_refused(tmp_path):
    (tmp_path / "none.safetensors").write_bytes(b"no")
    with pytest.raises(ValueError, match="must be a model of `stickslip-train cloth train`"):
        load_friction(tmp_path / "none.safetensors")


@pytest.mark.physics
def test_every_render_has_a_look_of_its_own_and_the_seed_repeats_it(few):
    clips = render_clips(few[2], 2, 3)
    assert torch.equal(clips.crops, render_clips(few[2], 2, 3).crops)
    assert not torch.equal(clips.crops[0], clips.crops[1])
    assert clips.run.tolist() == [0, 0, 1, 1]
    assert clips.mu.tolist() == np.repeat(few[2].mu, 2).tolist()


def test_temperatures_mend_what_is_too_sure():
    generator = np.random.default_rng(0)
    truth = generator.uniform(0.3, 1.3, 2000)
    measured = truth + generator.normal(0, 0.1, 2000)
    log = (
        -0.5 * ((MU_BINS.centers - measured[:, None]) / 0.05) ** 2
    )  # as if the deviation was 0.05: temperature (0.1/0.05)^2
    mu = np.repeat(log[:, None], 2, axis=1).astype(np.float32)
    material = np.tile(
        np.float32([0.0, np.log(4.0)]), (2000, 1)
    )  # 80 %, and it is so in 80 % of the cases
    code = (np.arange(2000) % 5 > 0).astype(int)
    temperatures = likeliest_temperatures(material, mu, code, truth, MU_BINS)
    assert temperatures[0] == pytest.approx(1.0, abs=0.1)
    assert temperatures[1] == pytest.approx(4.0, rel=0.1)


def test_intervals_of_a_network_that_is_twice_too_sure_become_twice_as_wide():
    random = np.random.default_rng(0)
    mu = random.uniform(0.5, 1.1, 500)
    answered = mu + random.normal(0.0, 0.1, 500)
    log_mu = (-0.5 * ((MU_BINS.centers - answered[:, None]) / 0.05) ** 2)[:, None]
    # A Gaussian histogram at temperature T is sqrt(T) as wide.
    temperature = covering_temperature(np.zeros((500, 1), np.float32), log_mu, mu, MU_BINS, 1.0)
    assert temperature == pytest.approx(4.0, rel=0.15)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 0}, "steps must be more than 0 and finite, and is 0"),
        ({"repeats": 0}, "repeats must be more than 0 and finite, and is 0"),
        ({"dropout": 1.0}, "dropout must be from 0 to less than 1, and is 1.0"),
        ({"width": 50}, "width must be a multiple of 48, and is 50"),
        ({"turn": -1.0}, "turn must be 0 or more and finite, and is -1"),
        ({"device": "toaster"}, "device must be one that torch can use here"),
    ],
)
def test_settings_are_checked(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(SMALL, **changes)


def test_runs_to_validate_are_needed(few):
    with pytest.raises(ValueError, match="there must be runs to train on and to validate: 9 and 0"):
        train_friction(few[0], few[1][np.arange(0)], SMALL)


def some_clips(few, renders=2):
    train, validation = (render_clips(part, renders, 5) for part in few[:2])
    return RenderedClips(train, replace(validation, run=validation.run + 100))


@pytest.mark.physics
def test_training_goes_on_from_a_model_with_clips_of_another_renderer(few, first, unfamiliar):
    going = replace(SMALL, steps=4, epoch=2, learning_rate=1e-4)
    clips = some_clips(few)
    model = train_friction(*few[:2], going, clips=clips, start=first)
    assert model.card["training_clips"] == len(clips.train) == 18
    assert equal(model, train_friction(*few[:2], going, clips=clips, start=first))
    # It went on: weights are nearer to those of the model than to those of another start.
    fresh = train_friction(*few[:2], going, clips=clips)

    def distance(a, b):
        return sum(
            float((weights(a)[name] - value).norm())
            for name, value in weights(b).items()
            if value.ndim > 1
        )

    assert 0.0 < distance(model, first) < 0.2 * distance(fresh, first)


@pytest.mark.physics
def test_half_of_each_batch_is_of_the_clips(few):
    clips = some_clips(few)
    known = replace(clips.train, mu=np.full(18, 9.0))
    learner = FrictionLearner(
        *few[:2], replace(SMALL, batch_size=16), RenderedClips(known, clips.validation)
    )
    crops, direction, material, mu, _ = learner.batch(0)
    assert len(crops) == len(direction) == len(material) == 16
    assert (mu == 9.0).tolist() == [False] * 8 + [True] * 8


@pytest.mark.physics
def test_a_step_learns_from_the_last_batches_and_half_of_their_clips_are_mirrored(few, first):
    learner = FrictionLearner(*few[:2], replace(SMALL, batch_size=16, repeats=2), start=first)
    drawn = [learner.batch(number) for number in range(3)]
    for step, count in ((0, 1), (1, 1), (2, 2), (5, 3)):
        known = [torch.cat(column) for column in zip(*drawn[:count], strict=True)]
        plain = mirrored = 0
        for crops, direction, material, mu, clip_number in zip(*learner.sample(step), strict=True):
            place = (known[3] == mu).nonzero().flatten().tolist()
            same = [k for k in place if torch.equal(known[0][k], crops)]
            other = [k for k in place if torch.equal(known[0][k].flip(2), crops)]
            assert len(same) + len(other) == 1
            k = (same + other)[0]
            plain, mirrored = plain + len(same), mirrored + len(other)
            assert torch.equal(known[4][k] if same else known[4][k].flip(2), clip_number)
            assert material == known[2][k]
            assert torch.equal(
                direction, known[1][k] * torch.tensor([1.0, 1.0 if same else -1.0, 1.0])
            )
        assert min(plain, mirrored) >= 2


@pytest.mark.physics
def test_the_silhouettes_of_a_start_stay_and_its_reader_learns(few, first, unfamiliar):
    model = train_friction(*few[:2], replace(SMALL, seed=3), start=first)
    for name, tensor in weights(first).items():
        if name.startswith("silhouette.") or name in ("mu.weight", "encoder.0.weight"):
            assert torch.equal(tensor, weights(model)[name]) == name.startswith("silhouette.")


@pytest.mark.physics
def test_jittered_crops_are_those_of_another_exposure():
    crops = torch.rand(4, 6, 72, 88, generator=torch.Generator().manual_seed(0))
    other = jittered(crops, torch.Generator().manual_seed(1))
    assert torch.equal(other, jittered(crops, torch.Generator().manual_seed(1)))
    for clip, changed in zip(crops, other, strict=True):
        shifts = [torch.roll(clip, (y, x), (1, 2)) for y in (-1, 0, 1) for x in (-1, 0, 1)]
        likeness = max(
            float(torch.corrcoef(torch.stack([s.flatten(), changed.flatten()]))[0, 1])
            for s in shifts
        )
        assert 0.95 < likeness < 1.0


@pytest.mark.physics
def test_clips_of_one_simulation_in_both_splits_are_refused(few):
    clips = render_clips(few[0], 1, 0)
    with pytest.raises(ValueError, match="clips of one simulation must not be in both splits"):
        RenderedClips(clips, clips)
    with pytest.raises(
        ValueError,
        match="the clips for validation must be some, and of materials of the runs: 0 clips",
    ):
        RenderedClips(clips, clips[np.arange(0)])


@pytest.mark.physics
def test_a_model_of_another_size_is_no_start(few, first):
    with pytest.raises(
        ValueError, match="the model to start from must know the runs' materials, and be"
    ):
        train_friction(*few[:2], replace(SMALL, width=96), start=first)


def file_of_clips(path, clips_of_file):
    video = np.random.default_rng(0).integers(
        0, 255, (len(clips_of_file), 6, 224, 224, 3), dtype=np.uint8
    )
    classes = np.random.default_rng(1).integers(0, 4, video.shape[:-1], dtype=np.uint8)
    about = [
        {
            "run": 5,
            "material": clips_of_file.materials[code],
            "mu": mu,
            "landed_side": 1,
            "viewpoint": "calibrated",
        }
        for code, mu in zip(clips_of_file.material.tolist(), clips_of_file.mu.tolist(), strict=True)
    ]
    np.savez(
        path,
        video=video,
        segmentation=classes,
        instants=np.array(INSTANTS),
        about=[json.dumps(clip) for clip in about],
    )


def test_clips_of_files_are_parted_by_simulation_and_those_of_others_are_refused(few, tmp_path):
    train, validation, test = few
    file_of_clips(tmp_path / "a.npz", train[np.array([3, 0])])
    file_of_clips(tmp_path / "b.npz", validation[np.array([1])])
    alone, about = clips_of_file(tmp_path / "a.npz", train.materials)
    assert alone.crops.shape == (2, 6, 72, 88)
    assert alone.run.tolist() == [clip["run"] for clip in about] == [5, 5]
    digests, clips = training_clips(
        [str(tmp_path / name) for name in ("a.npz", "b.npz")], train, validation
    )
    assert len(set(digests)) == 2
    assert clips.train.run.tolist() == [3, 0]
    assert clips.train.mu.tolist() == train.mu[[3, 0]].tolist()
    assert torch.equal(clips.train.crops, alone.crops)
    assert clips.validation.run.tolist() == [len(train) + 1]
    file_of_clips(tmp_path / "c.npz", test)
    with pytest.raises(
        ValueError, match="clips must show simulations to train on or to validate: 2 of 2 do not"
    ):
        training_clips([str(tmp_path / "c.npz")], train, validation)
    assert len(Clips.joined([alone, alone[np.array([1])]])) == 3


@pytest.mark.physics
def test_several_starts_give_their_mean(first):
    other = replace(first, net=deepcopy(first.net))
    with torch.no_grad():
        for parameter in other.net.parameters():
            parameter += 1.0
    for name, tensor in weights(mean_model([first, other])).items():
        torch.testing.assert_close(tensor, weights(first)[name] + 0.5)
    with pytest.raises(ValueError, match="the models to start from must know the same materials"):
        mean_model([first, replace(first, materials=first.materials[:1])])
