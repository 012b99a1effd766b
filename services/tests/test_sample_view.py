"""The page of a sample of a scene: what its view in space shows, and curves with the names of its
things.
"""

from io import BytesIO
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from stickslip_schemas.format.manifest import layout
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.scene.library import built_in_files
from stickslip_schemas.spec.arrays import array
from stickslip_services.pages.browsing import thumbs
from stickslip_services.pages.choosing import sliders
from stickslip_services.pages.comparing import common_layers, label_rows, overlaid, timeline
from stickslip_services.pages.motion import deformed, motion
from stickslip_services.pages.pictures import coloured, mp4, shown_part
from stickslip_services.pages.sample_page import sample_view


def sample(values: dict[str, Any] | None = None, **spec: Any) -> Any:
    """Return the data of a sample that is 0 but for some values."""
    axes = {"texture": "checker", "viewpoint": "front"}
    parsed = job_spec_adapter.validate_python({"allow_uncertified": True, "axes": axes, **spec})
    arrays = {array.name: array for array in layout(parsed)}
    known = {name: np.zeros(array.shape, dtype=array.dtype) for name, array in arrays.items()} | (
        values or {}
    )
    return SimpleNamespace(
        arrays=arrays,
        manifest=SimpleNamespace(spec=parsed),
        read=lambda name, _slot: known[name],
        picture_size=lambda _slot: None,
        named=lambda array, value: array.categories[value] if array.categories else value.tolist(),
        store=SimpleNamespace(read=built_in_files().__getitem__),
    )


ON_CLOTH: dict[str, Any] = {
    "kind": "cloth_scene",
    "scene": "on-cloth",
    "set": {"sheets.cloth.mesh.cells": [4, 4], "sheets.stretched.mesh.cells": [4, 4]},
}


def test_a_scene_shows_its_sheets_and_the_forces_between_its_things() -> None:
    data = sample(**ON_CLOTH)
    arrays = data.arrays
    view = sample_view(data, 0)
    assert view["paths"]
    assert view["has_contact"]
    assert (view["layers"], len(view["frames"])) == (["video"], arrays["video"].shape[0])
    assert view["instants"] == arrays["cloth.positions"].shape[0]

    text = str(view["plots"])
    for name in ("cloth, floor", "cloth, stretched", "cloth.left", "stretched.frame"):
        assert name in text
    assert all(plot["timed"] for plot in view["plots"])
    assert list(view["groups"]) == ["Parameters", "Looks", "Physics", "Checks"]
    assert next(iter(view["groups"]["Parameters"])) == "fabric"
    assert {"psnr_cloth", "light"} <= set(view["groups"]["Looks"])
    assert {"stretch", "valid"} <= set(view["groups"]["Checks"])


def test_a_view_in_space_has_what_the_scene_has() -> None:
    view = motion(sample(**ON_CLOTH), 0)
    assert [(sheet["name"], len(sheet["contact"][0])) for sheet in view["sheets"]] == [
        ("cloth", 25),
        ("stretched", 25),
    ]
    assert [body["type"] for body in view["bodies"]] == ["plane"]
    assert len(view["holders"]) == 2  # and no rim
    assert (
        len(view["instants"])
        == len(view["sheets"][0]["points"])
        == len(view["bodies"][0]["poses"])
        == 300
    )

    edge: dict[str, Any] = {"scene": "over-the-edge", "set": {"sheets.strip.mesh.cells": [40, 4]}}
    view = motion(sample({"rounding": np.float64(0.02)}, kind="cloth_scene", **edge), 0)
    table, floor = sorted(view["bodies"], key=lambda body: str(body["type"]))
    assert (table["type"], table["rounding"], floor["type"]) == (
        "box",
        0.02,
        "plane",
    )  # the sample's own

    drag = {"material": "gray-interlock", "mu": 0.3, "texture": "dots", "viewpoint": "left"}
    track = np.zeros((300, 25, 3), np.float32)
    track[:, :, 2] = 0.12345
    rest = np.stack(np.meshgrid(range(5), range(5)), axis=-1).reshape(25, 2).astype(np.float32)
    view = motion(
        sample({"positions": track, "rest": rest}, kind="cloth_drag", mesh=5, axes=drag), 0
    )
    assert [body["type"] for body in view["bodies"]] == ["plane"]
    assert "contact" not in view["sheets"][0]
    assert view["sheets"][0]["points"][7][2] == pytest.approx(0.12345 / view["unit"], abs=0.5)
    assert [holder["poses"][0][11] for holder in view["holders"]] == pytest.approx(
        [0.12345, 0.12345]
    )


