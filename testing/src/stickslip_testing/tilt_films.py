"""Films of a tray that is tilted until a cloth slides, as a phone in a hand would record them.

The cloth is simulated by the core on a plane whose gravity turns with the tray. A small renderer
plays the phone: flat things are textures that a homography warps, the cloth is a mesh of textured
triangles, and light casts shadows of the tray and of the cloth. Then come the lens, the rolling
shutter, noise and H.264. There is no blur of motion, and the tray's edges are flat colours.

Axes: z is up, and the table is at z = 0. The tray turns about its lower edge, the line x = z = 0.
Axes of the tray are those of the table while it lies level: x down the slope, z out of its face.

Needs PyAV, OpenCV and the core.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import plane
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_training.arrays import Array, Floats, SingleFloats
from stickslip_training.film.boards import CELLS, TABLE, TRAY, Board, marker_cells

Levels = npt.NDArray[np.uint8]
"""A picture, blue first."""

TRAY_X = (-0.46, 0.02)
TRAY_Y = (-0.17, 0.17)
"""Edges of the tray [m]."""
THICK = 0.012
"""Thickness of the tray [m]."""
SHEET = (0.21, 0.1485)
"""Half of an A4 sheet, on which a board is printed [m]."""
TRAY_BOARD_X = -0.37
"""Middle of the tray's board [m]."""
CLOTH_X = -0.16
"""Middle of the cloth, at rest [m]."""
CLOTH_SIDE = 0.18
"""[m]"""
CELLS_OF_CLOTH = 10
"""Cells along a side of the simulated cloth."""
RIM = 0.09
"""Distance after which the cloth lies at the rim of the tray [m]."""
SLID = 0.01
"""Distance at which the hand sees the cloth slide [m]."""
START_TIME = 0.5
"""Time in which the hand comes to its speed [s]."""
LOWERING = np.radians(20.0)
"""Speed at which the tray is laid back [rad/s]."""
DENSITY = 1500.0
"""Of textures [px/m]: about that of the largest frames, enlarged."""
ENLARGED = 1.5
"""Pixels of a drawn picture over those of the film, along a side: against jagged edges."""
NODE = 20
"""Distance at which light, lens and shutter are computed; they are smooth between [px]."""
TABLE_HALF = 0.9
"""Half of the side of the table [m]."""


@dataclass(frozen=True)
class Hand:
    """How the hand moves the tray, or the phone: sums of slow waves and a tremor."""

    seed: int
    size: float
    """Standard deviation of the slow motion."""
    tremor: float
    """Standard deviation of the tremor."""

    def at(self, time: float, channels: int) -> Floats:
        """Return the motion of some channels at a time [s], 0 at the time 0."""
        generator = np.random.default_rng(self.seed)
        slow = generator.uniform(0.15, 1.2, (channels, 4))
        fast = generator.uniform(6.0, 10.0, (channels, 2))
        phases = generator.uniform(0.0, 2 * np.pi, (channels, 6))

        def wave(t: float) -> Floats:
            parts = np.sin(2 * np.pi * np.hstack([slow, fast]) * t + phases)
            scale = np.array(4 * [self.size / np.sqrt(2.0)] + 2 * [self.tremor])
            return np.asarray(parts @ scale)

        return wave(time) - wave(0.0)


