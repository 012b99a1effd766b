"""Friction from a film: the tilt of the tray at which the cloth begins to slide, mu = tan(tilt)."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from stickslip_training.arrays import Array, Floats, SingleFloats
from stickslip_training.cloth.video import VideoError, read_frames
from stickslip_training.film.boards import BOARDS, Sight
from stickslip_training.film.finder import Finder
from stickslip_training.film.onset import Onset, clear_motion, growth, onset_of, square_max
from stickslip_training.film.poses import Lens, calibrated
from stickslip_training.film.sliding import Ground, Motion, Slide, mean_view, slide_of
from stickslip_training.film.tilt import TiltAt, Tilts, tilt_at, tilts_of

KEY_FRAMES = 24
"""Frames that the camera is calibrated by: more change it by less than its error."""
BOTH_MIN = 30
"""Fewest frames with both boards: a second of a film."""
TILT_MIN = np.radians(4.0)
"""Least tilt of a tray that was tilted [rad]: a mu of 0.07."""
LEVEL = np.radians(3.0)
"""Tilt below which the tray lies level [rad]."""
RISEN = np.radians(1.0)
"""Rise of the tilt that ends the level part of a film [rad]: thrice the error of a frame."""
LEVEL_FRAMES = 20
"""Most frames that the level view is the mean of."""
STEEP = np.radians(5.0)
"""Tilt from which the direction of the slope is seen well [rad]."""
AFTER_PEAK = 0.2
"""Time after the steepest frame that is looked at [s]: the cloth may begin to slide there."""
BOARD_SD = np.radians(0.12)
"""Standard deviation of the tilt besides noise, by shutter, compression and print [rad]: the error
left in 40 rendered films that judge nothing."""
TILT_SD_MAX = np.radians(1.0)
"""Largest standard deviation of a tilt that is an answer [rad]: 0.02 to 0.035 in mu."""
NORMAL_80 = 1.2816
"""Half of the 80 % interval of a normal distribution over its standard deviation."""
TOGETHER_MIN = 0.5
"""Least share of moving patches that move as one: a cloth that is pulled out of shape has less. On
wood, whose grain has chance matches, it was 0.63 in a film that judges nothing."""


class FilmError(ValueError):
    """The film cannot be measured; the message has field, rule, value and remedy."""


@dataclass(frozen=True)
class Sightings:
    """What the frames of a film show."""

    frames: int
    """Number of all frames."""
    times: Floats
    """Of the frames that show both boards, (N,) [s]."""
    sights: list[dict[str, Sight]]
    """Of these, the boards by name."""
    width: int
    height: int
    end: float
    """Time of the last frame [s]."""


@dataclass(frozen=True)
class Slip:
    """The tilt at which the cloth began to slide, and its friction."""

    onset: Onset
    slide: Slide
    tilt: TiltAt
    errors: dict[str, float]
    """Standard deviations of the tilt by their cause [rad]."""

    @property
    def sd(self) -> float:
        """Return the standard deviation of the tilt [rad]."""
        return math.hypot(*self.errors.values())

    @property
    def mu(self) -> float:
        """Return the coefficient of static friction."""
        return math.tan(self.tilt.angle)

    @property
    def interval(self) -> tuple[float, float]:
        """Return the 80 % interval of mu."""
        half = NORMAL_80 * self.sd
        return math.tan(max(0.0, self.tilt.angle - half)), math.tan(self.tilt.angle + half)


@dataclass(frozen=True)
class Film:
    """A measured film."""

    path: Path
    sightings: Sightings
    lens: Lens
    tilts: Tilts
    tilt_at_start: float
    """Tilt of the tray as the film begins [rad]: not 0 where table or tray are uneven."""
    downhill: Floats
    """Direction of the slope on the tray's board, (2,)."""
    slip: Slip | None
    """None: no slide was seen."""
    motion: Motion
    """What moved on the tray."""
    steepest: float
    """Largest tilt [rad]: where the cloth stayed, mu is above its tangent."""
    level_again: float | None
    """Time at which the tray lies level again [s]; None: it never does."""