def test_a_great_list_is_filtered_by_names_numbers_and_pictures() -> None:
    count = 5 * 200 * 3
    axes = {
        "material": [
            "gray-interlock",
            "camel-ponte-roma",
            "royal-target",
            "navy-sparkle-sweat",
            "white-swim-solid",
        ],
        "mu": {"type": "linspace", "start": 0.0, "stop": 1.0, "num": 200},
        "texture": ["dots", "plaid", "floral"],
        "viewpoint": "left",
    }
    data = sample(kind="cloth_drag", axes=axes)
    points = list(data.manifest.spec.grid())
    columns = {
        name: np.array([point[name] for point in points]) for name in ("mu", "material", "texture")
    }
    for name in ("material", "texture"):
        columns[name] = np.array(
            [data.arrays[name].categories.index(value) for value in columns[name]]
        )
    columns |= {
        "split": np.arange(count) % 3,
        "valid": np.arange(count) > 0,
        "psnr_cloth": np.linspace(20, 40, count),
    }
    data.label, data.rejection, data.manifest.sample_count = (
        columns.__getitem__,
        lambda _slot: None,
        count,
    )

    def chosen(**query: str) -> int:
        return int(thumbs(data, query, 0)["chosen"])

    assert [len(axis["values"]) for axis in sliders(data.manifest.spec)] == [5, 101, 3]
    assert chosen() == count
    assert chosen(**{"material.from": "1", "material.to": "2"}) == 2 * 200 * 3
    assert chosen(**{"mu.from": "100"}) == 5 * 3  # the largest alone
    assert chosen(**{"mu.from": "2", "mu.to": "1"}) == 0
    assert chosen(valid="no") == 1
    bright = {"where0.label": "psnr_cloth", "where0.operator": ">=", "where0.value": "39.999"}
    assert chosen(**bright) == 1
    low = {"where1.label": "mu", "where1.operator": "<", "where1.value": "0.5"}
    assert chosen(**low) == 5 * 100 * 3 - 1  # the first is rejected
    assert chosen(**bright, **low) == 0
    assert "no valid sample" in thumbs(data, bright | low, 0)["fault"]
    wrong = {"where0.label": "psnr_cloth", "where0.operator": ">=", "where0.value": "bright"}
    assert "must be compared with a number" in thumbs(data, wrong, 0)["fault"]
    assert chosen(**{"mu.from": "-1"}) == count
    listed = thumbs(data, {"mu.from": "1", "mu.to": "99", **bright}, 0)
    lowest, highest = (sliders(data.manifest.spec)[1]["values"][stop] for stop in (1, 99))
    assert listed["pull_options"] == (
        f"--where 'mu>={lowest}' --where 'mu<={highest}' --where 'psnr_cloth>=39.999'"
    )
    by_psnr = {"sort": "psnr_cloth", "order": "descending"}
    assert [slot for slot, *_ in thumbs(data, by_psnr, 0)["thumbs"][:3]] == [2999, 2998, 2997]
    assert thumbs(data, {"sort": "psnr_cloth"}, 0)["thumbs"][0][0] == 1
    # Rejected samples come last.
    assert thumbs(data, {"sort": "psnr_cloth"}, 2976)["thumbs"][-1][0] == 0
    assert thumbs(data, {"sort": "nothing"}, 0)["thumbs"][0][0] == 0
    listed = thumbs(data, {"texture.from": "1", "texture.to": "1"}, 48)
    assert (len(listed["thumbs"]), listed["next_start"]) == (48, 96)
    assert {point["texture"] for _, point, _ in listed["thumbs"]} == {sorted(axes["texture"])[1]}


def test_a_long_motion_is_thinned() -> None:
    scene: dict[str, Any] = {"scene": "shawl", "set": {"duration": 9.0}}
    view = motion(sample(kind="cloth_scene", **scene), 0)
    figure = view["bodies"][0]
    assert 20 <= len(view["instants"]) < 136
    assert view["instants"][-1] == 135
    assert len(figure["points"]) == len(view["instants"])
    assert len(figure["points"][0]) == 3 * 1442


def test_a_body_of_triangles_follows_its_bones() -> None:
    still = np.concatenate([np.eye(3), np.zeros((3, 1))], axis=1)
    raised = still.copy()
    raised[2, 3] = 2.0
    skin = {
        "rest": np.zeros((2, 3)),
        "weights": np.array([[1.0, 0.0], [0.5, 0.5]]),
        "times": np.array([0.0, 1.0]),
    }
    bones = np.array([[still, still], [still, raised]])
    heights = deformed({**skin, "bones": bones}, 3.0, np.array([0.0, 0.5, 9.0]))[:, :, 2]
    assert heights.tolist() == [[0.0, 0.0], [0.0, 1.5], [0.0, 3.0]]
    assert deformed(
        {"positions": np.ones((1, 4, 3)), "times": np.zeros(1)}, 1.0, np.arange(3.0)
    ).shape == (3, 4, 3)