@dataclass(frozen=True)
class Take:
    """All that a film is made of."""

    seed: int
    mu: float
    """Static friction of cloth and tray."""
    ratio: float = 1.0
    """Static over kinetic friction."""
    fabric: str = "gray-interlock"
    rate: float = 3.0
    """Speed of the tilt [degree/s]."""
    level_time: float = 1.0
    """Time before the tilt, and after it [s]."""
    highest: float = 60.0
    """Tilt at which the hand gives up [degree]."""
    wave: float = 2e-4
    """Height of the waves in which the cloth is laid down [m]."""
    cloth_look: str = "checks"
    tray_look: str = "wood"
    table_look: str = "wood"
    width: int = 960
    height: int = 540
    frame_rate: int = 30
    focal: float = 0.8
    """Over the width of a frame."""
    k1: float = 0.0
    azimuth: float = 40.0
    """Of the camera, seen from the tray: 0 is down the slope [degree]."""
    elevation: float = 40.0
    """Of the camera [degree]."""
    margin: float = 0.08
    """Least distance of things from the edge of the frame, over its size."""
    shake: float = 1.0
    """Of the phone: 1 is a hand that moves it by 6 mm and 0.4 degrees."""
    readout: float = 0.015
    """Time in which the rolling shutter goes down a frame [s]."""
    noise: float = 2.5
    """Standard deviation of a pixel, of 255."""
    quality: int = 26
    """x264's constant rate factor: larger is worse."""
    light: float = 0.15
    """Share by which the light changes in the film."""
    boards: tuple[str, ...] = ("table", "tray")
    """The boards that lie there."""
    print_scale: float = 1.0
    """Size of the printed boards over the true one."""


@dataclass(frozen=True)
class Motion:
    """A simulated take."""

    times: Floats
    """Of the frames, (F,) [s]."""
    turns: Floats
    """Axes of the tray, (F, 3, 3)."""
    positions: Floats
    """Vertices of the cloth in axes of the tray, (F, V, 3) [m]."""
    rest: Floats
    """The flat cloth, (V, 2) [m], row by row: x grows with the rows, y along them."""
    slip_time: float
    """Time at which half of the cloth has moved by 0.1 mm [s]; NaN: it never does."""
    slip_tilt: float
    """Tilt of the tray at this time [rad]."""


@dataclass
class _Tilter:
    """The hand that tilts the tray: it goes on until it sees the cloth slide, and lays it back."""

    take: Take
    angle: float = 0.0
    stop_time: float = np.inf
    """Time at which the hand stops the tilt [s]."""

    def turn(self, time: float, step: float, slid: float) -> Floats:
        """Return the tray's axes at a time, when the cloth has slid so far [m]."""
        take = self.take
        wobble = Hand(take.seed + 1, 1.0, 0.0)
        since = time - take.level_time
        high = np.radians(take.highest)
        if np.isinf(self.stop_time) and (slid > SLID or self.angle >= high):
            # A hand needs a quarter of a second to answer.
            self.stop_time = time + 0.25
        if time > self.stop_time:
            self.angle = max(0.0, self.angle - LOWERING * step)
        elif since > 0:
            uneven = 1.0 + 0.15 * wobble.at(since, 1)[0]
            soft = min(1.0, since / START_TIME)
            self.angle = min(high, self.angle + np.radians(take.rate) * soft * uneven * step)
        sideways = 0.04 * self.angle * wobble.at(max(0.0, since), 2)[1]
        return Rotation.from_euler("YX", [self.angle, sideways]).as_matrix()

    @property
    def is_back(self) -> bool:
        """Return whether the tray lies level again."""
        return np.isfinite(self.stop_time) and self.angle == 0.0


def simulate(take: Take) -> Motion:
    """Simulate the cloth of a take on its tray."""
    mesh = meshes.grid(CLOTH_SIDE, CLOTH_SIDE, CELLS_OF_CLOTH, CELLS_OF_CLOTH)
    rest = np.asarray(mesh.rest) - np.mean(mesh.rest, axis=0)
    cloth = Cloth(mesh, fabric(take.fabric), preset_named("certified"))
    waves = 1.0 + np.sin(2 * np.pi * rest @ np.array([9.0, 13.0]))
    cloth.set_state(np.column_stack([rest, take.wave * waves]))
    tray = [replace(plane(take.mu / take.ratio), mu_static=take.mu)]
    hand = _Tilter(take)
    step = 1.0 / take.frame_rate
    start = np.array([])
    rows: list[tuple[float, Floats, Floats]] = []
    slip = (np.nan, np.nan)
    slid, time, level_since = 0.0, 0.0, 0.0
    for _ in range(round(0.5 / step)):
        cloth.step(step, bodies=tray)
    start = cloth.positions.copy()
    positions = start
    while level_since < take.level_time:
        turn = hand.turn(time, step, slid)
        if slid < RIM:
            cloth.gravity[:] = turn.T @ np.array([0.0, 0.0, -GRAVITY])
            cloth.step(step, bodies=tray)
            positions = cloth.positions.copy()
            slid = float(np.median(np.hypot(*(positions - start)[:, :2].T)))
        if np.isnan(slip[0]) and slid > 1e-4:
            slip = (time, float(np.arccos(turn[2, 2])))
        rows.append((time, turn, positions))
        time += step
        level_since = level_since + step if hand.is_back else 0.0
    times, turns, moved = (np.array(column) for column in zip(*rows, strict=True))
    order = np.lexsort((rest[:, 1], rest[:, 0]))
    return Motion(times, turns, moved[:, order], rest[order], *slip)


