import multiprocessing
import pickle

import numpy as np
import pytest
import torch
from stickslip_schemas.base import sha256
from stickslip_schemas.format.selection import SELECTION_NAME, PartDocument, Selection
from stickslip_training.data.reader import DatasetReader
from stickslip_training.data.samples import Item, Samples, collate
from torch.utils.data import DataLoader


def test_a_rod(rods):
    dataset = Samples(rods.root, "train")
    assert len(dataset) == rods.manifest.split_counts["train"]
    item = dataset[3]
    slot = int(item["slot"])
    assert slot == dataset.slots[3]
    assert {name: (value.dtype, tuple(value.shape)) for name, value in item.items()} == {
        "centerline": (torch.float32, (150, 3)),
        "curvature": (torch.float32, (150, 3)),
        "frame": (torch.float32, (150, 3, 3)),
        **dict.fromkeys(
            ("gamma", "phi0", "phi1", "energy", "self_contact_distance", "reach"),
            (torch.float32, ()),
        ),
        "multistable": (torch.int64, ()),
        "slot": (torch.int64, ()),
        "sample_key": (torch.uint8, (32,)),
    }
    for name in ("centerline", "curvature", "gamma", "phi0", "phi1", "sample_key"):
        assert np.array_equal(
            item[name].numpy(), rods.arrays[name][slot].astype(item[name].numpy().dtype)
        )


def test_a_split_without_samples_is_refused(seen_rods, tmp_path):
    part = seen_rods.copy(tmp_path / "part")
    manifest = sha256((part.root / "manifest.json").read_bytes())
    document = PartDocument(manifest=manifest, selection=Selection(split="train"))
    (part.root / SELECTION_NAME).write_text(document.model_dump_json())
    assert len(Samples(part.root, "train")) == seen_rods.manifest.split_counts["train"]
    with pytest.raises(ValueError, match=r"the split test of .*part has no valid sample"):
        Samples(part.root, "test")


def test_a_rod_with_views_and_frame(seen_rods):
    item = Samples(seen_rods.root, arrays=["views", "frame"], labels=["color"])[2]
    assert item["slot"] == 3  # 2 is rejected
    assert np.array_equal(item["views"].numpy(), seen_rods.arrays["views"][3])
    assert np.array_equal(item["color"].numpy(), seen_rods.arrays["color"][3])
    assert np.array_equal(item["frame"].numpy(), seen_rods.arrays["frame"][3])
    assert set(item) == {"views", "frame", "color", "slot", "sample_key"}


def test_a_clip(clips):
    dataset = Samples(clips.root)
    assert [int(item["slot"]) for item in dataset] == [
        slot for slot in range(12) if slot not in (3, 9)
    ]
    item = dataset[8]
    assert item["video"].shape == (2, 224, 224, 3)
    assert np.array_equal(item["video"].numpy(), clips.arrays["video"][10])
    assert isinstance(item, Item)
    assert [item.name(label) for label in ("material", "texture", "viewpoint")] == [
        "camel-ponte-roma",
        "plaid",
        "left",
    ]
    assert dataset.categories["material"][item["material"]] == "camel-ponte-roma"
    with pytest.raises(
        ValueError, match=r"label must be one of texture, viewpoint, .*material.*, and is mu"
    ):
        item.name("mu")
    assert item["mu"] == np.float32(0.4)
    assert item["landed_side"] == clips.arrays["landed_side"][10]
    assert "positions" not in item


def test_a_clip_with_its_mesh(clips):
    dataset = Samples(clips.root, arrays=["video", "positions"])
    assert np.array_equal(dataset[8]["positions"].numpy(), clips.arrays["positions"][10])
    batch = dataset.__getitems__([8, 0, 3])
    assert batch["positions"].shape == (3, 300, 25, 3)
    assert np.array_equal(
        batch["positions"].numpy(), clips.arrays["positions"][dataset.slots[[8, 0, 3]]]
    )


