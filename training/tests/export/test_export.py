"""Exports are read by the libraries that they are for, and hold the bits of the source."""

import gc
import json
import math
import tarfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stickslip_schemas.format.manifest import layout
from stickslip_schemas.spec.arrays import SPLITS
from stickslip_training.cli import app
from stickslip_training.data.reader import DatasetReader
from stickslip_training.export import formats as content_module
from stickslip_training.export.formats import Content
from stickslip_training.export.strict_json import strict_json
from typer.testing import CliRunner

run = CliRunner().invoke

pytestmark = pytest.mark.filterwarnings(
    "ignore"
)  # of the libraries that read; some warn as they are imported


@pytest.fixture(params=["clips", "rods", "seen_rods"])
def source(request: pytest.FixtureRequest) -> Any:
    """Every kind of array: clips and meshes, curves, views; each dataset has rejected samples."""
    return request.getfixturevalue(request.param)


def export(source: Any, *options: object) -> str:
    done = run(app, ["export", str(source.root), *map(str, options)])
    assert done.exit_code == 0, done.output
    return done.output


def expected(source: Any) -> dict[str, np.ndarray]:
    """Return what an export of everything must hold, by array."""
    slots = np.flatnonzero(source.arrays["valid"])
    return {"slot": slots} | {
        array.name: source.arrays[array.name][slots]
        for array in layout(source.spec)
        if array.name != "valid"
    }


def same(exported: Any, wanted: np.ndarray) -> bool:
    """Return whether two arrays have the same type, shape and bits."""
    exported = np.asarray(exported)
    return (
        exported.dtype == wanted.dtype
        and exported.shape == wanted.shape
        and exported.tobytes() == wanted.tobytes()
    )