# --- textures


def _noise(generator: np.random.Generator, shape: tuple[int, int], sizes: Floats) -> SingleFloats:
    """Return noise of some sizes [px], along y and x, with mean 0 and deviation 1: (H, W)."""
    import cv2

    white = generator.standard_normal(shape).astype(np.float32)
    smooth = cv2.GaussianBlur(white, (0, 0), sigmaX=float(sizes[1]), sigmaY=float(sizes[0]))
    return np.asarray((smooth - smooth.mean()) / smooth.std(), dtype=np.float32)


def _coloured(values: SingleFloats, dark: Floats, bright: Floats) -> SingleFloats:
    share = np.clip(values, 0.0, 1.0)[..., None]
    return np.asarray((1 - share) * dark + share * bright, dtype=np.float32)


def _wood(generator: np.random.Generator, shape: tuple[int, int]) -> SingleFloats:
    values = 0.5 + 0.12 * _noise(generator, shape, np.array([2.0, 40.0]))
    return _coloured(values, np.array([0.1, 0.2, 0.32]), np.array([0.4, 0.6, 0.78]))


def _plain(generator: np.random.Generator, shape: tuple[int, int]) -> SingleFloats:
    level = generator.uniform(0.3, 0.75)
    values = level + 0.01 * _noise(generator, shape, np.array([3.0, 3.0]))
    return _coloured(values, np.zeros(3), generator.uniform(0.8, 1.0, 3))


def _stone(generator: np.random.Generator, shape: tuple[int, int]) -> SingleFloats:
    values = 0.5 + 0.15 * _noise(generator, shape, np.array([3.0, 3.0]))
    values += 0.1 * _noise(generator, shape, np.array([25.0, 25.0]))
    return _coloured(values, np.array([0.25, 0.25, 0.25]), np.array([0.8, 0.82, 0.85]))


def _weave(generator: np.random.Generator, shape: tuple[int, int], base: SingleFloats) -> Array:
    """Return a cloth: a base with the grain of its yarns and a hem."""
    grain = 1.0 + 0.05 * _noise(generator, shape, np.array([0.7, 2.0]))
    grain += 0.05 * _noise(generator, shape, np.array([2.0, 0.7]))
    cloth = base * grain[..., None].astype(np.float32)
    hem = round(0.008 * DENSITY)
    cloth[[hem, -hem]] *= 0.75
    cloth[:, [hem, -hem]] *= 0.75
    return cloth


def _cloth_plain(generator: np.random.Generator, shape: tuple[int, int]) -> Array:
    colour = generator.uniform(0.2, 0.9, 3)
    return _weave(generator, shape, np.broadcast_to(colour, (*shape, 3)).astype(np.float32))


def _cloth_stripes(generator: np.random.Generator, shape: tuple[int, int]) -> Array:
    rows, columns = np.mgrid[: shape[0], : shape[1]] / DENSITY
    angle = generator.uniform(0.0, np.pi)
    place = rows * np.cos(angle) + columns * np.sin(angle)
    values = (np.sin(2 * np.pi * place / generator.uniform(0.012, 0.03)) > 0).astype(np.float32)
    return _weave(generator, shape, _coloured(values, *generator.uniform(0.1, 0.95, (2, 3))))


