"""The export has the layout of LeRobotDataset v3.0, with the frames and actions of the dataset.

The layout below is that of "codebase_version" v3.0, as lerobot 0.4.4 reads it.
"""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from stickslip_schemas.spec.arrays import SPLITS, array
from stickslip_training.export import lerobot

FRAMES, INSTANTS, VERTICES, SIDE = 10, 46, 25, 64
VIEWS = ("front", "high")
RANDOM = np.random.Generator(np.random.PCG64(0))


def content(
    simulations: int = 4, *, without: tuple[int, ...] = (), has_depth: bool = False
) -> tuple[Any, dict[str, Any]]:
    """Return what an export reads of simulations that two cameras see, and all arrays by slot."""
    instants = np.linspace(0, INSTANTS - 1, FRAMES).round().astype(int).tolist()
    time = {"instants_per_second": 15.0}
    layouts = (
        array("slot", "slot", "int64"),
        array(
            "video",
            "clip",
            "uint8",
            {"frame": FRAMES, "y": SIDE, "x": SIDE, "rgb": 3},
            per_sample=True,
            attributes={"instants": instants},
        ),
        array(
            "holder_pose",
            "poses",
            "float32",
            {"instant": INSTANTS, "holder": 2, "row": 3, "column": 4},
            attributes=time | {"names": ["napkin.left", "napkin.right"]},
        ),
        array("grasped", "holds", "uint8", {"instant": INSTANTS, "holder": 2}),
        array(
            "body_pose",
            "poses",
            "float32",
            {"instant": INSTANTS, "body": 1, "row": 3, "column": 4},
            attributes={"names": ["ball"]},
        ),
        array(
            "napkin.positions",
            "positions",
            "float32",
            {"instant": INSTANTS, "vertex": VERTICES, "xyz": 3},
        ),
        array("napkin.rest", "flat", "float32", {"vertex": VERTICES, "uv": 2}),
        array("mu", "friction", "float64"),
        array("fabric", "code", "int16", categories=("wool", "silk")),
        array("viewpoint", "code", "int16", categories=VIEWS),
        array("split", "code", "uint8", categories=SPLITS),
    )
    if has_depth:
        pixels = {"frame": FRAMES, "y": SIDE, "x": SIDE}
        layouts += (array("depth", "depth", "float32", pixels, per_sample=True),)
    rest = np.stack(np.meshgrid(*[np.linspace(0.0, 0.2, 5)] * 2, indexing="ij"), axis=-1).reshape(
        -1, 2
    )
    count = 2 * simulations

    def random(*shape: int) -> Any:
        return np.repeat(RANDOM.normal(size=(simulations, *shape)).astype(np.float32), 2, axis=0)

    data: dict[str, Any] = {
        "slot": np.arange(count),
        "video": RANDOM.integers(0, 256, (count, FRAMES, SIDE, SIDE, 3)).astype(np.uint8),
        "holder_pose": random(INSTANTS, 2, 3, 4),
        "grasped": (random(INSTANTS, 2) > 0.0).astype(np.uint8),
        "body_pose": random(INSTANTS, 1, 3, 4),
        "napkin.positions": random(INSTANTS, VERTICES, 3),
        "napkin.rest": np.repeat(rest[None], count, axis=0).astype(np.float32),
        "mu": np.repeat(np.linspace(0.1, 0.9, simulations), 2),
        "fabric": (np.arange(count) // 2 % 2).astype(np.int16),
        "viewpoint": (np.arange(count) % 2).astype(np.int16),
        "split": np.repeat(np.arange(simulations) % 3, 2).astype(np.uint8),
    }
    depth = RANDOM.uniform(0.7, 1.9, (count, FRAMES, SIDE, SIDE)).astype(np.float32)
    data["depth"] = np.where(depth < 0.8, np.inf, depth)
    arrays = {layout.name: layout for layout in layouts}
    reader = SimpleNamespace(
        arrays=arrays,
        spec=SimpleNamespace(named_axes=dict.fromkeys(("mu", "fabric", "viewpoint"))),
        categories=lambda name: arrays[name].categories,
        label=lambda name: data[name],
    )
    source = SimpleNamespace(
        arrays=layouts,
        labels=tuple(layout for layout in layouts if layout.is_label),
        slots=np.array([slot for slot in range(count) if slot not in without]),
        reader=reader,
        name="ds-1:v1",
        title="fold-napkin",
        sample_bytes=1,
        read=lambda name, slots: data[name][slots],
        picture=lambda name, slot: data[name][slot],
    )
    return source, data


def test_an_episode_has_all_views_and_comes_with_its_split(tmp_path: Path) -> None:
    pytest.importorskip("pandas", reason="pandas is not installed: make setup-dev")
    parquet = pytest.importorskip("pyarrow.parquet")
    source, data = content(without=(3,))  # the second simulation lacks a view
    lerobot.write(source, tmp_path, lambda _: None)
    episodes = parquet.read_table(tmp_path / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
    assert episodes["mu"] == data["mu"][[0, 6, 4]].tolist()  # train, train, test
    assert episodes["fabric"] == ["wool", "silk", "wool"]
    info = json.loads((tmp_path / "meta/info.json").read_text())
    assert info["splits"] == {"train": "0:2", "test": "2:3"}
    assert info["total_frames"] == 3 * FRAMES
    rows = parquet.read_table(tmp_path / "data/chunk-000/file-000.parquet").to_pydict()
    instants = source.arrays[1].attributes["instants"]
    pose, grasped = data["holder_pose"][0][instants], data["grasped"][0][instants]
    of_clips = np.concatenate(
        [pose[..., 3], pose[..., 0], pose[..., 1], grasped[..., None]], axis=-1
    ).reshape(FRAMES, -1)
    state, action = np.array(rows["observation.state"][:FRAMES]), np.array(rows["action"][:FRAMES])
    np.testing.assert_array_equal(state[:, :20], of_clips)
    np.testing.assert_array_equal(action[:-1], of_clips[1:])
    np.testing.assert_array_equal(action[-1], of_clips[-1])
    corners = data["napkin.positions"][0][instants][:, [0, 20, 24, 4, 12]].reshape(FRAMES, -1)
    np.testing.assert_array_equal(state[:, -15:], corners)
    names = info["features"]["observation.state"]["names"]
    assert names[9:11] == ["napkin.left.grasp", "napkin.right.x"]
    assert names[-15:-12] == ["napkin.0.x", "napkin.0.y", "napkin.0.z"]
    assert len(names) == state.shape[1]
    np.testing.assert_allclose(
        rows["observation.time"][:FRAMES], np.array(instants) / 15.0, rtol=1e-6
    )
    stats = json.loads((tmp_path / "meta/stats.json").read_text())
    every = np.array(rows["action"])
    np.testing.assert_allclose(stats["action"]["mean"], every.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(stats["action"]["std"], every.std(axis=0), atol=1e-12)
    pixels = data["video"][[0, 6, 4]].reshape(-1, 3) / 255.0  # by the camera `front`
    pictures = stats["observation.images.front"]
    assert pictures["count"] == [len(pixels)]
    for name, expected in (("mean", pixels.mean(axis=0)), ("std", pixels.std(axis=0))):
        np.testing.assert_allclose(np.ravel(pictures[name]), expected, atol=1e-9)


def test_videos_have_the_bytes_of_the_clips(tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="av is not installed: make setup-dev")
    source, data = content(1)
    lerobot.write(source, tmp_path, lambda _: None)
    for slot, view in enumerate(VIEWS):
        path = tmp_path / f"videos/observation.images.{view}/chunk-000/file-000.mp4"
        with av.open(str(path)) as file:
            frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
        np.testing.assert_array_equal(frames, data["video"][slot])


def test_depth_is_a_feature_in_twelve_bits(tmp_path: Path) -> None:
    """As lerobot 0.6 reads it: from codes and the numbers beside them, to half a step."""
    av = pytest.importorskip("av", reason="av is not installed: make setup-dev")
    source, data = content(1, has_depth=True)
    lerobot.write(source, tmp_path, lambda _: None)
    info = json.loads((tmp_path / "meta/info.json").read_text())
    stats = json.loads((tmp_path / "meta/stats.json").read_text())
    for slot, view in enumerate(VIEWS):
        key = f"observation.images.{view}_depth"
        feature = info["features"][key]
        assert (feature["dtype"], feature["shape"]) == ("video", [SIDE, SIDE, 1])
        assert feature["info"]["is_depth_map"]
        assert not feature["info"]["video.use_log"]
        near, far = (feature["info"][f"video.depth_{end}"] for end in ("min", "max"))
        path = info["video_path"].format(video_key=key, chunk_index=0, file_index=0)
        with av.open(str(tmp_path / path)) as file:
            assert file.streams.video[0].codec_context.pix_fmt == "gray12le"
            codes = np.stack([frame.to_ndarray(format="gray12le") for frame in file.decode(0)])
        depth = near + codes * (far - near) / 4095
        wanted = data["depth"][slot]
        is_there = np.isfinite(wanted)
        assert (codes[~is_there] == 4095).all()
        assert (codes[is_there] < 4095).all()
        step = (far - near) / 4095
        assert step < 3e-4
        assert np.abs(depth - wanted)[is_there].max() <= 0.501 * step
        assert np.shape(stats[key]["mean"]) == (1, 1, 1)
        assert stats[key]["max"][0][0][0] == pytest.approx(far)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"arrays": ()}, "and video, holder_pose, grasped are not in this part of ds-1:v1"),
        ({"slots": np.array([0, 3])}, "an episode needs a clip of each of front, high"),
    ],
)
def test_what_is_no_episode_is_refused(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    source, _ = content(2)
    vars(source).update(change)
    with pytest.raises(ValueError, match=message):
        lerobot.write(source, tmp_path, lambda _: None)


FRAME_COLUMNS = {
    "action": "fixed_size_list<element: float>[20]",
    "observation.state": "fixed_size_list<element: float>[44]",
    "observation.time": "float",
    "timestamp": "float",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Columns of `data/chunk-000/file-000.parquet` and their types."""

EPISODE_COLUMNS = {
    "episode_index",
    "tasks",
    "length",
    "dataset_from_index",
    "dataset_to_index",
    "data/chunk_index",
    "data/file_index",
    "meta/episodes/chunk_index",
    "meta/episodes/file_index",
}
"""Columns of `meta/episodes` besides videos, statistics and labels."""

INFO_KEYS = {
    "codebase_version",
    "robot_type",
    "total_episodes",
    "total_frames",
    "total_tasks",
    "chunks_size",
    "data_files_size_in_mb",
    "video_files_size_in_mb",
    "fps",
    "splits",
    "data_path",
    "video_path",
    "features",
}


def test_files_have_the_layout_of_version_3(tmp_path: Path) -> None:
    pytest.importorskip("pandas", reason="pandas is not installed: make setup-dev")
    parquet = pytest.importorskip("pyarrow.parquet")
    source, _ = content(6)
    lerobot.write(source, tmp_path, lambda _: None)
    info = json.loads((tmp_path / "meta/info.json").read_text(), parse_constant=pytest.fail)
    assert info.keys() == INFO_KEYS
    assert info["codebase_version"] == "v3.0"

    # Frames: one row each, and a feature for each column.
    path = info["data_path"].format(chunk_index=0, file_index=0)
    frames = parquet.read_table(tmp_path / path)
    types = {field.name: str(field.type) for field in frames.schema}
    assert types == FRAME_COLUMNS
    videos = {f"observation.images.{view}" for view in VIEWS}
    assert info["features"].keys() == FRAME_COLUMNS.keys() | videos
    assert frames["index"].to_pylist() == list(range(6 * FRAMES))
    assert frames["frame_index"].to_pylist() == list(range(FRAMES)) * 6
    times = np.array(frames["timestamp"].to_pylist())
    np.testing.assert_allclose(times, np.tile(np.arange(FRAMES) / info["fps"], 6), atol=1e-4)

    # Episodes: where the frames and the videos of each are, and its statistics.
    episodes = parquet.read_table(tmp_path / "meta/episodes/chunk-000/file-000.parquet")
    columns = set(episodes.column_names)
    assert columns >= EPISODE_COLUMNS
    for key in videos:
        parts = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
        assert columns >= {f"videos/{key}/{part}" for part in parts}
    assert columns >= {f"stats/action/{name}" for name in ("min", "max", "mean", "std", "count")}
    tasks = parquet.read_table(tmp_path / "meta/tasks.parquet").to_pandas()
    assert tasks.index.tolist() == ["fold-napkin"]
    assert tasks["task_index"].tolist() == [0]
    stats = json.loads((tmp_path / "meta/stats.json").read_text(), parse_constant=pytest.fail)
    assert np.shape(stats["observation.images.front"]["mean"]) == (3, 1, 1)


def test_a_frame_of_a_video_is_at_its_time(tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="av is not installed: make setup-dev")
    source, _ = content(3)
    lerobot.write(source, tmp_path, lambda _: None)
    info = json.loads((tmp_path / "meta/info.json").read_text())
    for episode in range(3):
        path = info["video_path"].format(
            video_key="observation.images.front", chunk_index=0, file_index=episode
        )
        with av.open(str(tmp_path / path)) as file:
            times = [frame.time for frame in file.decode(video=0)]
        np.testing.assert_allclose(times, np.arange(FRAMES) / info["fps"], atol=1e-4)