def test_hdf5_is_the_source(source: Any, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed: make setup-dev")
    target = tmp_path / "out.h5"
    export(source, "--hdf5", target)
    wanted = expected(source)
    with h5py.File(target) as file:
        assert set(file) == {*wanted, "manifest.json"}
        for name, values in wanted.items():
            assert same(file[name][:], values), name
            assert file[name].fletcher32
        assert file["manifest.json"][:].tobytes() == (source.root / "manifest.json").read_bytes()
        assert file.attrs["dataset"] == source.manifest.dataset
        arrays = {array.name: array for array in layout(source.spec)}
        for name, array in arrays.items():
            if name != "valid":
                assert [item.label for item in file[name].dims] == ["sample", *array.dimensions]
                assert tuple(file[name].attrs.get("categories", ())) == tuple(
                    map(str, array.categories)
                )
    assert [path.name for path in tmp_path.iterdir()] == ["out.h5"]


def test_a_flipped_bit_in_hdf5_is_an_error(clips: Any, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed: make setup-dev")
    target = tmp_path / "out.h5"
    export(clips, "--hdf5", target)
    with h5py.File(target) as file:
        offset = file["video"].id.get_chunk_info(3).byte_offset
    data = bytearray(target.read_bytes())
    data[offset + 1000] ^= 4
    target.write_bytes(data)
    with h5py.File(target) as file, pytest.raises(OSError, match=r"fletcher32|filter|checksum"):
        file["video"][:]


def test_webdataset_is_the_source(
    source: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    webdataset = pytest.importorskip(
        "webdataset", reason="webdataset is not installed: make setup-dev"
    )
    monkeypatch.setattr(
        content_module,
        "FILE_BYTES",
        2 * sum(array.sample_bytes for array in layout(source.spec)) + 100,
    )
    target = tmp_path / "out"
    export(source, "--webdataset", target)
    arrays = {array.name: array for array in layout(source.spec)} | {"slot": content_module.SLOT}
    wanted = expected(source)
    exported: dict[str, list[Any]] = {name: [] for name in wanted}
    for code, split in enumerate(SPLITS):
        tars = sorted(map(str, target.glob(f"{split}-*.tar")))
        assert len(tars) == -(-int((wanted["split"] == code).sum()) // 2)
        for item in webdataset.WebDataset(tars, shardshuffle=False, empty_check=False).decode():
            assert item["json"]["split"] == code
            assert int(item["__key__"]) == item["json"]["slot"]
            for name in wanted:
                value = item["json"][name] if name in item["json"] else item[f"{name}.npy"]
                exported[name].append(value)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # webdataset closes no file
        gc.collect()
    order = np.argsort(exported["slot"])
    for name, values in wanted.items():
        if arrays[name].is_label and values.dtype.kind == "f":
            # A label that is not finite is null in JSON, whatever it was.
            values = np.where(np.isfinite(values), values, np.nan)
        assert same(np.array(exported[name], dtype=arrays[name].dtype)[order], values), name
        if f"{name}.npy" in item:
            assert item[f"{name}.npy"].dtype == values.dtype
    described = json.loads((target / "dataset.json").read_bytes())
    assert described["arrays"].keys() == wanted.keys()
    assert (target / "source-manifest.json").read_bytes() == (
        source.root / "manifest.json"
    ).read_bytes()


@pytest.mark.physics
def test_huggingface_is_the_source(
    source: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    datasets = pytest.importorskip("datasets", reason="datasets is not installed: make setup-dev")
    monkeypatch.setattr(
        content_module,
        "FILE_BYTES",
        2 * sum(array.sample_bytes for array in layout(source.spec)) + 100,
    )
    target = tmp_path / "out"
    export(source, "--huggingface", target)
    loaded = datasets.load_dataset(str(target), cache_dir=str(tmp_path / "cache"))
    wanted = expected(source)
    arrays = {array.name: array for array in layout(source.spec)}
    for code, split in enumerate(SPLITS):
        is_of_split = wanted["split"] == code
        if not is_of_split.any():
            assert split not in loaded
            continue
        rows = loaded[split]
        assert set(rows.column_names) == set(wanted)
        for name, values in wanted.items():
            column = rows.select_columns(name).with_format("numpy", dtype=values.dtype)[:][name]
            assert same(np.stack(list(column)), values[is_of_split]), name
            if name != "slot" and arrays[name].categories:
                assert rows.features[name].names == list(map(str, arrays[name].categories))


def test_the_same_export_has_the_same_bytes(clips: Any, tmp_path: Path) -> None:
    for name in ("one", "two"):
        export(clips, "--webdataset", tmp_path / name)
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            [],
            "an export needs one of --hdf5, --webdataset, --huggingface, --coco, --lerobot, "
            "--obj, and has none",
        ),
        (["--webdataset", "OUT", "--huggingface", "OUT"], "and has --webdataset, --huggingface"),
        (["--webdataset", "OUT", "--arrays", "movie"], "got 'movie'"),
        (
            ["--webdataset", "OUT", "--split", "all"],
            "split: Input should be 'train', 'validation' or 'test'",
        ),
        (["--webdataset", "OUT", "--where", "mu>9"], "no valid sample is in this part"),
    ],
)
def test_what_makes_no_sense_is_refused(
    clips: Any, tmp_path: Path, options: list[str], message: str
) -> None:
    options = [str(tmp_path / "out") if option == "OUT" else option for option in options]
    done = run(app, ["export", str(clips.root), *options])
    assert done.exit_code == 1
    assert message in done.output
    assert not list(tmp_path.iterdir())


def test_nothing_is_overwritten(clips: Any, tmp_path: Path) -> None:
    target = tmp_path / "out"
    target.mkdir()
    done = run(app, ["export", str(clips.root), "--webdataset", str(target)])
    assert done.exit_code == 1
    assert "exists, and an export overwrites nothing" in done.output
    assert not list(target.iterdir())


def test_an_export_that_fails_leaves_nothing(clips: Any, tmp_path: Path) -> None:
    copy = clips.copy(tmp_path / "copy")
    shard = next(
        file
        for file in sorted((copy.root / "video").rglob("*"))
        if file.is_file() and file.name != "zarr.json"
    )
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(data)
    done = run(app, ["export", str(copy.root), "--webdataset", str(tmp_path / "out")])
    assert done.exit_code == 1
    assert "SHA-256" in done.output
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]


def test_one_sample_at_a_time_is_read(
    clips: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Memory does not grow with the dataset."""
    read: list[int] = []
    inner = DatasetReader.read

    def counted(self: DatasetReader, name: str, slots: Any) -> Any:
        read.append(len(slots))
        return inner(self, name, slots)

    monkeypatch.setattr(DatasetReader, "read", counted)
    export(clips, "--webdataset", tmp_path / "out")
    assert set(read) == {1}


def test_files_are_of_one_split_and_of_bounded_size(
    clips: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from stickslip_schemas.format.selection import Selection

    with DatasetReader(clips.root) as reader:
        content = Content(reader, Selection())
        monkeypatch.setattr(content_module, "FILE_BYTES", 3 * content.sample_bytes)
        parts = list(content.parts())
    assert max(len(slots) for *_, slots in parts) == 3
    for split, _, _, slots in parts:
        assert {SPLITS[code] for code in clips.arrays["split"][slots]} == {split}
    assert sorted(np.concatenate([slots for *_, slots in parts])) == list(
        np.flatnonzero(clips.arrays["valid"])
    )


def test_json_that_is_not_finite_is_null() -> None:
    value = {"a": math.inf, "b": [math.nan, 1.5, (-math.inf, "x")], "c": {"d": math.nan, "e": None}}
    text = strict_json(value)
    assert json.loads(text, parse_constant=pytest.fail) == {
        "a": None,
        "b": [None, 1.5, [None, "x"]],
        "c": {"d": None, "e": None},
    }


@pytest.mark.parametrize("option", ["--webdataset", "--obj"])
def test_every_json_file_of_an_export_is_strict(
    clips: Any, rods: Any, tmp_path: Path, option: str
) -> None:
    source = rods if option == "--webdataset" else clips
    target = tmp_path / "out"
    export(source, option, target)
    texts = [path.read_bytes() for path in target.rglob("*.json")]
    for path in target.glob("*.tar"):
        with tarfile.open(path) as tar:
            members = [member for member in tar if member.name.endswith(".json")]
            texts += [tar.extractfile(member).read() for member in members]
    assert len(texts) > 2
    for text in texts:
        json.loads(text, parse_constant=pytest.fail)