def _cloth_checks(generator: np.random.Generator, shape: tuple[int, int]) -> Array:
    period = generator.uniform(0.012, 0.03)
    rows, columns = np.mgrid[: shape[0], : shape[1]] / DENSITY
    values = (0.5 * (np.sin(2 * np.pi * rows / period) > 0)).astype(np.float32)
    values += (0.5 * (np.sin(2 * np.pi * columns / period) > 0)).astype(np.float32)
    return _weave(generator, shape, _coloured(values, *generator.uniform(0.1, 0.95, (2, 3))))


def _cloth_print(generator: np.random.Generator, shape: tuple[int, int]) -> Array:
    size = generator.uniform(4.0, 12.0)
    blobs = _noise(generator, shape, np.array([size, size])) > 0.4
    colours = generator.uniform(0.1, 0.95, (2, 3))
    return _weave(generator, shape, _coloured(blobs.astype(np.float32), *colours))


Texture = Callable[[np.random.Generator, tuple[int, int]], Array]

LOOKS: dict[str, Texture] = {"wood": _wood, "plain": _plain, "stone": _stone}
"""Textures of tables and trays."""
CLOTH_LOOKS: dict[str, Texture] = {
    "plain": _cloth_plain,
    "stripes": _cloth_stripes,
    "checks": _cloth_checks,
    "print": _cloth_print,
}


def _paper(board: Board, scale: float) -> SingleFloats:
    """Return a printed half sheet, (H, W, 3), upper edge first."""
    dots = DENSITY * scale
    height, width = (round(side * dots) for side in SHEET[::-1])
    paper = np.full((height, width), 0.93, dtype=np.float32)
    for number, quad in zip(board.numbers, board.corners, strict=True):
        rows, columns = np.mgrid[:height, :width]
        x = (columns + 0.5) / dots - SHEET[0] / 2
        y = SHEET[1] / 2 - (rows + 0.5) / dots
        side = quad[1, 0] - quad[0, 0]
        across = np.floor((x - quad[0, 0]) / side * CELLS).astype(int)
        down = np.floor((quad[0, 1] - y) / side * CELLS).astype(int)
        inside = (across >= 0) & (across < CELLS) & (down >= 0) & (down < CELLS)
        cells = marker_cells(number)
        paper[inside] = np.where(cells[down[inside], across[inside]], 0.93, 0.06)
    return np.repeat(paper[..., None], 3, axis=2)


@dataclass(frozen=True)
class Flat:
    """A rectangle with a texture."""

    texture: Levels
    """(H, W, 3); rows go down the slope (x), columns to +y."""
    x: tuple[float, float]
    y: tuple[float, float]

    def pixels_of(self, points: Floats) -> Floats:
        """Return the places (N, 2) of points (N, 2) [m] in the texture [px]."""
        height, width = self.texture.shape[:2]
        column = (points[:, 1] - self.y[0]) / (self.y[1] - self.y[0]) * width - 0.5
        row = (points[:, 0] - self.x[0]) / (self.x[1] - self.x[0]) * height - 0.5
        return np.column_stack([column, row])

    @property
    def outline(self) -> Floats:
        """Return its corners in a circle, (4, 2) [m]."""
        (x0, x1), (y0, y1) = self.x, self.y
        return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])

    def lay(self, paper: Array, middle: Floats, angle: float, scale: float) -> "Flat":
        """Return this with a sheet of paper laid on it, whose upper edge is up the slope.

        The sheet is turned by an angle [rad], and `scale` times its true size.
        """
        import cv2

        height, width = paper.shape[:2]
        corners = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [-0.5, height - 0.5]])
        half = scale * np.array(SHEET) / 2
        # Columns of the paper run to +y, and rows down the slope.
        places = np.array([[-half[1], -half[0]], [-half[1], half[0]], [half[1], -half[0]]])
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        there = self.pixels_of(places @ turn.T + middle)
        affine = cv2.getAffineTransform(corners.astype(np.float32), there.astype(np.float32))
        size = self.texture.shape[1::-1]
        laid = cv2.warpAffine(paper, affine, size, flags=cv2.INTER_AREA)
        mask = cv2.warpAffine(np.ones((height, width), np.float32), affine, size)[..., None]
        mixed = (1 - mask) * self.texture + 255 * mask * laid
        return replace(self, texture=np.round(mixed).astype(np.uint8))


