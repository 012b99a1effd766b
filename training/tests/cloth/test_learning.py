"""A network learns friction and material from clips, and is judged on simulations that it has not seen."""

import pytest
from stickslip_training.cloth.clips import render_clips
from stickslip_training.cloth.evaluation import predictions, score_predictions
from stickslip_training.cloth.learner import ClothTraining, train_friction


@pytest.mark.slow
@pytest.mark.timeout(1800)  # three minutes of CPU time, on machines that may have a lot else to do
def test_friction_of_unseen_simulations_is_learned_from_clips(runs, split_runs):
    train, validation, test = split_runs(runs, 0.1, 0.22)
    assert 65 <= len(train) <= 70
    model = train_friction(train, validation, ClothTraining(steps=900, worlds=False, repeats=1, dropout=0.1, epoch=150))
    clips = render_clips(test, 6, 99)
    slots = range(len(clips))
    told = predictions(model.estimate(clips), slots, ([1.0] * len(clips), [None] * len(clips)))
    scores = score_predictions(told, model.materials, slots, clips)
    assert scores.blind.simulations >= 20
    assert scores.blind.mae.value <= 0.13
    assert scores.blind.within_02.value >= 0.75
    assert scores.top_1.value >= 0.7
