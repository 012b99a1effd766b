"""Parts of the measurement of a film: sheet, boards, camera, offsets and the onset of a slide."""

from dataclasses import replace

import numpy as np
import pytest
from stickslip_training.film.boards import (
    BOARDS,
    CELLS,
    GAP,
    MARKER,
    TABLE,
    TRAY,
    Sight,
    marker_cells,
)
from stickslip_training.film.drag import START_LINE, scene_camera
from stickslip_training.film.finder import Finder
from stickslip_training.film.onset import onset_of, square_max
from stickslip_training.film.poses import Lens, Pose, calibrated, pose_of
from stickslip_training.film.sheet import BAR, PAGE, sheet, write_sheet
from stickslip_training.film.sliding import PIXEL, REACH, Ground, slide_of
from stickslip_training.film.tilt import jumps, tilt_at, tilts_of

cv2 = pytest.importorskip("cv2")
pytest.importorskip("matplotlib")

LENS = Lens(960, 540, 800.0, 0.0)


def turned(degrees_x, degrees_y=0.0, degrees_z=0.0):
    """Return the rotation of a board that looks at the camera, turned about its axes."""
    facing = np.diag([1.0, -1.0, -1.0])
    turn = cv2.Rodrigues(np.radians([degrees_x, 0.0, 0.0]))[0]
    turn = turn @ cv2.Rodrigues(np.radians([0.0, degrees_y, 0.0]))[0]
    return facing @ turn @ cv2.Rodrigues(np.radians([0.0, 0.0, degrees_z]))[0]


def sight_of(board, rotation, place, lens=LENS, noise=0.0, seed=0):
    points = board.corners.reshape(-1, 2)
    pixels = Pose(rotation, np.array(place), points).pixels(points, lens)
    return Sight(points, pixels + np.random.default_rng(seed).normal(0.0, noise, pixels.shape))


def test_the_markers_of_the_printed_sheet_are_found_where_they_belong():
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    dots = 200 / 0.0254  # [1/m]
    canvas = FigureCanvasAgg(sheet())
    canvas.figure.set_dpi(200)
    canvas.draw()
    grey = cv2.cvtColor(np.asarray(canvas.buffer_rgba())[..., :3].copy(), cv2.COLOR_RGB2GRAY)
    sights = Finder().find(grey)
    assert set(sights) == {"table", "tray"}
    for board, middle in ((TRAY, 0.75), (TABLE, 0.25)):
        places = (sights[board.name].pixels + 0.5) / dots
        x = places[:, 0] - PAGE[0] / 2
        y = (1 - middle) * PAGE[1] - places[:, 1]
        assert np.column_stack([x, y]) == pytest.approx(sights[board.name].points, abs=2e-4)


def photograph(board, plane, dots=4000.0, finer=4):
    """Return a blurred picture of a board on white paper that `plane` takes to pixels."""
    paper = np.full((round(0.14 * dots), round(0.2 * dots)), 230, np.uint8)
    cell = round(MARKER / CELLS * dots)
    for number, quad in zip(board.numbers, board.corners, strict=True):
        left, down = np.round((quad[0] * (1, -1) + (0.1, 0.07)) * dots).astype(int)
        cells = np.kron(marker_cells(number), np.ones((cell, cell), np.uint8))
        paper[down : down + len(cells), left : left + len(cells)] = 20 + 210 * cells
    to_board = np.array([[1, 0, 0.5 - 0.1 * dots], [0, -1, 0.07 * dots - 0.5], [0, 0, dots]])
    enlarged = np.array([[finer, 0, finer / 2 - 0.5], [0, finer, finer / 2 - 0.5], [0, 0, 1]])
    large = cv2.warpPerspective(
        paper, enlarged @ plane @ to_board, (640 * finer, 360 * finer), borderValue=120
    )
    small = cv2.resize(large, (640, 360), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small, (0, 0), 0.8)


@pytest.mark.parametrize("tilt", [10.0, 50.0])
def test_blur_does_not_shift_the_places_of_a_board(tilt):
    lens = Lens(640, 360, 520.0, 0.0)
    rotation = turned(-tilt, 20.0)
    pose = np.column_stack([rotation[:, :2], [0.02, -0.03, 0.6]])
    plane = lens.matrix @ pose
    sight = Finder().find(photograph(TRAY, plane))[TRAY.name]
    true = cv2.perspectiveTransform(sight.points[None], plane)[0]
    assert len(sight.points) == 24
    assert np.hypot(*(sight.pixels - true).T).max() < 0.1
    # By the corners that the search for markers gives, it is turned by 0.1 degrees or more.
    normal = pose_of(sight, lens).rotation[:, 2]
    assert np.degrees(np.arccos(normal @ rotation[:, 2])) < 0.05


