"""LeRobotDataset v3 [huggingface/lerobot, codebase version v3.0], for learning robots.

An episode shows how holders move cloth.

An episode is a simulation with one texture and one look of light and floor, seen by all viewpoints
of the dataset. `action` has of each holder its position, the first two columns of its rotation
[Zhou et al. 2019], and whether it holds, at the next frame; `observation.state` has the same of
this frame, the poses of all bodies, and the places of five vertices of each sheet: four corners and
the middle. `observation.time` is the time in the scene [s], for videos have their frames evenly.
Labels are columns of the episodes.

Videos are H.264 without loss, in RGB: a frame has the bytes that the dataset has. If the dataset
has depth, each view has a depth map, too, in the twelve bits of lerobot 0.6 and later (`videos`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from stickslip_schemas.spec.arrays import SPLITS

from stickslip_training.arrays import Array
from stickslip_training.export.formats import Content, OnBytes
from stickslip_training.export.strict_json import strict_json
from stickslip_training.export.videos import (
    DepthRange,
    encode_depth,
    encode_pictures,
    statistics_of_codes,
)

FILES = 1000
"""Files of a folder."""
EPISODES_IN_FILE = 1000
"""Episodes whose numbers go into one file."""
PICTURES = "observation.images.{view}"
DEPTH = "observation.images.{view}_depth"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
NEEDED = ("video", "holder_pose", "grasped")
_POSE = ("x", "y", "z", "xx", "yx", "zx", "xy", "yy", "zy")
_COUNTERS = ("frame_index", "episode_index", "index", "task_index")


def write(content: Content, directory: Path, on_bytes: OnBytes) -> None:
    """Write the files into an empty directory.

    Raises ValueError if the scene has no holders, or no episode is whole.
    """
    names = [array.name for array in content.arrays]
    missing = [name for name in NEEDED if name not in names]
    if missing:
        raise ValueError(
            f"LeRobot needs the arrays {', '.join(NEEDED)} of a scene with holders, and "
            f"{', '.join(missing)} are not in this part of {content.name}"
        )
    _Export(content, directory, on_bytes).write()


@dataclass(frozen=True)
class _Clock:
    """Times of the frames of an episode."""

    instants: Array
    """Simulated instants that the frames show, (frames,)."""
    per_second: Fraction
    """Simulated instants a second."""

    @property
    def length(self) -> int:
        return len(self.instants)

    @property
    def seconds(self) -> Array:
        """Times in the scene, (frames, 1) [s]."""
        return (self.instants[:, None] / float(self.per_second)).astype(np.float32)

    @property
    def rate(self) -> Fraction:
        """Frames a second of the video, which has its frames evenly."""
        span = int(np.ptp(self.instants))
        if span == 0:
            return Fraction(1)
        return self.per_second * (self.length - 1) / span


class _Export:
    """One export: files of the episodes, and then files about all of them."""

    def __init__(self, content: Content, directory: Path, on_bytes: OnBytes) -> None:
        self.content = content
        self.directory = directory
        self.on_bytes = on_bytes
        arrays = {array.name: array for array in content.arrays}
        per_second = Fraction(arrays["holder_pose"].attributes["instants_per_second"])
        self.clock = _Clock(
            instants=np.array(arrays["video"].attributes["instants"]),
            per_second=per_second.limit_denominator(1000),
        )
        self.episodes = list(_episodes(content))
        first = self.episodes[0][1]
        self.views = list(first)
        self.sizes = {view: _picture_size(content, slot) for view, slot in first.items()}
        self.depth_range: DepthRange | None = None
        if "depth" in arrays:
            self.depth_range = DepthRange.spanning(_depth_maps(content, self.episodes))
        self.statistics: list[dict[str, Any]] = []
        """Of each episode, by feature."""
        self.rows: list[dict[str, Any]] = []
        """Of the table of episodes."""

    def write(self) -> None:
        """Write all files."""
        from pyarrow import parquet

        names: dict[str, list[str]] = {}
        tables: list[Any] = []
        for number, (_, slots) in enumerate(self.episodes):
            frames, names = self._frames(slots)
            videos = self._write_videos(number, slots)
            self._add_row(number, slots, videos)

            # Frames of many episodes share a file: LeRobot opens each file once.
            tables.append(_table(frames, number, self.clock.rate))
            is_last = number == len(self.episodes) - 1
            if len(tables) == EPISODES_IN_FILE or is_last:
                _write_tables(parquet, tables, self.directory / DATA.format(**_file_of(number)))
                tables = []
        self._write_meta(names)

    def _frames(self, slots: dict[str, int]) -> tuple[dict[str, Array], dict[str, list[str]]]:
        """Return the numbers of the frames of an episode, by feature, and their names."""
        # All views show one simulation: the numbers of any of them will do.
        frames, names = _numbers(self.content, slots[self.views[0]], self.clock.instants)
        frames["observation.time"] = self.clock.seconds
        names["observation.time"] = ["s"]
        self.statistics.append({name: _statistics(values) for name, values in frames.items()})
        return frames, names

    def _write_videos(self, number: int, slots: dict[str, int]) -> dict[str, Any]:
        """Write a video for each view, and return the columns that locate it."""
        chunk, file = divmod(number, FILES)
        columns: dict[str, Any] = {}
        for view, slot in slots.items():
            for key in self._write_views(view, slot, chunk, file):
                columns |= {
                    f"videos/{key}/chunk_index": chunk,
                    f"videos/{key}/file_index": file,
                    f"videos/{key}/from_timestamp": 0.0,
                    f"videos/{key}/to_timestamp": float(self.clock.length / self.clock.rate),
                }
            self.on_bytes(self.content.sample_bytes)
        return columns

    def _write_views(self, view: str, slot: int, chunk: int, file: int) -> Iterator[str]:
        """Write the clip of a sample and its depth map, and yield the features that they are."""
        key = PICTURES.format(view=view)
        video = self.content.picture("video", slot)
        encode_pictures(video, self._video_path(key, chunk, file), self.clock.rate)
        self.statistics[-1][key] = statistics_of_codes(video, np.arange(256) / 255.0)
        yield key
        if self.depth_range is not None:
            key = DEPTH.format(view=view)
            codes = self.depth_range.codes(self.content.picture("depth", slot))
            encode_depth(codes, self._video_path(key, chunk, file), self.clock.rate)
            levels = self.depth_range.levels
            self.statistics[-1][key] = statistics_of_codes(codes[..., None], levels)
            yield key

    def _video_path(self, key: str, chunk: int, file: int) -> Path:
        return self.directory / VIDEO.format(video_key=key, chunk_index=chunk, file_index=file)

    def _add_row(
        self,
        number: int,
        slots: dict[str, int],
        videos: dict[str, Any],
    ) -> None:
        """Add an episode to the table of episodes."""
        length = self.clock.length
        data = _file_of(number)
        row = _labels(self.content, slots[self.views[0]]) | {
            "episode_index": number,
            "tasks": [self.content.title],
            "length": length,
            "dataset_from_index": number * length,
            "dataset_to_index": (number + 1) * length,
            "data/chunk_index": data["chunk_index"],
            "data/file_index": data["file_index"],
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        row |= videos
        for feature, statistics in self.statistics[-1].items():
            for key, value in statistics.items():
                row[f"stats/{feature}/{key}"] = value
        self.rows.append(row)

    def _write_meta(self, names: dict[str, list[str]]) -> None:
        """Write the files about all episodes: their table, tasks, statistics and features."""
        import pandas
        import pyarrow
        from pyarrow import parquet

        meta = self.directory / "meta"
        table = pyarrow.Table.from_pylist(self.rows)
        _write_tables(parquet, [table], meta / "episodes/chunk-000/file-000.parquet")
        tasks = pandas.DataFrame({"task_index": [0]}, index=[self.content.title])
        tasks.to_parquet(meta / "tasks.parquet")
        totals: dict[str, Any] = {}
        for feature in self.statistics[0]:
            totals[feature] = _merged([episode[feature] for episode in self.statistics])
        (meta / "stats.json").write_text(strict_json(totals))
        info = _info(self.episodes, names, self._views(), self.clock)
        (meta / "info.json").write_text(strict_json(info, indent=2))

    def _views(self) -> dict[str, Any]:
        """Return the features of all videos, by name."""
        rate = float(self.clock.rate)
        features: dict[str, Any] = {}
        for view, (width, height) in self.sizes.items():
            pictures = {"codec": "h264", "pix_fmt": "gbrp", "is_depth_map": False}
            key = PICTURES.format(view=view)
            features[key] = _video_feature(width, height, 3, rate, pictures)
            if self.depth_range is not None:
                depth = {
                    "codec": "hevc",
                    "pix_fmt": "gray12le",
                    "is_depth_map": True,
                    "depth_min": self.depth_range.near,
                    "depth_max": self.depth_range.far,
                    "shift": 0.0,
                    "use_log": False,
                }
                key = DEPTH.format(view=view)
                features[key] = _video_feature(width, height, 1, rate, depth)
                # LeRobot looks for the mark under its name alone.
                features[key]["info"]["is_depth_map"] = True
        return features


def _video_feature(
    width: int, height: int, channels: int, rate: float, details: dict[str, Any]
) -> dict[str, Any]:
    """Return the feature of a video; `details` are those of its encoding."""
    info = {
        "height": height,
        "width": width,
        **details,
        "fps": rate,
        "channels": channels,
    }
    return {
        "dtype": "video",
        "shape": [height, width, channels],
        "names": ["height", "width", "channels"],
        "info": {f"video.{name}": value for name, value in info.items()} | {"has_audio": False},
    }


def _picture_size(content: Content, slot: int) -> tuple[int, int]:
    """Return width and height of the pictures of a sample [px]."""
    height, width = content.picture("video", slot).shape[1:3]
    return width, height


def _depth_maps(
    content: Content, episodes: Sequence[tuple[str, dict[str, int]]]
) -> Iterator[Array]:
    """Yield the depth maps of all clips, one clip at a time."""
    for _, slots in episodes:
        for slot in slots.values():
            yield content.picture("depth", slot)


def _file_of(number: int) -> dict[str, int]:
    """Return the numbers of folder and file of the frames of an episode."""
    chunk, file = divmod(number // EPISODES_IN_FILE, FILES)
    return {"chunk_index": chunk, "file_index": file}


def _write_tables(parquet: Any, tables: list[Any], path: Path) -> None:
    """Write tables of equal columns into one Parquet file."""
    import pyarrow

    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(pyarrow.concat_tables(tables), path)


def _episodes(content: Content) -> Iterator[tuple[str, dict[str, int]]]:
    """Yield the split and the samples by viewpoint of each episode, split by split.

    An episode is whole if all viewpoints see it.
    """
    reader = content.reader
    views = reader.categories("viewpoint")
    labels = ["split", *reader.spec.named_axes]
    labels = [name for name in labels if name in reader.arrays and name != "viewpoint"]
    # Samples that differ in nothing but the viewpoint are of one episode.
    episodes: dict[tuple[Any, ...], dict[str, int]] = {}
    all_views: set[str] = set()
    for slot in content.slots.tolist():
        key = tuple(reader.label(name)[slot].item() for name in labels)
        view = views[reader.label("viewpoint")[slot]]
        episodes.setdefault(key, {})[view] = slot
        all_views.add(view)
    whole = [(key[0], slots) for key, slots in episodes.items() if slots.keys() == all_views]
    if not whole:
        raise ValueError(
            f"an episode needs a clip of each of {', '.join(sorted(all_views))}, and no "
            f"simulation of this part of {content.name} has them all"
        )
    # LeRobot takes a split to be a range of episodes.
    for split, slots in sorted(whole, key=lambda episode: episode[0]):
        yield SPLITS[split], dict(sorted(slots.items()))


def _numbers(
    content: Content, slot: int, instants: Array
) -> tuple[dict[str, Array], dict[str, list[str]]]:
    """Return `action` and `observation.state` of the frames of a sample, and their names.

    Numbers are float32.
    """
    alone = np.array([slot])
    arrays = {array.name: array for array in content.arrays}

    def over_time(name: str) -> Array:
        return np.asarray(content.read(name, alone)[0][instants])

    # Holders: pose, and whether they hold.
    poses = _flat_poses(over_time("holder_pose"))
    grasped = over_time("grasped").astype(np.float32)
    holders = np.concatenate([poses, grasped[..., None]], axis=2).reshape(len(poses), -1)
    parts = [holders]
    action_names = _dotted(arrays["holder_pose"].attributes["names"], (*_POSE, "grasp"))
    names = list(action_names)

    if "body_pose" in arrays:
        parts.append(_flat_poses(over_time("body_pose")).reshape(len(holders), -1))
        names += _dotted(arrays["body_pose"].attributes["names"], _POSE)

    # Sheets: five vertices of each are tracked.
    for name in arrays:
        if name.endswith(".positions"):
            sheet = name.removesuffix(".positions")
            tracked = _tracked_vertices(content.read(f"{sheet}.rest", alone)[0])
            parts.append(over_time(name)[:, tracked].reshape(len(holders), -1))
            names += _dotted([f"{sheet}.{vertex}" for vertex in tracked], "xyz")

    # The action of a frame is the state of the holders at the next one.
    action = np.concatenate([holders[1:], holders[-1:]]).astype(np.float32)
    state = np.concatenate(parts, axis=1).astype(np.float32)
    return (
        {"action": action, "observation.state": state},
        {"action": action_names, "observation.state": names},
    )


def _dotted(owners: Sequence[str], parts: Sequence[str]) -> list[str]:
    """Return the names OWNER.PART of all parts of all owners."""
    names: list[str] = []
    for owner in owners:
        names += [f"{owner}.{part}" for part in parts]
    return names


def _tracked_vertices(rest: Array) -> list[int]:
    """Return the vertices at the corners and in the middle of a flat sheet (V, 2)."""
    low = rest.min(axis=0)
    high = rest.max(axis=0)
    points = [low, (high[0], low[1]), high, (low[0], high[1]), 0.5 * (low + high)]
    return [int(np.abs(rest - point).sum(axis=1).argmin()) for point in points]


def _flat_poses(poses: Array) -> Array:
    """Return poses (n, things, 3, 4) as positions and two columns of rotations.

    The shape is (n, things, 9).
    """
    return np.concatenate([poses[..., 3], poses[..., 0], poses[..., 1]], axis=-1)


def _table(frames: dict[str, Array], number: int, rate: Fraction) -> Any:
    """Return the frames of an episode, one a row."""
    import pyarrow

    length = len(frames["action"])
    index = np.arange(length, dtype=np.int64)
    columns: dict[str, Any] = {}
    for name, values in frames.items():
        width = values.shape[1]
        columns[name] = values.ravel()
        if width > 1:
            columns[name] = pyarrow.FixedSizeListArray.from_arrays(values.ravel(), width)
    columns |= {
        "timestamp": (index / float(rate)).astype(np.float32),
        "frame_index": index,
        "episode_index": np.full_like(index, number),
        "index": index + number * length,
        "task_index": np.zeros_like(index),
    }
    return pyarrow.table(columns)


def _statistics(values: Array) -> dict[str, Any]:
    """Return the statistics with which LeRobot normalises, of values (n, k): lists of k."""
    exact = values.astype(np.float64)
    statistics = {
        "min": exact.min(axis=0),
        "max": exact.max(axis=0),
        "mean": exact.mean(axis=0),
        "std": exact.std(axis=0),
    }
    lists = {name: value.tolist() for name, value in statistics.items()}
    return lists | {"count": [len(values)]}


def _merged(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the statistics of all episodes together, which have equally many values each."""

    def column(name: str) -> Array:
        return np.array([part[name] for part in parts])

    means = column("mean")
    mean = means.mean(axis=0)
    # The variance within episodes, and that of their means.
    variance = (column("std") ** 2 + (means - mean) ** 2).mean(axis=0)
    return {
        "min": column("min").min(axis=0).tolist(),
        "max": column("max").max(axis=0).tolist(),
        "mean": mean.tolist(),
        "std": np.sqrt(variance).tolist(),
        "count": column("count").sum(axis=0).tolist(),
    }


