"""A network learns friction and material from clips, and is judged on simulations that it has not
seen.
"""

import pytest
from stickslip_training.cloth.clips import render_clips
from stickslip_training.cloth.evaluation import predictions, score_predictions
from stickslip_training.cloth.learner import ClothTraining, train_friction

QUICK = ClothTraining(
    steps=840,
    epoch=210,
    worlds=False,
    width=48,
    repeats=4,
    dropout=0.0,
    learning_rate=3e-3,
    smoothing=(0.2, 0.05),
)
"""For few simulations over dark floors, in a minute of CPU time."""


@pytest.mark.slow
@pytest.mark.timeout(1800)  # on machines that may have a lot else to do
def test_friction_of_unseen_simulations_is_learned_from_clips(runs, split_runs):
    train, validation, test = split_runs(runs, 0.1, 0.22)
    assert 65 <= len(train) <= 70
    model = train_friction(train, validation, QUICK)
    clips = render_clips(test, 6, 99)
    slots = range(len(clips))
    predicted = predictions(model.estimate(clips), slots, ([1.0] * len(clips), [None] * len(clips)))
    scores = score_predictions(predicted, model.materials, slots, clips)
    assert scores.blind.simulations >= 20
    assert scores.blind.mae.value <= 0.075
    assert scores.blind.within_02.value >= 0.9
    assert scores.top_1.value >= 0.85