def test_the_sheet_is_a4_and_its_bar_has_the_stated_length(tmp_path):
    write_sheet(tmp_path / "sheet.pdf")
    data = (tmp_path / "sheet.pdf").read_bytes()
    box = data.split(b"/MediaBox [", 1)[1].split(b"]", 1)[0].split()
    points = 72 / 0.0254
    assert [float(edge) for edge in box] == pytest.approx(
        [0, 0, PAGE[0] * points, PAGE[1] * points], abs=0.01
    )
    bars = [patch.get_bbox() for patch in sheet().axes[0].patches]
    assert max(bar.x1 for bar in bars) - min(bar.x0 for bar in bars) == pytest.approx(BAR)
    with pytest.raises(ValueError, match=r"out: must be a file whose name ends with \.pdf"):
        write_sheet(tmp_path / "sheet.png")


def test_boards_share_no_marker_and_markers_have_their_size():
    assert not set(TABLE.numbers) & set(TRAY.numbers)
    for board in BOARDS:
        sides = np.diff(board.corners, axis=1)
        assert np.hypot(*np.moveaxis(sides, -1, 0)) == pytest.approx(MARKER)
        assert board.corners[1, 0, 0] - board.corners[0, 1, 0] == pytest.approx(GAP)
        assert board.corners.mean(axis=(0, 1)) == pytest.approx(0.0, abs=1e-12)


def test_the_tilt_is_the_angle_between_the_boards_whatever_the_camera_and_the_print_scale():
    for scale in (1.0, 0.7):
        angles = []
        for number, tilt in enumerate((0.0, 12.0, 30.0)):
            camera = cv2.Rodrigues(np.array([0.05, -0.03, 0.02]) * number)[0]
            level = camera @ turned(-50, 10)
            lifted = level @ cv2.Rodrigues(np.radians([0.0, tilt, 0.0]))[0]
            places = (scale * np.array([-0.1, 0.0, 0.9]), scale * np.array([0.15, 0.0, 1.0]))
            sights = {
                board.name: sight_of(board, rotation, place / scale)
                for board, rotation, place in zip(BOARDS, (level, lifted), places, strict=True)
            }
            angles.append(tilts_of(np.zeros(1), [sights], LENS).angles[0])
        assert np.degrees(angles) == pytest.approx([0.0, 12.0, 30.0], abs=1e-3)


def test_the_focal_length_comes_from_boards_that_are_seen_obliquely():
    lens = replace(LENS, focal=715.0, k1=-0.03)
    sights = [
        sight_of(TRAY, turned(-45 + tilt, 20), (0.1, 0.0, 0.8), lens, 0.2, tilt)
        for tilt in range(0, 40, 2)
    ]
    lens_by_boards = calibrated(sights, lens.width, lens.height)
    assert lens_by_boards.focal == pytest.approx(715, abs=3 * lens_by_boards.focal_sd)
    assert lens_by_boards.focal_sd < 15
    assert lens_by_boards.noise == pytest.approx(0.2, rel=0.3)
    frontal = [
        sight_of(TRAY, turned(0.2 * number), (0.0, 0.0, 0.8), lens, 0.2, number)
        for number in range(20)
    ]
    assert calibrated(frontal, lens.width, lens.height).focal_sd > 5 * lens_by_boards.focal_sd


def test_a_pose_is_that_of_its_corners():
    rotation, place = turned(-50, 15, 30), np.array([0.1, -0.05, 0.9])
    pose = pose_of(sight_of(TABLE, rotation, place), LENS)
    assert pose.rotation == pytest.approx(rotation, abs=1e-4)
    assert pose.place == pytest.approx(place, abs=1e-4)


@pytest.mark.parametrize(("square", "cube"), [(0.0, 0.06), (0.6, 0.06), (1.3, 0.0)])
def test_the_slide_tells_its_beginning(square, cube):
    generator = np.random.default_rng(3)
    errors = []
    for _ in range(20):
        begin = generator.uniform(2.0, 2.1)
        times = np.arange(0.0, 3.0, 1 / 30)
        since = np.clip(times - begin, 0.0, None)
        offsets = 1e-3 + square * since**2 + cube * since**3
        offsets += generator.normal(0.0, 2e-4, len(times))
        until = int(np.argmax(offsets > 0.012)) + 1 or len(times)
        onset = onset_of(times[:until], offsets[:until], cube)
        errors.append((onset.time - begin) / onset.sd)
        assert onset.time == pytest.approx(begin, abs=0.15)
    assert np.mean(np.abs(errors) < 2.5) > 0.8


def test_a_cloth_cannot_leap():
    # From mu 1 to a kinetic friction of 0.5 at 45 degrees: g (sin - 0.5 cos) = 2 a.
    assert 2 * square_max(np.pi / 4) == pytest.approx(9.81 * 0.5 * np.sqrt(0.5))


