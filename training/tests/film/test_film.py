"""Rendered films of a tray that is tilted: answers, and films that cannot be measured."""

import json
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from stickslip_schemas.spec.cameras import load_rig
from stickslip_testing.films import meshes_at, write_film
from stickslip_testing.tilt_films import Scene, Take, simulate, write_pictures
from stickslip_training.cli import app
from stickslip_training.cloth.clips import INSTANTS, RATE
from stickslip_training.cloth.crop import ANCHOR, Cameras, Crops
from stickslip_training.cloth.render import refine, splat
from stickslip_training.cloth.runs import load_runs
from stickslip_training.film.boards import BOARDS, Sight
from stickslip_training.film.drag import START_LINE, read_drag
from stickslip_training.film.measuring import FilmError, measure_film
from stickslip_training.film.poses import Lens, Pose
from typer.testing import CliRunner

pytest.importorskip("av")
torch = pytest.importorskip("torch")
pytest.importorskip("cv2")
pytest.importorskip("matplotlib")

RUNS = Path(__file__).parents[1] / "cloth/runs.npz"

pytestmark = pytest.mark.physics  # films are drawn, written and measured

TAKE = Take(
    seed=40,
    mu=0.25,
    ratio=1.15,
    rate=6.0,
    level_time=0.4,
    width=640,
    height=360,
    frame_rate=24,
    quality=24,
    margin=0.05,
)


def filmed(path, take, frames=None):
    motion = simulate(take)
    write_pictures(path, islice(Scene(take, motion).pictures(), frames), take)
    return motion


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("films")


@pytest.fixture(scope="module")
def film(folder):
    """A film, and what is true of it."""
    path = folder / "film.mp4"
    return path, filmed(path, TAKE)


def command(*arguments):
    return CliRunner().invoke(app, ["film", *map(str, arguments)])


def test_the_tilt_at_slip_and_mu_are_those_of_the_scene(film, tmp_path):
    path, motion = film
    done = command(path, "--json", tmp_path / "a.json", "--picture", tmp_path / "a.png")
    assert done.exit_code == 0, done.output
    answer = json.loads((tmp_path / "a.json").read_text())
    true = np.degrees(np.arctan(TAKE.mu))
    assert answer["slip"]["tilt_degrees"] == pytest.approx(true, abs=0.5)
    assert answer["mu"]["median"] == pytest.approx(TAKE.mu, abs=0.02)
    assert answer["mu"]["low"] < answer["mu"]["median"] < answer["mu"]["high"]
    assert answer["slip"]["time"] == pytest.approx(motion.slip_time, abs=0.1)
    assert answer["camera"]["focal_px"] == pytest.approx(TAKE.focal * TAKE.width, rel=0.05)
    assert answer["drag"]["mu"] is None
    assert "the film has no drag: it goes on for" in answer["drag"]["no_answer"]
    assert "static mu" in done.output
    assert "drag: no answer: the film has no drag" in done.output
    assert (tmp_path / "a.png").read_bytes()[:4] == b"\x89PNG"
    by_focal = measure_film(path, focal=TAKE.focal * TAKE.width)
    assert np.degrees(by_focal.slip.tilt.angle) == pytest.approx(true, abs=0.5)


def test_a_cloth_that_stays_has_a_mu_above_the_steepest_tilt(folder):
    path = folder / "stays.mp4"
    filmed(path, replace(TAKE, mu=0.8, highest=9.0, rate=9.0))
    done = command(path, "--json", "-")
    assert done.exit_code == 3
    answer = json.loads(done.output)
    assert answer["slip"] is None
    assert answer["mu"]["median"] is None
    assert answer["mu"]["above"] == pytest.approx(np.tan(np.radians(9.0)), abs=0.02)
    assert "the cloth must slide, and stays up to a tilt of" in answer["no_answer"]


@pytest.mark.parametrize(
    ("boards", "message"),
    [
        ((), "boards: 30 frames or more must show both boards .* and 0 do .*stickslip film marker"),
        (("table",), "the board of the table in 34 of 34, the board of the tray in 0 of 34"),
        (("table", "tray"), "tilt: the tray must be tilted by 4 degrees or more, and is tilted by"),
    ],
)
def test_films_without_boards_or_tilt_are_refused(folder, boards, message):
    path = folder / f"boards-{len(boards)}.mp4"
    filmed(path, replace(TAKE, boards=boards, level_time=2.0), frames=34)
    with pytest.raises(FilmError, match=message):
        measure_film(path)


def test_what_is_no_film_is_refused(tmp_path):
    for name, content in (("empty.mp4", b""), ("text.mp4", b"no film " * 100)):
        (tmp_path / name).write_bytes(content)
        done = command(tmp_path / name)
        assert done.exit_code == 1
        assert "must be a video that FFmpeg reads" in " ".join(done.output.split())
    assert command(tmp_path / "none.mp4").exit_code == 1
    assert command(tmp_path / "empty.mp4", "--focal", "0").exit_code == 2


def test_the_drag_of_a_film_is_read_by_the_network(film, folder):
    """The tray's board gives the camera of a rig of ours, and the network gets its clip."""
    camera = next(camera for camera in load_rig("drag") if camera.name == "calibrated")
    path = folder / "drag.mp4"
    runs = load_runs(RUNS)
    run = runs[np.flatnonzero(runs.mu > 0.4)[:1]]
    seconds = np.arange(-0.5, INSTANTS[-1] / RATE + 1.0, 1 / 9)
    pictures = []
    lines = torch.linspace(0, 1, 112)
    checks = 0.35 + 0.3 * ((lines[:, None] * 20).floor() + (lines * 20).floor()).remainder(2)
    for mesh in torch.from_numpy(meshes_at(run, seconds)).split(32):
        fine = refine(mesh[None], 112)
        whole = Crops(torch.tensor(ANCHOR[::-1]).expand(1, len(mesh), 2), torch.ones(1, len(mesh)))
        colours = checks.expand(fine.shape[:-1])
        alpha, colour = splat(fine, colours, Cameras.of([camera]), whole, size=(224, 224))
        pictures.append((alpha * colour + (1 - alpha) * 0.05)[0].numpy())
    coloured = (np.repeat(255 * each[..., None], 3, axis=2) for each in np.concatenate(pictures))
    still = np.zeros((len(seconds), 2))
    write_film(path, coloured, camera, rate=9, distortion=(0.0,) * 5, shake=still)

    axes = np.column_stack([(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
    rotation = np.array(camera.rotation) @ axes.T
    place = np.array(camera.translation) - rotation @ (0.0, -START_LINE, 0.0)
    lens = Lens(camera.width, camera.height, camera.fx, 1.0)
    points = BOARDS[1].corners.reshape(-1, 2)
    sight = Sight(points, Pose(rotation, place, points).pixels(points, lens))
    tilted = measure_film(film[0])
    end = float(seconds[-1] - seconds[0])
    sightings = replace(
        tilted.sightings,
        times=np.zeros(1),
        sights=[dict.fromkeys(("table", "tray"), sight)],
        end=end,
    )
    film_of_drag = replace(
        tilted,
        path=path,
        lens=lens,
        sightings=sightings,
        downhill=np.array([0.0, -1.0]),
    )
    drag = read_drag(film_of_drag, 0.0)
    # Either is an answer of the network: the clip of a coarse mesh may be unlike those of training.
    assert drag.mu is not None or "unlike" in str(drag.no_answer)
    late = read_drag(film_of_drag, end - 10.0)
    assert late.mu is None
    assert "the film has no drag: it goes on for 10.0 s" in str(late.no_answer)
