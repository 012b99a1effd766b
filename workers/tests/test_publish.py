"""Publish: every reader gives back what went in, and a version is never half there."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tensorstore
import xarray
import zarr
from PIL import Image
from publishing import changed
from stickslip_schemas.base import sha256
from stickslip_schemas.format.manifest import Contents, Manifest, Pictures, check_seal
from stickslip_schemas.spec.jobs import Quality
from stickslip_schemas.store import DirectoryStore
from stickslip_workers.stages.publish import publish

Make = Callable[..., Any]


def _tree(directory: Path) -> dict[str, bytes]:
    return {
        path.relative_to(directory).as_posix(): path.read_bytes()
        for path in directory.rglob("*")
        if path.is_file()
    }


def _assert_same(got: np.ndarray[Any, Any], expected: np.ndarray[Any, Any], name: str) -> None:
    assert got.dtype == expected.dtype, name
    assert got.shape == expected.shape, name
    assert got.tobytes() == expected.tobytes(), name


@pytest.mark.parametrize(
    "shape",
    [
        {"count": 7, "per_shard": 4, "rejected": (2,)},  # the last shard is partial
        {"count": 8, "per_shard": 4, "rejected": (4, 5, 6, 7)},  # a shard without a valid sample
        {"count": 2, "per_shard": 64, "rejected": ()},  # fewer samples than one shard holds
        {"count": 5, "per_shard": 2, "rejected": (), "views": False},
    ],
)
def test_three_readers_give_back_what_went_in(make_dataset: Make, shape: dict[str, Any]) -> None:
    packed = make_dataset(**shape)
    directory = packed.publish()
    group = zarr.open_group(directory, mode="r")
    assert group.attrs["spec_digest"] == packed.spec.content_digest
    with xarray.open_zarr(directory, chunks=None, mask_and_scale=False) as dataset:
        assert set(dataset.variables) == set(packed.arrays)
        for name, expected in packed.arrays.items():
            _assert_same(group[name][...], expected, name)
            _assert_same(dataset[name].values, expected, name)
            spec = {
                "driver": "zarr3",
                "kvstore": {"driver": "file", "path": f"{directory / name}/"},
            }
            _assert_same(tensorstore.open(spec, read=True).result().read().result(), expected, name)
    assert dataset["frame"].dims == ("sample", "point", "xyz", "director")
    assert group["split"].attrs["categories"] == ["train", "validation", "test"]


def test_a_version_of_many_samples_has_sections(
    make_dataset: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same version with and without sections: other lists, and the same files."""
    packed = make_dataset(count=7, per_shard=2, rejected=(2, 5))
    whole = _tree(packed.publish())
    monkeypatch.setattr("stickslip_schemas.format.manifest.SECTION_SAMPLES", 5)
    directory = packed.publish()
    tree = _tree(directory)
    names = ["manifest/0.json", "manifest/1.json"]
    assert tree.keys() - whole.keys() == set(names)
    changed_names = {name for name in whole if tree[name] != whole[name]}
    assert changed_names == {"manifest.json", "manifest.sha256", "zarr.json", "README.md"}
    check_seal(*(tree[name] for name in ("manifest.json", "zarr.json", "manifest.sha256")))
    manifest = Manifest.model_validate_json(tree["manifest.json"])
    assert [file.path for file in manifest.sections] == names
    assert (manifest.sample_keys, manifest.rejections) == ((), ())
    assert manifest.rejection_counts == {"out_of_frame": 2}
    contents = Contents(manifest, lambda file: tree[file.path])
    assert [(section.first, section.end) for section in contents.sections()] == [(0, 4), (4, 7)]
    assert tuple(contents.sample_keys()) == packed.sample_keys
    assert tuple(contents.rejections()) == packed.rejections
    listed = {file.path: (file.sha256, file.size) for file in contents.files()}
    further = tree.keys() - {"manifest.json", "zarr.json", "manifest.sha256"}
    assert listed == {path: (sha256(tree[path]), len(tree[path])) for path in further}
    for path in further:
        entry = contents.file(path)
        assert entry is not None
        assert entry.sha256 == sha256(tree[path])
    assert contents.file("views/c/4/0/0/0/0") is None
    assert not {path for path in listed if path.startswith("views/c")} & {
        file.path for file in manifest.files
    }