def test_a_dataset_without_meshes_says_so(make_clips):
    version = make_clips(store_positions=False)
    assert Samples(version.root)[1]["video"].shape == (2, 224, 224, 3)
    with pytest.raises(ValueError, match="the dataset has no array positions; it has video"):
        Samples(version.root, arrays=["video", "positions"])


def test_a_batch_is_its_items(clips):
    dataset = Samples(DatasetReader(clips.root), "train")
    indices = [2, 0, 1]
    batch = dataset.__getitems__(indices)
    for place, index in enumerate(indices):
        for name, value in dataset[index].items():
            assert torch.equal(batch[name][place], value)
        assert batch.names("material")[place] == dataset[index].name("material")


def test_by_default_a_clip_has_its_video_and_all_scalar_labels(clips):
    dataset = Samples(clips.root)
    assert set(dataset[0]) >= {"video", "mu", "bias_side", "landed_side", "kernel"}
    assert not set(dataset[0]) & {
        "positions",
        "contact_force",
        "bending_rigidity",
        "valid",
        "split",
    }


def test_what_does_not_fit_is_refused(clips, rods):
    with pytest.raises(ValueError, match="the dataset has no array views; it has centerline"):
        Samples(rods.root, arrays=["views"])
    with pytest.raises(ValueError, match="ring must be"):
        Samples(clips.root, ring=-1)


def test_a_loader_without_our_collate_says_what_to_do(clips):
    with pytest.raises(TypeError, match="collate_fn=collate"):
        next(iter(DataLoader(Samples(clips.root), batch_size=2)))


def test_a_batch_of_a_ring_is_valid_until_ring_further_batches_are_drawn(clips):
    dataset = Samples(clips.root, ring=3)
    drawn = iter(dataset.loader(2))
    first = next(drawn)
    content = first["video"].clone()
    next(drawn), next(drawn)
    assert torch.equal(first["video"], content)
    again = next(drawn)
    assert again["video"].data_ptr() == first["video"].data_ptr()
    assert not torch.equal(first["video"], content)


def test_without_a_ring_every_batch_has_its_own_memory(clips):
    batches = list(Samples(clips.root).loader(2))
    assert len({batch["video"].data_ptr() for batch in batches}) == len(batches) == 5


def test_a_ring_takes_batches_of_any_size(clips):
    dataset = Samples(clips.root, ring=1)
    for indices in ([0, 1], [2, 3, 4], [5]):
        batch = dataset.__getitems__(indices)
        assert np.array_equal(batch["video"].numpy(), clips.arrays["video"][dataset.slots[indices]])


@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.real
def test_workers_read_what_one_process_reads(clips, method):
    dataset = Samples(clips.root, ring=2)
    dataset.__getitems__([0])  # used in the parent first
    context = multiprocessing.get_context(method)
    loader = dataset.loader(3, shuffle=True, num_workers=2, multiprocessing_context=context)
    batches = list(loader)  # all of them kept: the ring does not reach into workers
    slots = torch.cat([batch["slot"] for batch in batches])
    videos = torch.cat([batch["video"] for batch in batches])
    assert sorted(slots.tolist()) == dataset.slots.tolist()
    assert np.array_equal(videos.numpy(), clips.arrays["video"][slots.numpy()])


def test_an_error_in_a_worker_arrives_as_itself(clips, tmp_path):
    from stickslip_training.data.sources import MissingFileError

    version = clips.copy(tmp_path / "v1")
    dataset = Samples(version.root)
    (version.root / "video/c/1/0/0/0/0").unlink()
    with pytest.raises(MissingFileError, match="is not there, and the manifest says it is"):
        list(dataset.loader(12, num_workers=1))  # one batch: none is left behind in a queue


def test_pickles_without_its_buffers(clips):
    dataset = Samples(clips.root, ring=1)
    dataset.__getitems__([0, 1, 2])
    data = pickle.dumps(dataset)
    assert len(data) < 50_000
    assert torch.equal(pickle.loads(data)[4]["video"], dataset[4]["video"])


def test_collate_copies_nothing(clips):
    batch = Samples(clips.root).__getitems__([0])
    assert collate(batch) is batch