def measure_film(path: Path, *, focal: float | None = None, level_sd: float = 0.3) -> Film:
    """Measure the friction of the cloth in a film by the tilt at which it slides.

    Args:
        path: The film.
        focal: Focal length of the camera [px]; by default the boards tell it.
        level_sd: Standard deviation of the table's slope [degree].

    Raises:
        FilmError: The film lacks boards, tilt or a clear slide.
        VideoError: The file is no film.
    """
    sightings = _look(path)
    lens = _lens(sightings, focal)
    tilts = tilts_of(sightings.times, sightings.sights, lens)
    peak = int(np.argmax(tilts.angles))
    steepest = float(tilts.angles[peak])
    if steepest < TILT_MIN:
        raise FilmError(
            f"tilt: the tray must be tilted by {np.degrees(TILT_MIN):g} degrees or more, and is "
            f"tilted by {np.degrees(steepest):.1f}; raise the end of the tray with its board on it "
            "until the cloth slides"
        )
    ground = Ground(_downhill(tilts, peak))
    motion = _motion(path, tilts, peak, ground, lens)
    slide = motion.slide
    slip = None
    if slide is not None:
        near = tilt_at(tilts, float(slide.times[clear_motion(slide.offsets)]))
        onset = onset_of(slide.times, slide.offsets, growth(near.angle, near.rate))
        slip = _slip(sightings, lens, onset, slide, np.radians(level_sd))
    later = np.flatnonzero((tilts.angles < LEVEL) & (np.arange(len(tilts.angles)) > peak))
    again = float(tilts.times[later[0]]) if len(later) else None
    start = float(np.median(tilts.angles[: BOTH_MIN // 3]))
    return Film(path, sightings, lens, tilts, start, ground.downhill, slip, motion, steepest, again)


def _look(path: Path) -> Sightings:
    """Find the boards in all frames."""
    finder = Finder()
    counts = dict.fromkeys((board.name for board in BOARDS), 0)
    times: list[float] = []
    sights: list[dict[str, Sight]] = []
    frames, end, shape = 0, 0.0, (0, 0)
    for time, picture in read_frames(path):
        frames += 1
        end, shape = time, picture.shape
        boards = finder.find(picture)
        for name in boards:
            counts[name] += 1
        if len(boards) == len(BOARDS):
            times.append(time)
            sights.append(boards)
    if frames == 0:
        raise VideoError(f"film: must have frames, and {path} has none; record it again")
    _check_boards(counts, len(times), frames)
    return Sightings(frames, np.array(times), sights, shape[1], shape[0], end)


def _check_boards(counts: dict[str, int], both: int, frames: int) -> None:
    """Raise FilmError if too few frames show both boards."""
    if both >= BOTH_MIN:
        return
    by_board = ", ".join(
        f"the board of the {name} in {count} of {frames}" for name, count in counts.items()
    )
    raise FilmError(
        f"boards: {BOTH_MIN} frames or more must show both boards with half of their markers, and "
        f"{both} do ({by_board}); print the sheet of `stickslip film marker`, lay one half "
        "on the table and the other on the tray, and keep both in the picture, in focus and bright"
    )


def _lens(sightings: Sightings, focal: float | None) -> Lens:
    """Return the camera: calibrated by the boards, or with the focal length that is given [px]."""
    if focal is not None:
        return Lens(sightings.width, sightings.height, focal, 0.0)
    chosen = np.linspace(0, len(sightings.sights) - 1, KEY_FRAMES).round().astype(int)
    sights = [sight for place in chosen for sight in sightings.sights[place].values()]
    return calibrated(sights, sightings.width, sightings.height)


def _downhill(tilts: Tilts, peak: int) -> Floats:
    """Return the direction of the slope on the tray's board, (2,): the mean of steep frames."""
    until = tilts.angles[: peak + 1]
    steep = np.flatnonzero(until >= min(STEEP, 0.8 * until[-1]))
    direction = np.median(tilts.downhill[steep], axis=0)
    return np.asarray(direction / np.hypot(*direction))


def _motion(path: Path, tilts: Tilts, peak: int, ground: Ground, lens: Lens) -> Motion:
    """Return what moves on the tray while it is tilted."""
    start = float(tilts.angles[:LEVEL_FRAMES].min())
    rising = int(np.argmax(tilts.angles[: peak + 1] > start + RISEN))
    count = min(LEVEL_FRAMES, max(1, rising))
    last = float(tilts.times[peak]) + AFTER_PEAK
    used = tilts.times <= last
    later = _views(path, tilts, ground, lens, last)
    first = list(islice(later, count))
    views = [_levels(view) for view in first] + [_levels(view) for view in later]
    motion = slide_of(tilts.times[used], tilts.angles[used], views, ground, mean_view(first))
    slide = motion.slide
    if slide is not None and slide.together < TOGETHER_MIN:
        raise FilmError(
            f"cloth: {TOGETHER_MIN:.0%} or more of what moves on the tray must move as one, and "
            f"{slide.together:.0%} does; lay the cloth flat, let it slide freely, and keep hands "
            "and other things off the tray"
        )
    return motion


def _views(
    path: Path, tilts: Tilts, ground: Ground, lens: Lens, last: float
) -> Iterator[SingleFloats]:
    """Yield the views of the frames with both boards, up to a time [s]."""
    place = 0
    for time, picture in read_frames(path):
        if time > last or place == len(tilts.times):
            return
        if time == tilts.times[place]:
            yield ground.view_of(picture, tilts.poses[place], lens)
            place += 1


def _levels(view: SingleFloats) -> Array:
    """Return a view as 8-bit levels, which take a quarter of the memory; 0 beyond the frame."""
    return np.nan_to_num(view).astype(np.uint8)


def _slip(sightings: Sightings, lens: Lens, onset: Onset, slide: Slide, level_sd: float) -> Slip:
    """Return the tilt at the onset with its errors; refuse one that cannot be known."""
    near = np.abs(sightings.times - onset.time) < 1.0
    times = sightings.times[near]
    sights = [sight for sight, is_near in zip(sightings.sights, near, strict=True) if is_near]

    def tilt_by(other: Lens) -> TiltAt:
        return tilt_at(tilts_of(times, sights, other), onset.time)

    tilt = tilt_by(lens)
    _check_start(onset, tilt.angle)
    longer = replace(lens, focal=lens.focal + lens.focal_sd)
    bent = replace(lens, k1=lens.k1 + lens.k1_sd)
    errors = {
        "boards": math.hypot(tilt.noise, BOARD_SD),
        "focal length": abs(tilt_by(longer).angle - tilt.angle),
        "distortion": abs(tilt_by(bent).angle - tilt.angle),
        "instant": abs(tilt.rate) * onset.sd,
        "table": level_sd,
    }
    lens_error = math.hypot(errors["focal length"], errors["distortion"])
    if lens_error > TILT_SD_MAX:
        raise FilmError(
            "focal: the boards must show the focal length so well that the tilt is known to "
            f"{np.degrees(TILT_SD_MAX):g} degree, and it is known to "
            f"{np.degrees(lens_error):.1f} (focal length {lens.focal:.0f} +- {lens.focal_sd:.0f} "
            "px); film from the side, 30 to 60 degrees above the table, or give --focal"
        )
    return Slip(onset, slide, tilt, errors)


def _check_start(onset: Onset, angle: float) -> None:
    """Raise FilmError if no cloth can begin to slide like this at a tilt [rad]."""
    if onset.square > square_max(angle):
        raise FilmError(
            f"cloth: it must begin to slide with {2 * square_max(angle):.1f} m/s^2 or less, as "
            "kinetic friction of half of the static one lets it, and seems to begin with "
            f"{2 * onset.square:.1f}, so it was not followed; film it nearer and brighter, or take "
            "a tray that looks less like the cloth"
        )