def test_a_film_shows_the_frames_of_the_clip() -> None:
    av = pytest.importorskip("av", reason="make setup-dev")
    # H.264 for browsers has even sides only: an odd picture gets its last row and column twice.
    frames = [np.full((223, 129, 3), level, np.uint8) for level in (20, 120, 220)]
    with av.open(BytesIO(mp4(frames))) as film:
        assert (film.streams.video[0].average_rate, film.streams.video[0].codec_context.name) == (
            10,
            "h264",
        )
        pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
        levels = [picture.mean() for picture in pictures]
    assert pictures[0].shape == (224, 130, 3)
    assert levels == pytest.approx([20, 120, 220], abs=3)


def test_ground_truth_is_shown_in_colours() -> None:
    y_x = {"frame": 2, "y": 1, "x": 2}
    flow = np.array([[[[0.0, 2.0], [-1.0, 0.0]]]] * 2, dtype=np.float16)
    (picture,) = coloured(array("flow", "", "float16", y_x | {"xy": 2}), flow, [1])
    assert picture.tolist() == [[[127, 255, 127], [63, 127, 127]]]
    depth = np.array([[[1.0, np.inf]], [[3.0, 2.0]]], dtype=np.float32)
    near, far = coloured(array("depth", "", "float32", y_x), depth, [0, 1])
    assert near.tolist() == [[[0, 0, 0], [0, 0, 0]]]
    assert far.tolist() == [[[255] * 3, [127] * 3]]
    codes = array(
        "segmentation", "", "uint8", y_x, attributes={"categories": ["background", "cloth"]}
    )
    (segments,) = coloured(codes, np.array([[[0, 1]]] * 2, dtype=np.uint8), [0])
    assert len(np.unique(segments, axis=1)[0]) == 2


def test_only_the_part_of_a_frame_with_the_picture_is_shown() -> None:
    frames = np.arange(2 * 3 * 4, dtype=np.float32).reshape(2, 3, 4)
    depth = array("depth", "", "float32", {"frame": 2, "y": 3, "x": 4})
    assert shown_part(depth, frames, np.array([2, 3])).shape == (2, 3, 2)
    assert shown_part(depth, frames, None) is frames
    assert shown_part(array("mu", "friction"), frames[0, 0, 0], np.array([2, 3])).shape == ()


def test_samples_of_two_datasets_share_time_layers_curves_and_differences() -> None:
    """Also of two kinds, with other motions, other ground truth and other labels."""
    drag = {"material": "gray-interlock", "mu": 0.3, "texture": "dots", "viewpoint": "left"}
    dragged = sample(kind="cloth_drag", mesh=5, axes=drag, ground_truth=["depth"])
    on_cloth = sample(**ON_CLOTH)
    views = [
        {**sample_view(dragged, 0), "title": "sample 0 of drag"},
        {**sample_view(on_cloth, 0), "title": "sample 0 of cloth"},
    ]
    assert [view["layers"] for view in views] == [["video", "depth"], ["video"]]
    assert common_layers(views) == common_layers(views[::-1]) == ["video"]
    last = [(view["instants"] - 1) / view["rate"] for view in views]
    for order in (views, views[::-1]):
        cursor = timeline(order)
        assert cursor.rate == order[0]["rate"]
        assert 0 <= (cursor.instants - 1) / cursor.rate - max(last) < 1 / cursor.rate

    rows = {row.name: row for group in label_rows(views).values() for row in group}
    assert rows["material"].values[1] == "–"
    assert rows["fabric"].values[0] == "–"
    assert "light" not in rows  # both have it, with one value

    twice = [views[0], {**views[0], "title": "sample 1 of other"}]
    assert label_rows(twice) == {}
    for joined, single in zip(overlaid(twice), views[0]["plots"], strict=True):
        names = [name for part in joined["tables"] for name in part["curves"]]
        of_one = [name for part in single["tables"] for name in part["curves"]]
        titles = ("sample 0 of drag", "sample 1 of other")
        assert names == [f"{title}: {name}" for title in titles for name in of_one]
        assert [part["dashed"] for part in joined["tables"]] == [False, True]
    # What only one of them has is a plot of its own.
    plots = {of_sample["name"] for view in views for of_sample in view["plots"]}
    assert {joined["name"] for joined in overlaid(views)} == plots
    forces = next(joined for joined in overlaid(views) if joined["name"] == "contact_force")
    assert "; sample 0 of cloth: contact_force: " in forces["y"]
