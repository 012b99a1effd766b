"""Exports are read by the libraries that they are for, and hold the bits of the source."""

import gc
import hashlib
import importlib
import json
import subprocess
import sys
import tarfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stickslip_schemas.format.layout import layout
from stickslip_schemas.spec.jobs import SPLITS
from stickslip_training.cli import app
from stickslip_training.data.reader import DatasetReader
from stickslip_training.export import content as content_module
from stickslip_training.export import mds
from stickslip_training.export.content import Content
from typer.testing import CliRunner

run = CliRunner().invoke

pytestmark = pytest.mark.filterwarnings("ignore")  # of the libraries that read; some warn as they are imported


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
        array.name: source.arrays[array.name][slots] for array in layout(source.spec) if array.name != "valid"
    }


def same(found: Any, wanted: np.ndarray) -> bool:
    """Tell whether two arrays have the same type, shape and bits."""
    found = np.asarray(found)
    return found.dtype == wanted.dtype and found.shape == wanted.shape and found.tobytes() == wanted.tobytes()


@pytest.mark.parametrize("gzip", [0, 4])
def test_hdf5_is_the_source(source: Any, tmp_path: Path, gzip: int) -> None:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed: pip install 'stickslip-training[export]'")
    target = tmp_path / "out.h5"
    export(source, "--hdf5", target, "--gzip", gzip)
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
                assert tuple(file[name].attrs.get("categories", ())) == tuple(map(str, array.categories))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.h5", "out.h5.croissant.json"]


def test_a_flipped_bit_in_hdf5_is_an_error(clips: Any, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="h5py is not installed: pip install 'stickslip-training[export]'")
    target = tmp_path / "out.h5"
    export(clips, "--hdf5", target)
    with h5py.File(target) as file:
        offset = file["video"].id.get_chunk_info(3).byte_offset
    data = bytearray(target.read_bytes())
    data[offset + 1000] ^= 4
    target.write_bytes(data)
    with h5py.File(target) as file, pytest.raises(OSError, match=r"fletcher32|filter|checksum"):
        file["video"][:]


