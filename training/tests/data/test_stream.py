"""Streams: an order by seed, dealt out to processes, that goes on where it was interrupted."""

import itertools
import json

import numpy as np
import pytest
import torch
from stickslip_training.data.samples import Samples, Stream


def slots(stream: Stream, count: int | None = None) -> list[list[int]]:
    slots_of_batches = []
    for batch in stream:
        slots_of_batches.append(batch["slot"].tolist())
        if len(slots_of_batches) == count:
            break
    return slots_of_batches


def flat(batches) -> list[int]:
    return list(itertools.chain.from_iterable(batches))


@pytest.fixture
def samples(rods):
    with Samples(rods.root, "train").reader as reader:
        yield Samples(reader, "train")


def test_an_epoch_has_every_sample_once_in_an_order_of_its_own(samples):
    stream = Stream(samples, 4, seed=5)
    first, second = slots(stream), slots(stream)
    assert stream.epoch == 2
    assert len(first) == len(stream) == -(-len(samples) // 4)
    for epoch in (first, second):
        assert sorted(flat(epoch)) == samples.slots.tolist()
    assert first != second
    assert slots(Stream(samples, 4, seed=5)) == first
    assert slots(Stream(samples, 4, seed=6)) != first
    assert flat(slots(Stream(samples, 4, shuffle=False))) == samples.slots.tolist()


@pytest.mark.parametrize("workers", [0, pytest.param(2, marks=pytest.mark.real)])
def test_a_state_goes_on_bit_for_bit(samples, workers):
    options = {"num_workers": workers} | ({"multiprocessing_context": "fork"} if workers else {})
    whole = Stream(samples, 3, seed=1, **options)
    wanted = [slots(whole), slots(whole)]
    broken = Stream(samples, 3, seed=1, **options)
    begun = slots(broken, 2)
    state = json.loads(json.dumps(broken.state_dict()))
    again = Stream(samples, 3, seed=1, **options)
    again.load_state_dict(state)
    assert begun + slots(again) == wanted[0]
    assert slots(again) == wanted[1]


def test_processes_share_the_rounds(samples):
    together = [Stream(samples, 2, seed=3, rank=rank, world_size=3) for rank in range(3)]
    parts = [slots(stream) for stream in together]
    assert {len(part) for part in parts} == {len(samples) // 6}
    rounds = [flat(batches) for batches in zip(*parts, strict=True)]
    assert len(set(flat(rounds))) == 6 * (len(samples) // 6)
    assert rounds == [batch for batch in slots(Stream(samples, 6, seed=3)) if len(batch) == 6]
    half_way = Stream(samples, 2, seed=3, rank=1, world_size=3)
    slots(half_way, 1)
    alone = Stream(samples, 6, seed=3)
    alone.load_state_dict(half_way.state_dict())
    assert slots(alone)[0] == rounds[1]


def test_batches_are_those_of_the_dataset(clips):
    dataset = Samples(clips.root, "train")
    batch = next(iter(Stream(dataset, 2, seed=0)))
    for place, slot in enumerate(batch["slot"].tolist()):
        assert torch.equal(batch["video"][place], torch.from_numpy(clips.arrays["video"][slot]))
    dataset.close()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 2}, "seed of the stream is 2, and of the state 1"),
        ({"batch_size": 2}, "round"),
        ({"shuffle": False}, "shuffle"),
    ],
)
def test_a_state_of_another_order_is_refused(samples, change, message):
    settings = {"batch_size": 3, "seed": 1}
    state = Stream(samples, **settings).state_dict()
    with pytest.raises(ValueError, match=message):
        Stream(samples, **settings | change).load_state_dict(state)


def test_a_state_of_another_dataset_is_refused(samples, clips):
    other = Stream(Samples(clips.root, "train"), 3, seed=1)
    with pytest.raises(ValueError, match="manifest of the stream"):
        other.load_state_dict(Stream(samples, 3, seed=1).state_dict())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"batch_size": 0}, "must be at least 1, and are 0 and 1"),
        ({"batch_size": 2, "rank": 2, "world_size": 2}, "rank must be from 0 to 1, and is 2"),
        ({"batch_size": 10**6, "rank": 0, "world_size": 2}, "a round is 2000000 samples"),
    ],
)
def test_numbers_that_make_no_sense_are_refused(samples, settings, message):
    with pytest.raises(ValueError, match=message):
        Stream(samples, **settings)


def test_processes_of_torch_are_known(samples, monkeypatch):
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.distributed, "get_rank", lambda: 1)
    monkeypatch.setattr(torch.distributed, "get_world_size", lambda: 2)
    stream = Stream(samples, 2)
    assert (stream.rank, stream.world_size) == (1, 2)
    assert np.array_equal(slots(stream), slots(Stream(samples, 2, rank=1, world_size=2)))