def _flat(look: Texture, seed: int, x: tuple[float, float], y: tuple[float, float]) -> Flat:
    shape = (round((x[1] - x[0]) * DENSITY), round((y[1] - y[0]) * DENSITY))
    return Flat(_levels(look(np.random.default_rng(seed), shape)), x, y)


def _levels(texture: Array) -> Levels:
    """Return a texture, 0 to 1, as levels, 0 to 255."""
    return np.round(255 * np.clip(texture, 0.0, 1.0)).astype(np.uint8)


# --- the phone


@dataclass(frozen=True)
class View:
    """A pinhole camera: a point p is at `rotation` p + `place` before it."""

    rotation: Floats
    place: Floats
    focal: float
    """[px]"""
    width: int
    height: int

    def pixels(self, points: Floats) -> Floats:
        """Return the pixels (N, 2) of points (N, 3) [m]."""
        x = points @ self.rotation.T + self.place
        middle = ((self.width - 1) / 2, (self.height - 1) / 2)
        return np.asarray(self.focal * x[:, :2] / x[:, 2:] + middle)

    def enlarged(self, factor: float) -> "View":
        """Return the camera with more pixels."""
        return replace(
            self,
            focal=self.focal * factor,
            width=round(self.width * factor),
            height=round(self.height * factor),
        )


@dataclass(frozen=True)
class Phone:
    """The phone of a take: its path in the hand."""

    take: Take
    target: Floats
    distance: float

    @staticmethod
    def of(take: Take, corners: Floats) -> "Phone":
        """Return a phone that is just so far away that it sees all corners (N, 3) [m]."""
        target = corners.mean(axis=0)
        size = np.array([take.width, take.height])
        for distance in np.arange(0.4, 3.0, 0.02):
            phone = Phone(take, target, float(distance))
            # The hand points the phone at the middle of what it films.
            for _ in range(5):
                view = phone.at(0.0)
                pixels = view.pixels(corners)
                off = (pixels.min(axis=0) + pixels.max(axis=0) - size) / 2
                turned = view.rotation[:2].T @ off * distance / view.focal
                phone = replace(phone, target=phone.target + turned)
            shares = phone.at(0.0).pixels(corners) / size
            if shares.min() > take.margin and shares.max() < 1 - take.margin:
                return phone
        raise AssertionError("no distance shows all")

    def at(self, time: float) -> View:
        """Return the camera at a time."""
        take = self.take
        a, e = np.radians((take.azimuth, take.elevation))
        outward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        rotation = np.stack([right, np.cross(-outward, right), -outward])
        moved = Hand(take.seed + 2, 0.006 * take.shake, 2e-4 * take.shake).at(time, 3)
        turned = Hand(take.seed + 3, 0.007 * take.shake, 3e-4 * take.shake).at(time, 3)
        rotation = Rotation.from_rotvec(turned).as_matrix() @ rotation
        place = -rotation @ (self.target + self.distance * outward + moved)
        return View(rotation, place, take.focal * take.width, take.width, take.height)