def seen_from_above(ground, cloth, shift, generator, edge=0):
    """Return a view of a tray with a printed cloth that has slid [px], and a creeping edge."""
    height, width = ground.shape
    view = np.full((height, width), 120.0)
    top, left, side = 150, 80, len(cloth)
    view[top + shift : top + shift + side, left : left + side] = cloth
    if edge:
        # The lower edge alone creeps down, by so many pixels.
        band = slice(top + side - 12, top + side)
        view[band.start + edge : band.stop + edge, left : left + side] = cloth[-12:]
    return np.clip(view + generator.normal(0, 2, view.shape), 0, 255).astype(np.uint8)


def printed_cloth(size=40.0):
    """Return a cloth with a pattern of some contrast, (140, 140)."""
    noise = np.random.default_rng(1).normal(0, 4, (140, 140))
    return 120 + size * cv2.GaussianBlur(noise, (0, 0), 3)


def slid(edges, shifts, cloth=None):
    generator = np.random.default_rng(0)
    ground = Ground(np.array([0.0, -1.0]))
    cloth = printed_cloth() if cloth is None else cloth
    views = [
        seen_from_above(ground, cloth, shift, generator, edge)
        for shift, edge in zip(shifts, edges, strict=True)
    ]
    times = np.arange(len(views)) / 30
    level = np.mean(views[:5], axis=0).astype(np.float32)
    return slide_of(times, np.linspace(0.0, 0.4, len(views)), views, ground, level)


def test_a_cloth_that_slides_is_followed_and_creeping_edges_are_no_slide():
    shifts = np.array([0] * 30 + [1, 2, 4, 6, 9, 12, 16, 20, 25, 30])
    moving = slid(np.zeros(40, int), shifts)
    slide = moving.slide
    assert slide is not None
    assert not moving.stayed
    frames = np.round(slide.times * 30).astype(int)
    assert slide.offsets == pytest.approx(PIXEL * shifts[frames], abs=5e-4)
    assert slide.together > 0.8
    assert slid(np.minimum(np.arange(40) // 2, 15), np.zeros(40, int)).slide is None
    assert shifts.max() < REACH


def striped_cloth():
    """Return a cloth with stripes across the slope, 18 px apart, (140, 140)."""
    stripes = 40 * (np.arange(140) % 18 < 9)[:, None]
    return 100 + stripes + np.random.default_rng(1).normal(0, 3, (140, 140))


@pytest.mark.parametrize("cloth", [striped_cloth(), printed_cloth(6.0)])
def test_a_cloth_with_stripes_and_a_faint_one_are_followed(cloth):
    shifts = np.array([0] * 30 + [1, 2, 4, 6, 8, 10, 12, 15, 18, 21])
    slide = slid(np.zeros(40, int), shifts, cloth).slide
    assert slide is not None
    assert slide.patches > 20
    assert slide.together > 0.8
    frames = np.round(slide.times * 30).astype(int)
    assert slide.offsets == pytest.approx(PIXEL * shifts[frames], abs=1e-3)


def test_a_cloth_stays_only_if_it_is_seen_at_its_place():
    resting = slid(np.zeros(40, int), np.zeros(40, int))
    assert resting.slide is None
    assert resting.stayed
    # It jumps beyond the reach, so no slide is seen.
    gone = slid(np.zeros(40, int), np.array([0] * 30 + [REACH + 60] * 10))
    assert gone.slide is None
    assert gone.left > 0.5 * gone.patches
    assert not gone.stayed


def test_a_frame_whose_pose_is_the_other_one_is_left_out():
    angles = np.radians(np.linspace(0.0, 20.0, 60))
    wrong = angles.copy()
    wrong[[0, 17, 30]] += np.radians([9.0, 70.0, -12.0])
    assert np.flatnonzero(jumps(wrong)).tolist() == [0, 17, 30]
    assert not jumps(angles).any()
    assert not jumps(angles[:1]).any()


def test_too_few_frames_at_the_slip_are_refused():
    rotation = turned(-50)
    sights = {board.name: sight_of(board, rotation, (0, 0, 0.9)) for board in BOARDS}
    tilts = tilts_of(np.array([0.0, 1.0, 1.1]), [sights] * 3, LENS)
    with pytest.raises(ValueError, match="boards: both must be in sight in 5 frames or more"):
        tilt_at(tilts, 1.1)


def test_the_camera_of_a_drag_begins_at_the_start_line():
    downhill = np.array([0.0, -1.0])
    pose = Pose(turned(-50, 15), np.array([0.1, -0.05, 0.9]), np.zeros((1, 2)))
    camera = scene_camera(pose, LENS, downhill)
    scene = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.1, 0.2]])
    board = np.array([[0.0, -START_LINE, 0.0], [0.0, -START_LINE - 0.3, 0.0], [0.1, -0.2, 0.2]])
    assert camera.project(scene)[0] == pytest.approx(pose.pixels(board, LENS), abs=1e-6)