def _labels(content: Content, slot: int) -> dict[str, Any]:
    """Return the labels of an episode that are one number a sample.

    Categories are names, and not codes.
    """
    labels: dict[str, Any] = {}
    for array in content.labels:
        if not array.shape and array.name != "viewpoint":
            value = content.read(array.name, np.array([slot]))[0].item()
            labels[array.name] = str(array.categories[value]) if array.categories else value
    return labels


def _info(
    episodes: list[tuple[str, Any]],
    names: dict[str, list[str]],
    views: dict[str, Any],
    clock: _Clock,
) -> dict[str, Any]:
    """Return `info.json`; `views` are the features of the videos."""
    rate = float(clock.rate)
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [len(numbers)], "names": numbers}
        for name, numbers in names.items()
    }
    features |= views
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    features |= {name: {"dtype": "int64", "shape": [1], "names": None} for name in _COUNTERS}
    return {
        "codebase_version": "v3.0",
        "robot_type": "holders",
        "total_episodes": len(episodes),
        "total_frames": clock.length * len(episodes),
        "total_tasks": 1,
        "chunks_size": FILES,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": int(rate) if rate == int(rate) else rate,
        "splits": _split_ranges([split for split, _ in episodes]),
        "data_path": DATA,
        "video_path": VIDEO,
        "features": features,
    }


def _split_ranges(splits: list[str]) -> dict[str, str]:
    """Return the range of episodes of each split that has any, as FIRST:END."""
    ranges: dict[str, str] = {}
    first = 0
    for split in SPLITS:
        count = splits.count(split)
        if count:
            ranges[split] = f"{first}:{first + count}"
        first += count
    return ranges