@dataclass
class Scene:
    """The things of a take, as they are drawn."""

    take: Take
    motion: Motion
    table: Flat = field(init=False)
    tray: Flat = field(init=False)
    cloth: Levels = field(init=False)
    light: Floats = field(init=False)
    phone: Phone = field(init=False)
    grain: SingleFloats = field(init=False)
    """Noise of a few frames, (4, H, W, 3)."""

    def __post_init__(self) -> None:
        take = self.take
        generator = np.random.default_rng(take.seed)
        sheet_scale = take.print_scale
        side = np.sign(take.azimuth) or 1.0
        middle = np.array([generator.uniform(-0.3, -0.15), side * generator.uniform(0.3, 0.34)])
        turn = generator.uniform(-0.4, 0.4)
        half = (-TABLE_HALF, TABLE_HALF)
        table = _flat(LOOKS[take.table_look], take.seed + 4, half, half)
        tray = _flat(LOOKS[take.tray_look], take.seed + 5, TRAY_X, TRAY_Y)
        if "table" in take.boards:
            table = table.lay(_paper(TABLE, 1.0), middle, turn, sheet_scale)
        if "tray" in take.boards:
            place = np.array([TRAY_BOARD_X, generator.uniform(-0.02, 0.02)])
            tray = tray.lay(_paper(TRAY, 1.0), place, generator.uniform(-0.1, 0.1), sheet_scale)
        self.table, self.tray = table, tray
        dots = round(CLOTH_SIDE * DENSITY)
        looks = CLOTH_LOOKS[take.cloth_look]
        self.cloth = _levels(looks(np.random.default_rng(take.seed + 6), (dots, dots)))
        self.light = np.array([*generator.uniform(-0.7, 0.7, 2), 1.0])
        self.light /= np.linalg.norm(self.light)
        shape = (4, take.height, take.width, 3)
        self.grain = take.noise * generator.standard_normal(shape, dtype=np.float32)
        # The highest place of the tray must be in sight, too.
        top = Rotation.from_euler("Y", np.arccos(self.motion.turns[:, 2, 2].min())).as_matrix()
        edges = np.column_stack([self.tray.outline, np.zeros(4)])
        around = 0.115 * sheet_scale * np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])
        board = np.column_stack([middle + around, np.zeros(4)])
        self.phone = Phone.of(take, np.concatenate([edges, edges @ top.T, board]))

    def pictures(self) -> Iterator[Array]:
        """Yield the frames, (H, W, 3), 0 to 255, blue first."""
        generator = np.random.default_rng(self.take.seed + 7)
        for frame, time in enumerate(self.motion.times):
            yield self._recorded(self._drawn(frame, float(time)), float(time), generator)

    def _drawn(self, frame: int, time: float) -> Array:
        """Return what a pinhole camera sees, (H, W, 3)."""
        import cv2

        view = self.phone.at(time).enlarged(ENLARGED)
        turn = self.motion.turns[frame]

        def on_tray(points: Floats) -> Floats:
            solid = np.zeros((len(points), 3))
            solid[:, : points.shape[1]] = points
            return np.asarray(solid @ turn.T + (0.0, 0.0, THICK))

        picture = _warped(self.table, view, lambda flat: np.column_stack([flat, 0 * flat[:, 0]]))
        outline = on_tray(self.tray.outline)
        shadow = self._shadow(outline, view)
        picture = cv2.multiply(picture, cv2.merge([shadow] * 3), scale=1 / 255)
        # The edges of the tray, which are darker than its face.
        low = outline - THICK * turn[:, 2]
        for first in range(4):
            second = (first + 1) % 4
            quad = np.stack([outline[first], outline[second], low[second], low[first]])
            cv2.fillConvexPoly(picture, np.round(view.pixels(quad)).astype(np.int32), (38, 51, 64))
        face = float(turn[:, 2] @ self.light) / float(self.light[2])
        shone = replace(self.tray, texture=self._tray_texture(frame, turn, 0.35 + 0.65 * face))
        picture = _warped(shone, view, on_tray, picture)
        self._draw_cloth(picture, frame, view, on_tray)
        return picture

    def _shadow(self, outline: Floats, view: View) -> Levels:
        """Return what the tray leaves of the table's light, (H, W), 255 is all."""
        import cv2

        # A soft shadow has no fine parts, so that a third of the pixels will do.
        small = view.enlarged(1 / 3)
        cast = outline - outline[:, 2:] / self.light[2] * self.light
        shadow = np.full((small.height, small.width), 255, dtype=np.uint8)
        corners = np.round(small.pixels(np.vstack([cast, outline * (1, 1, 0)])))
        hull = cv2.convexHull(corners.astype(np.int32))
        cv2.fillConvexPoly(shadow, hull, 115)
        soft = cv2.GaussianBlur(shadow, (0, 0), 2.5)
        return np.asarray(cv2.resize(soft, (view.width, view.height)), np.uint8)

    def _tray_texture(self, frame: int, turn: Floats, lit: float) -> Levels:
        """Return the lit tray's texture with the shadow that the cloth casts on it."""
        import cv2

        places = self.motion.positions[frame]
        side = CELLS_OF_CLOTH
        corners = np.array([0, side, (side + 1) ** 2 - 1, side * (side + 1)])
        light = turn.T @ self.light
        # Cloth is a millimetre thick, and its shadow that long.
        cast = places[corners, :2] + (CLOTH_X, 0.0) - 1.5e-3 * light[:2] / max(0.2, light[2])
        shadow = np.full(self.tray.texture.shape[:2], 255, dtype=np.uint8)
        outline = np.round(self.tray.pixels_of(cast)).astype(np.int32)
        cv2.fillConvexPoly(shadow, cv2.convexHull(outline), 128)
        soft = cv2.merge([cv2.GaussianBlur(shadow, (0, 0), 1.5)] * 3)
        return np.asarray(cv2.multiply(self.tray.texture, soft, scale=lit / 255), np.uint8)

    def _draw_cloth(
        self, picture: Levels, frame: int, view: View, on_tray: Callable[[Floats], Floats]
    ) -> None:
        """Draw the cloth into a picture: a homography, and what its vertices are off it."""
        import cv2

        side = CELLS_OF_CLOTH + 1
        solid = on_tray(self.motion.positions[frame] + (CLOTH_X, 0.0, 3e-4))
        pixels = view.pixels(solid)
        # Columns and rows of the texture: rows go down the slope.
        places = ((self.motion.rest / CLOTH_SIDE + 0.5) * len(self.cloth) - 0.5)[:, ::-1]
        matrix = cv2.findHomography(places, pixels)[0]
        off = pixels - cv2.perspectiveTransform(places[None], matrix)[0]
        grid = np.gradient(solid.reshape(side, side, 3), axis=(0, 1))
        normals = np.cross(grid[0], grid[1])
        lit = np.abs(normals @ self.light) / np.linalg.norm(normals, axis=-1) / self.light[2]
        known = np.dstack([off.reshape(side, side, 2), 0.35 + 0.65 * lit]).astype(np.float32)

        low = np.floor(pixels.min(axis=0)).astype(int).clip(0)
        high = np.ceil(pixels.max(axis=0)).astype(int) + 1
        window = picture[low[1] : high[1], low[0] : high[0]]
        rows, columns = np.mgrid[: window.shape[0], : window.shape[1]].astype(np.float64)
        there = np.stack([columns, rows], axis=-1) + low
        back = np.linalg.inv(matrix)
        place = cv2.perspectiveTransform(there, back)
        for _ in range(2):
            at = ((place + 0.5) / len(self.cloth) * (side - 1)).astype(np.float32)
            local = cv2.remap(
                known, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            place = cv2.perspectiveTransform(there - local[..., :2], back)
        inside = ((place > -0.5) & (place < len(self.cloth) - 0.5)).all(axis=-1)
        maps = place.astype(np.float32)
        yarn = cv2.remap(
            self.cloth,
            maps[..., 0],
            maps[..., 1],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        bright = np.clip(yarn * local[..., 2:], 0, 255).astype(np.uint8)
        window[inside] = bright[inside]

    def _recorded(self, picture: Array, time: float, generator: np.random.Generator) -> Array:
        """Return a frame of the film: light, lens, rolling shutter and noise."""
        import cv2

        take = self.take
        size = (take.width, take.height)
        small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        across, down = _bent(self.phone, time)
        bent = cv2.remap(small, across, down, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        columns, rows = _nodes(take)
        x = columns / take.width - 0.5
        y = (rows - take.height / 2) / take.width
        wave = Hand(take.seed + 8, take.light, 0.0).at(time, 3)
        # A person's soft shadow wanders through the picture.
        near = (x - wave[1] - 0.3) ** 2 + (y - wave[2]) ** 2
        light = (1 + wave[0]) * (1 - 0.6 * (x**2 + y**2))
        light *= 1 - 1.5 * take.light * np.exp(-near / 0.05)
        levels = bent * cv2.resize(light.astype(np.float32), size)[..., None]
        grain = self.grain[generator.integers(len(self.grain))]
        # Another place of the same noise each time costs a tenth of new noise.
        grain = np.roll(grain, tuple(generator.integers(0, 300, 2)), axis=(0, 1))
        levels += grain
        return np.asarray(cv2.convertScaleAbs(np.maximum(levels, 0, out=levels)), np.uint8)


def _warped(
    flat: Flat, view: View, place: Callable[[Floats], Floats], onto: Levels | None = None
) -> Levels:
    """Return a picture of a flat thing, (H, W, 3), drawn over another picture."""
    import cv2

    there = view.pixels(place(flat.outline)).astype(np.float32)
    source = flat.pixels_of(flat.outline).astype(np.float32)
    matrix = cv2.getPerspectiveTransform(source, there)
    size = (view.width, view.height)
    picture = np.zeros((view.height, view.width, 3), np.uint8) if onto is None else onto
    cv2.warpPerspective(
        flat.texture,
        matrix,
        size,
        dst=picture,
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_TRANSPARENT,
    )
    return picture


def _nodes(take: Take) -> tuple[Floats, Floats]:
    """Return columns and rows of a coarse grid, where `cv2.resize` has its sources [px]."""
    across, down = take.width // NODE, take.height // NODE
    columns = (np.arange(across) + 0.5) * take.width / across - 0.5
    rows = (np.arange(down) + 0.5) * take.height / down - 0.5
    grid = np.meshgrid(columns, rows)
    return grid[0], grid[1]


def _bent(phone: Phone, time: float) -> tuple[SingleFloats, SingleFloats]:
    """Return where each pixel of a frame is in the pinhole picture: the lens and the shutter."""
    import cv2

    take = phone.take
    view = phone.at(time)
    columns, rows = _nodes(take)
    middle = np.array([(take.width - 1) / 2, (take.height - 1) / 2])
    matrix = np.array([[view.focal, 0, middle[0]], [0, view.focal, middle[1]], [0, 0, 1.0]])
    pixels = np.stack([columns, rows], axis=-1)
    lens = np.array([take.k1, 0.0, 0.0, 0.0])
    flat = cv2.undistortPoints(pixels.reshape(-1, 1, 2), matrix, lens, P=matrix)
    flat = flat.reshape(pixels.shape)
    # The lowest row is read a few milliseconds later, when the phone has turned.
    later = phone.at(time + take.readout)
    rays = np.dstack([(flat - middle) / view.focal, np.ones(flat.shape[:2])])
    turned = rays @ (later.rotation @ view.rotation.T)
    moved = view.focal * turned[..., :2] / turned[..., 2:] + middle
    share = (rows / take.height)[..., None] - 0.5
    shift = (flat + share * (moved - flat) - pixels).astype(np.float32)
    smooth = cv2.resize(shift, (take.width, take.height))
    full_rows, full_columns = np.mgrid[: take.height, : take.width].astype(np.float32)
    return full_columns + smooth[..., 0], full_rows + smooth[..., 1]


def write_take(path: Path, take: Take) -> Motion:
    """Simulate and film a take; return what is true of it."""
    motion = simulate(take)
    scene = Scene(take, motion)
    write_pictures(path, scene.pictures(), take)
    return motion


def write_pictures(path: Path, pictures: Iterator[Array], take: Take) -> None:
    """Write frames (H, W, 3), blue first, as a film of H.264."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=take.frame_rate)
        stream.width, stream.height = take.width, take.height
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": str(take.quality), "preset": "veryfast"}
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode())
