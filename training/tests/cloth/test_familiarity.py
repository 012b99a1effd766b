from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from stickslip_training.cloth.clips import INSTANTS, render_clips
from stickslip_training.cloth.familiarity import (
    ALARMS,
    UNKNOWN,
    Familiarity,
    hanging,
    holders_at,
    pooled,
    reordered,
)
from stickslip_training.cloth.model import load_friction

pytestmark = pytest.mark.physics  # pictures are rendered


@pytest.fixture(scope="module")
def few(runs):
    chosen = runs[np.arange(0, 99, 5)]
    frames = [chosen.instants.index(instant) for instant in INSTANTS]
    return type(chosen)(
        chosen.positions[:, frames],
        INSTANTS,
        chosen.materials,
        chosen.material,
        chosen.mu,
        chosen.landed,
    )


def silhouettes(clips):
    return pooled(clips.cover).numpy()


@pytest.mark.slow
def test_a_twentieth_of_the_good_and_nearly_all_others_have_no_answer(few, split_runs):
    train, judged, _ = split_runs(few, 0.3, 0.0)
    good = silhouettes(render_clips(judged, 8, 1, with_surroundings=True))
    known = Familiarity.of(train, 2, good)
    share, reasons = known.judge(good)
    assert ((share >= 0) & (share <= 1)).all()
    assert np.mean([reason is not None for reason in reasons]) == pytest.approx(ALARMS, abs=0.03)
    held = holders_at(INSTANTS)
    for foreign, reason in (
        (hanging, "never touches the floor"),
        (partial(reordered, frames=[2, 3, 0, 1, 2, 3]), "moves out of phase"),
    ):
        clips = render_clips(
            replace(judged, positions=foreign(judged.positions, held)), 4, 3, with_surroundings=True
        )
        answers = known.judge(silhouettes(clips))[1]
        assert np.mean([each == reason for each in answers]) > 0.8
    noise = np.random.default_rng(0).random((3, 6, 18, 22), dtype=np.float32)
    assert known.judge(noise)[0].tolist() == [0.0] * 3


def test_the_weights_of_the_package_know_dragged_cloth_and_refuse_what_is_none(few):
    model = load_friction()
    judged = few.named(model.materials)
    clips = render_clips(judged, 2, 5)
    assert np.mean([reason is None for reason in model.judge(clips)[1]]) > 0.9
    empty = render_clips(
        replace(judged, positions=judged.positions - np.float32([0, 0, 9])),
        1,
        6,
        with_surroundings=True,
    )
    assert all(model.judge(empty)[1])
    assert UNKNOWN.startswith("looks like no square of cloth")