def test_labels_have_large_chunks(make_dataset: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stickslip_schemas.spec.arrays.LABEL_SAMPLES", 3)
    packed = make_dataset(count=7, per_shard=2, rejected=(2,))
    directory = packed.publish()
    assert sorted(path.name for path in (directory / "gamma/c").iterdir()) == ["0", "1", "2"]
    group = zarr.open_group(directory, mode="r")
    assert group["gamma"].chunks == (3,)
    assert group["centerline"].chunks[0] == 2
    for name, expected in packed.arrays.items():
        _assert_same(group[name][...], expected, name)


def test_manifest_says_everything(make_dataset: Make) -> None:
    packed = make_dataset()
    directory = packed.publish()
    tree = _tree(directory)
    manifest = Manifest.model_validate_json(tree.pop("manifest.json"))
    digest = check_seal(
        directory.joinpath("manifest.json").read_bytes(),
        tree.pop("zarr.json"),
        tree["manifest.sha256"],
    )
    assert tree.pop("manifest.sha256").startswith(f"{digest}  manifest.json\n".encode())
    assert {file.path: (file.sha256, file.size) for file in manifest.files} == {
        path: (sha256(data), len(data)) for path, data in tree.items()
    }
    assert manifest.rejections == packed.rejections
    assert manifest.valid_count == 6
    assert sum(manifest.split_counts.values()) == 6
    assert [camera.name for camera in manifest.cameras]
    assert manifest.acceptance_rate == pytest.approx(6 / 7)
    assert manifest.pictures == Pictures(quality=Quality.standard, psnr={})
    with Image.open(directory / "preview.webp") as picture:
        assert (picture.format, picture.n_frames) == ("WEBP", 1)


def test_what_is_not_rendered_has_no_picture(make_dataset: Make) -> None:
    packed = make_dataset(views=False)
    directory = packed.publish()
    assert not (directory / "preview.webp").exists()
    assert Manifest.model_validate_json((directory / "manifest.json").read_bytes()).pictures is None


def test_publishing_again_and_after_a_crash_gives_the_same(
    make_dataset: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    packed = make_dataset()
    task = packed.publish_task
    directory = packed.store.dataset_path(task.dataset, 1)

    class Killed(BaseException):
        """Not an Exception: nothing on the way may catch it, as nothing catches SIGKILL."""

    links = 0
    link = DirectoryStore.show

    def dying_link(self: DirectoryStore, *arguments: Any) -> None:
        nonlocal links
        links += 1
        if links == 10:
            raise Killed
        link(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(DirectoryStore, "show", dying_link)
        with pytest.raises(Killed):
            publish(task, packed.store)
    assert not (directory / "manifest.json").exists()
    first = publish(task, packed.store)
    tree = _tree(directory)
    assert publish(task, packed.store) == first
    assert _tree(directory) == tree
    assert first.bytes == sum(map(len, tree.values()))
    assert not [path for path in tree if path.endswith(".tmp")]


def test_a_version_that_lacks_something_is_refused(make_dataset: Make) -> None:
    packed = make_dataset()
    task = packed.publish_task
    with pytest.raises(ValueError, match=r"files must be those of 2 shards.*'"):
        publish(changed(task, packed.store, files=tuple(packed.files[1:])), packed.store)
    with pytest.raises(ValueError, match="files must be those of 2 shards"):
        publish(changed(task, packed.store, labels=(packed.packed[0].labels,)), packed.store)
    with pytest.raises(ValueError, match="one path twice"):
        publish(changed(task, packed.store, files=(*packed.files, packed.files[0])), packed.store)
    with pytest.raises(ValueError, match="rejections must be the slots that are not valid"):
        publish(changed(task, packed.store, rejections=()), packed.store)
    longer = packed.files[0].model_copy(update={"size": packed.files[0].size + 1})
    with pytest.raises(OSError, match=rf"must have {longer.size} bytes"):
        publish(changed(task, packed.store, files=(longer, *packed.files[1:])), packed.store)
    with pytest.raises(
        ValueError, match=r"sections must have the samples 0 to 6, and they end at \[0, 6\]"
    ):
        publish(changed(task, packed.store, sample_keys=packed.sample_keys[:6]), packed.store)
    with pytest.raises(ValueError, match="dataset must be the id of its spec"):
        publish(task.model_copy(update={"dataset": "../elsewhere"}), packed.store)
    packed.store.path(packed.files[0].sha256).write_bytes(b"cut")
    with pytest.raises(OSError, match=r"must have .* bytes and the digest that names it"):
        publish(task, packed.store)
    packed.store.path(packed.files[0].sha256).unlink()
    with pytest.raises(OSError, match="must have"):
        publish(task, packed.store)
    assert not packed.store.dataset_path(task.dataset, 1).exists()


def test_a_version_has_a_card_that_is_true(
    make_dataset: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    packed = make_dataset()
    directory = packed.publish()
    manifest = Manifest.model_validate_json((directory / "manifest.json").read_bytes())
    text = (directory / "README.md").read_text()
    assert sha256(text.encode()) in {
        file.sha256 for file in manifest.files if file.path == "README.md"
    }
    for name, array in zarr.open_group(directory, mode="r").arrays():
        assert f"| `{name}` |" in text
        assert str(array.attrs["description"]) in text
    assert f"{manifest.sample_count} samples, {manifest.valid_count} of them valid" in text
    for split, count in manifest.split_counts.items():
        assert f"| {split} | {count} |" in text
    assert manifest.rejections
    assert f"| {manifest.rejections[0].reason} | {len(manifest.rejections)} |" in text
    assert manifest.builds.simulate in text
    assert "No certificate vouches" in text
    # These are rods: the yarn is compared with, and no cloth.
    assert "### Against measurements, of 2026-11-29" in text
    assert "| 250 | 17.5 +- 3 |" in text
    assert "gray-interlock" not in text
    monkeypatch.chdir(directory)
    first, second = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    names: dict[str, Any] = {}
    exec(first, names)
    assert names["sample"].any()
    assert "Samples" in second  # whose package workers may not import: tests/ run it