def test_webdataset_is_the_source(source: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    webdataset = pytest.importorskip("webdataset", reason="webdataset is not installed: pip install webdataset")
    monkeypatch.setattr(
        content_module, "FILE_BYTES", 2 * sum(array.sample_bytes for array in layout(source.spec)) + 100
    )
    target = tmp_path / "out"
    export(source, "--webdataset", target)
    arrays = {array.name: array for array in layout(source.spec)} | {"slot": content_module.SLOT}
    wanted = expected(source)
    found: dict[str, list[Any]] = {name: [] for name in wanted}
    for code, split in enumerate(SPLITS):
        tars = sorted(map(str, target.glob(f"{split}-*.tar")))
        assert len(tars) == -(-int((wanted["split"] == code).sum()) // 2)
        for item in webdataset.WebDataset(tars, shardshuffle=False, empty_check=False).decode():
            assert item["json"]["split"] == code
            assert int(item["__key__"]) == item["json"]["slot"]
            for name in wanted:
                found[name].append(item["json"][name] if name in item["json"] else item[f"{name}.npy"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # webdataset closes no file
        gc.collect()
    order = np.argsort(found["slot"])
    for name, values in wanted.items():
        assert same(np.array(found[name], dtype=arrays[name].dtype)[order], values), name
        if f"{name}.npy" in item:
            assert item[f"{name}.npy"].dtype == values.dtype
    described = json.loads((target / "dataset.json").read_bytes())
    assert described["arrays"].keys() == wanted.keys()
    assert (target / "source-manifest.json").read_bytes() == (source.root / "manifest.json").read_bytes()


def test_huggingface_is_the_source(source: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    datasets = pytest.importorskip(
        "datasets", reason="datasets is not installed: pip install 'stickslip-training[export]'"
    )
    monkeypatch.setattr(
        content_module, "FILE_BYTES", 2 * sum(array.sample_bytes for array in layout(source.spec)) + 100
    )
    target = tmp_path / "out"
    export(source, "--huggingface", target)
    loaded = datasets.load_dataset(str(target), cache_dir=str(tmp_path / "cache"))
    wanted = expected(source)
    arrays = {array.name: array for array in layout(source.spec)}
    for code, split in enumerate(SPLITS):
        own = wanted["split"] == code
        if not own.any():
            assert split not in loaded
            continue
        rows = loaded[split]
        assert set(rows.column_names) == set(wanted)
        for name, values in wanted.items():
            column = rows.select_columns(name).with_format("numpy", dtype=values.dtype)[:][name]
            assert same(np.stack(list(column)), values[own]), name
            if name != "slot" and arrays[name].categories:
                assert rows.features[name].names == list(map(str, arrays[name].categories))


def test_mds_is_the_source(source: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    streaming = pytest.importorskip(
        "streaming",
        reason="mosaicml-streaming is not installed; it wants numpy < 2.2: docs/export.md says how to test it",
    )
    monkeypatch.setattr(mds, "FILE_BYTES", 2 * sum(array.sample_bytes for array in layout(source.spec)) + 100)
    target = tmp_path / "out"
    export(source, "--mds", target)
    wanted = expected(source)
    arrays = {array.name: array for array in layout(source.spec)} | {"slot": content_module.SLOT}
    for code, split in enumerate(SPLITS):
        own = wanted["split"] == code
        assert (target / split).exists() == own.any()
        if not own.any():
            continue
        assert len(list((target / split).glob("*.mds"))) > 1 or own.sum() < 3
        rows = streaming.StreamingDataset(
            local=str(target), split=split, shuffle=False, batch_size=1, validate_hash="sha256"
        )
        assert len(rows) == own.sum()
        found = [rows[place] for place in range(len(rows))]
        assert set(found[0]) == set(wanted)
        for name, values in wanted.items():
            column = np.stack([sample[name] for sample in found])
            if arrays[name].dtype == "bool":
                column = column.view(bool)
            assert same(column, values[own]), name
    assert (target / "source-manifest.json").read_bytes() == (source.root / "manifest.json").read_bytes()


def test_usd_is_the_source(clips: Any, tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr", reason="usd-core is not installed: pip install 'stickslip-training[usd]'")
    importlib.import_module("pxr.UsdGeom")
    export(clips, "--usd", tmp_path / "out", "--split", "train")
    slots = np.flatnonzero(clips.arrays["valid"] & (clips.arrays["split"] == 0))
    assert sorted(path.name for path in (tmp_path / "out").glob("*.usdc")) == [f"{slot:08d}.usdc" for slot in slots]
    for slot in slots[:2]:
        stage = usd.Usd.Stage.Open(str(tmp_path / "out" / f"{slot:08d}.usdc"))
        mesh = usd.UsdGeom.Mesh(stage.GetPrimAtPath("/cloth"))
        wanted = clips.arrays["positions"][slot]
        assert stage.GetEndTimeCode() == len(wanted) - 1
        found = np.stack([np.asarray(mesh.GetPointsAttr().Get(float(instant))) for instant in range(len(wanted))])
        assert same(found, wanted)
        corners = np.asarray(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        assert np.array_equal(corners, clips.arrays["triangles"][slot])
        labels = json.loads(stage.GetRootLayer().customLayerData["stickslip"])
        assert labels["mu"] == clips.arrays["mu"][slot]


def test_obj_is_the_source(clips: Any, tmp_path: Path) -> None:
    export(clips, "--obj", tmp_path / "out", "--split", "test")
    slots = np.flatnonzero(clips.arrays["valid"] & (clips.arrays["split"] == 2))
    assert len(slots)
    for slot in slots[:2]:
        wanted = clips.arrays["positions"][slot]
        files = sorted((tmp_path / "out" / f"{slot:08d}").glob("*.obj"))
        assert len(files) == len(wanted)
        for path, vertices in zip(files, wanted, strict=True):
            lines = [line.split() for line in path.read_text().splitlines()]
            found = np.array([line[1:] for line in lines if line[0] == "v"], dtype=np.float32)
            assert same(found, vertices)
            corners = [[int(corner.split("/")[0]) - 1 for corner in line[1:]] for line in lines if line[0] == "f"]
            assert np.array_equal(corners, clips.arrays["triangles"][slot])


def test_a_dataset_without_meshes_is_no_usd(rods: Any, tmp_path: Path) -> None:
    done = run(app, ["export", str(rods.root), "--obj", str(tmp_path / "out")])
    assert done.exit_code == 1
    assert "a mesh needs the arrays positions, rest, triangles" in done.output
    assert not list(tmp_path.iterdir())


def test_parquet_has_the_types_of_the_source(clips: Any, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    pytest.importorskip("datasets", reason="datasets is not installed")
    export(clips, "--huggingface", tmp_path / "out")
    file = next((tmp_path / "out" / "data").glob("train-*.parquet"))
    table = parquet.read_table(file, page_checksum_verification=True)
    train = np.flatnonzero(clips.arrays["valid"] & (clips.arrays["split"] == 0))
    assert same(table["mu"].to_numpy(), clips.arrays["mu"][train])
    video = np.stack(list(table["video"].combine_chunks().to_numpy(zero_copy_only=False)))
    assert same(video, clips.arrays["video"][train])


READ_RECORDS = """
import json, sys
import mlcroissant, numpy
records = mlcroissant.Dataset(jsonld=sys.argv[1]).records("samples")
rows = [{name.split("/")[-1]: numpy.asarray(value).tolist() for name, value in record.items()} for record in records]
print(json.dumps([{name: row[name] for name in sys.argv[2:]} for row in rows]))
"""


def test_croissant_is_valid_and_reads_the_parquet_files(rods: Any, tmp_path: Path) -> None:
    croissant = pytest.importorskip("mlcroissant", reason="mlcroissant is not installed: pip install mlcroissant")
    pytest.importorskip("datasets", reason="datasets is not installed")
    export(rods, "--huggingface", tmp_path / "out", "--license", "https://creativecommons.org/licenses/by/4.0/")
    place = tmp_path / "out" / "croissant.json"
    assert not croissant.Dataset(jsonld=place).metadata.ctx.issues.errors
    names = ("slot", "gamma", "self_contact_distance", "split", "multistable", "sample_key")
    # In a process of its own: `datasets`, once it is imported, gives pandas columns that mlcroissant cannot take.
    done = subprocess.run([sys.executable, "-c", READ_RECORDS, place, *names], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    records = sorted(json.loads(done.stdout.splitlines()[-1]), key=lambda record: record["slot"])
    wanted = expected(rods)
    for name in names:
        found = np.array([record[name] for record in records])
        assert np.array_equal(found.reshape(wanted[name].shape), wanted[name]), name


@pytest.mark.parametrize("option", ["--hdf5", "--webdataset", "--huggingface"])
def test_croissant_of_every_format(seen_rods: Any, tmp_path: Path, option: str) -> None:
    croissant = pytest.importorskip("mlcroissant", reason="mlcroissant is not installed: pip install mlcroissant")
    export(seen_rods, option, tmp_path / "out")
    place = tmp_path / "out.croissant.json" if option == "--hdf5" else tmp_path / "out" / "croissant.json"
    dataset = croissant.Dataset(jsonld=place)
    assert not dataset.metadata.ctx.issues.errors
    files = {item["@id"]: item for item in json.loads(place.read_bytes())["distribution"] if "sha256" in item}
    root = place.parent
    on_disk = {"out"} if option == "--hdf5" else {str(p.relative_to(root)) for p in root.rglob("*") if p.is_file()}
    assert set(files) == on_disk - {"croissant.json"}
    for name, item in files.items():
        assert hashlib.sha256((root / name).read_bytes()).hexdigest() == item["sha256"]


def test_a_part_is_exported(clips: Any, tmp_path: Path) -> None:
    export(clips, "--webdataset", tmp_path / "out", "--split", "train", "--where", "texture==plaid", "--arrays", "mu")
    plaid = next(array for array in layout(clips.spec) if array.name == "texture").categories.index("plaid")
    chosen = clips.arrays["valid"] & (clips.arrays["split"] == 0) & (clips.arrays["texture"] == plaid)
    with tarfile.open(tmp_path / "out" / "train-000000.tar") as tar:
        names = tar.getnames()
    assert names == [f"{slot:08d}.json" for slot in np.flatnonzero(chosen)]
    assert names


def test_the_same_export_has_the_same_bytes(clips: Any, tmp_path: Path) -> None:
    for name in ("one", "two"):
        export(clips, "--webdataset", tmp_path / name)
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "an export needs one of --hdf5, --webdataset, --huggingface, --mds, --usd, --obj, and has none"),
        (["--webdataset", "OUT", "--huggingface", "OUT"], "and has --webdataset, --huggingface"),
        (["--webdataset", "OUT", "--gzip", "3"], "--gzip is for --hdf5 only"),
        (["--webdataset", "OUT", "--arrays", "movie"], "'movie' is none of them"),
        (["--webdataset", "OUT", "--split", "all"], "split: Input should be 'train', 'validation' or 'test'"),
        (["--webdataset", "OUT", "--where", "mu>9"], "no valid sample is in this part"),
    ],
)
def test_what_makes_no_sense_is_refused(clips: Any, tmp_path: Path, options: list[str], message: str) -> None:
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
        file for file in sorted((copy.root / "video").rglob("*")) if file.is_file() and file.name != "zarr.json"
    )
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(data)
    done = run(app, ["export", str(copy.root), "--webdataset", str(tmp_path / "out")])
    assert done.exit_code == 1
    assert "SHA-256" in done.output
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]


def test_one_sample_at_a_time_is_read(clips: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory does not grow with the dataset."""
    read: list[int] = []
    inner = DatasetReader.read

    def counted(self: DatasetReader, name: str, slots: Any) -> Any:
        read.append(len(slots))
        return inner(self, name, slots)

    monkeypatch.setattr(DatasetReader, "read", counted)
    export(clips, "--webdataset", tmp_path / "out")
    assert set(read) == {1}


def test_files_are_of_one_split_and_of_bounded_size(clips: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from stickslip_schemas.format.selection import Selection

    with DatasetReader(clips.root) as reader:
        content = Content(reader, Selection())
        monkeypatch.setattr(content_module, "FILE_BYTES", 3 * content.sample_bytes)
        parts = list(content.parts())
    assert max(len(part.slots) for part in parts) == 3
    for part in parts:
        assert {SPLITS[code] for code in clips.arrays["split"][part.slots]} == {part.split}
    assert sorted(np.concatenate([part.slots for part in parts])) == list(np.flatnonzero(clips.arrays["valid"]))
