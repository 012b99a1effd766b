"""How far the cloth has slid on the tray, frame by frame.

Each frame is seen from straight above the tray, by the pose of the tray's board, with the slope
running down the picture. What lies on the tray stands still there, whatever hand and phone do.
Small patches of the level tray are looked for further down in the later frames, by their normalised
correlation, which no change of light disturbs. Patches that stay are tray. Patches that move
together are cloth, and their common shift is how far it slid. Edges that creep are few, and count
as neither.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stickslip_training.arrays import Array, Floats, SingleFloats
from stickslip_training.film.boards import GAP, SIZE
from stickslip_training.film.poses import Lens, Pose

PIXEL = 1e-3
"""Side of a pixel of the view from above [m]: about that of a frame that shows a tray."""
ABOVE = 0.02
"""The view begins so far from the middle of the board, up the slope [m]."""
BELOW = 0.42
"""The view ends so far from the middle of the board, down the slope [m]."""
BESIDE = 0.16
"""Half of the width of the view [m]."""
PATCH = 24
"""Side of a patch [px]: more than the cells of usual patterns."""
PATCH_STEP = 16
"""Distance of patches [px]."""
REACH = 40
"""Farthest shift that is looked for down the slope [px]."""
BACK = 6
"""Farthest shift up the slope, and aside, that is looked for [px]: poses are off by less."""
STEP_MAX = 15
"""Farthest shift between two frames [px]: 0.45 m/s at 30 frames a second."""
CONTRAST_MIN = 0.3
"""Least slope of grey levels down the slope, on average [1/px]: a plain cloth has its grain."""
STILL_MIN = 0.7
"""Least correlation of a patch that stays."""
STILL_TILT = np.radians(6.0)
"""Tilt up to which all that lies on the tray stays [rad]: mu is 0.1 or more. What lies beside the
tray leaves its place in the view by more than a patch's width until then."""
STAYS = 2
"""Largest shift of a patch that has stayed [px]."""
TRAY_MAX = 40
"""About the most patches of the tray that are followed: more cost time and tell little."""
MOVED = 5
"""Least shift at which a patch has moved [px]: 5 mm on a sheet of true size."""
MATCH_MIN = 0.6
"""Least correlation of a patch that has moved."""
GAIN_MIN = 0.15
"""Least correlation of a patch that has moved over that at its old place."""
LOOKS = 15.0
"""Looks for motion in a second [1/s]: a cloth is in reach for longer."""
BEFORE = 2.0
"""Time before the cloth has clearly moved in which its way is followed [s]."""
AFTER = 0.2
"""Time for which its way is followed from then on [s]: a hand has not answered yet."""
GONE_MAX = 0.4
"""Largest correlation of a patch with what lies at its place after it has left [1]. In three films
that judge nothing, 97 patches or more are below after a slide, and none where nothing slides."""
CLOTH_MIN = 6
"""Fewest patches of a cloth: 6 cover 15 square centimetres or more."""
ROWS_MIN = 3
"""Fewest rows of patches of a cloth: an edge that creeps down the slope has one or two."""
TOGETHER = 3
"""Largest difference between shifts of patches that move together [px]."""
ALIKE = 0.1
"""Largest difference of correlations at two shifts that fit a patch alike [1]: a lossy film changes
the correlations of equal periods of a pattern by less."""
VOTES_SHARE = 0.8
"""Least votes for the shift of a cloth over those for any other shift."""
STILL_LOOKS = 0.5
"""Least mean correlation of a patch that lies on the tray while it rises from half of `STILL_TILT`
to it [1]: a plain cloth in a lossy film has 0.6, and the table beside the tray 0.4 or less."""


@dataclass(frozen=True)
class Ground:
    """The view from above: a rectangle of the tray's plane."""

    downhill: Floats
    """Unit vector down the slope, on the board, (2,)."""

    @property
    def shape(self) -> tuple[int, int]:
        """Return height and width of the view [px]."""
        return round((ABOVE + BELOW) / PIXEL), round(2 * BESIDE / PIXEL)

    def points(self, every: int = 1) -> Floats:
        """Return the places of pixels on the board, (H, W, 2) [m], of each so many pixels."""
        height, width = self.shape
        down = np.arange(0, height, every) * PIXEL - ABOVE
        aside = np.arange(0, width, every) * PIXEL - BESIDE
        across = np.array([-self.downhill[1], self.downhill[0]])
        return np.asarray(down[:, None, None] * self.downhill + aside[:, None] * across)

    def view_of(self, picture: Array, pose: Pose, lens: Lens) -> SingleFloats:
        """Return the view of a frame (H, W): grey levels, NaN beyond its edge."""
        import cv2

        every = 10
        points = self.points(every)
        pixels = pose.pixels(points.reshape(-1, 2), lens).reshape(points.shape)
        # Between points of a grid of 1 cm, the places of pixels are even to 0.01 px.
        height, width = self.shape
        rows, columns = np.mgrid[:height, :width].astype(np.float32) / every
        maps = [
            cv2.remap(
                np.ascontiguousarray(pixels[..., axis], np.float32),
                columns,
                rows,
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
            for axis in (0, 1)
        ]
        view = cv2.remap(picture, maps[0], maps[1], cv2.INTER_LINEAR).astype(np.float32)
        edge = picture.shape
        inside = (maps[0] >= 0) & (maps[1] >= 0) & (maps[0] < edge[1] - 1) & (maps[1] < edge[0] - 1)
        view[~inside] = np.nan
        return np.asarray(view, dtype=np.float32)

    def board(self) -> Array:
        """Return which pixels show the board and its white border, (H, W)."""
        half = np.array(SIZE) / 2 + GAP
        return np.asarray((np.abs(self.points()) < half).all(axis=-1))


@dataclass(frozen=True)
class Slide:
    """How far the cloth has slid."""

    times: Floats
    """Of frames from the level tray on, up to where the cloth leaves the reach, (N,) [s]."""
    offsets: Floats
    """Down the slope, (N,) [m on a sheet of true size]."""
    patches: int
    """Number of patches of cloth."""
    together: float
    """Share of patches that moved and moved together."""


@dataclass(frozen=True)
class Motion:
    """What moved on the tray."""

    slide: Slide | None
    """None: nothing slides."""
    patches: int
    """Number of patches with contrast on the level tray."""
    left: int
    """Number of these patches that have left their place as the tray is steepest."""

    @property
    def stayed(self) -> bool:
        """Return whether the cloth stayed: fewer patches left their place than a cloth has."""
        return self.slide is None and self.patches >= CLOTH_MIN and self.left < CLOTH_MIN


def mean_view(views: Sequence[SingleFloats]) -> SingleFloats:
    """Return the mean of views (H, W): it has less noise than each of them."""
    return np.asarray(np.mean(views, axis=0), dtype=np.float32)


def patches_of(ground: Ground, level: SingleFloats) -> Array:
    """Return the upper left pixels (row, column) of patches with contrast, (P, 2)."""
    height, width = level.shape
    hidden = ground.board() | np.isnan(level)
    slope = np.abs(np.gradient(np.nan_to_num(level), axis=0))
    corners = []
    for row in range(BACK, height - PATCH - REACH, PATCH_STEP):
        for column in range(BACK, width - PATCH - BACK, PATCH_STEP):
            window = (slice(row, row + PATCH), slice(column, column + PATCH))
            if not hidden[window].any() and slope[window].mean() > CONTRAST_MIN:
                corners.append((row, column))
    return np.array(corners, dtype=np.int64).reshape(-1, 2)


def correlations(level: SingleFloats, view: Array, patches: Array) -> SingleFloats:
    """Return the correlation of patches with a view, (P, S, A), at shifts down the slope and aside.

    The first shift down is -`BACK`, and that aside is the negative of its half.
    """
    import cv2

    side = BACK // 2
    still = np.clip(np.nan_to_num(level) + 0.5, 0, 255).astype(np.uint8)
    rows = []
    for row, column in patches:
        template = still[row : row + PATCH, column : column + PATCH]
        strip = view[row - BACK : row + PATCH + REACH, column - side : column + PATCH + side]
        rows.append(cv2.matchTemplate(strip, template, cv2.TM_CCOEFF_NORMED))
    shape = (len(patches), BACK + REACH + 1, 2 * side + 1)
    return np.array(rows, dtype=np.float32).reshape(shape)


def _shift(curve: SingleFloats, near: float, step: int) -> float:
    """Return the shift of the best match near another shift, to parts of a pixel [px]."""
    middle = round(near) + BACK
    low = max(0, middle - step)
    high = min(len(curve), middle + step + 1)
    best = low + int(np.argmax(curve[low:high]))
    inner = min(max(best, 1), len(curve) - 2)
    left, top, right = curve[inner - 1 : inner + 2]
    bend = left - 2 * top + right
    part = 0.5 * (left - right) / bend if bend < -1e-9 else 0.0
    return inner - BACK + float(np.clip(part, -1.0, 1.0))


def _moved(matches: SingleFloats) -> Array:
    """Return which patches have clearly moved, (P,)."""
    top = matches[:, BACK + MOVED :].max(axis=1)
    return np.asarray((top > MATCH_MIN) & (top > _at_place(matches) + GAIN_MIN))


def _still(matches: SingleFloats) -> Array:
    """Return which patches have clearly stayed, (P,)."""
    best = matches.argmax(axis=1)
    return np.asarray((np.abs(best - BACK) <= STAYS) & (matches.max(axis=1) > STILL_MIN))


def _at_place(matches: SingleFloats) -> SingleFloats:
    """Return the correlation of each patch with what lies at its place, (P,)."""
    return np.asarray(matches[:, BACK - STAYS : BACK + STAYS + 1].max(axis=1, initial=-1.0))


def _cloth(matches: SingleFloats, moved: Array) -> Array:
    """Return which of the patches that have moved have done so together in a frame, (P,).

    A pattern with a period fits at several shifts, so each patch votes for all that fit it. What
    begins to slide is seen at the shortest of them.
    """
    fits = matches[:, BACK + MOVED :] >= matches.max(axis=1, keepdims=True) - ALIKE
    votes = (fits & moved[:, None]).sum(axis=0)
    if votes.max(initial=0) < CLOTH_MIN:
        return np.zeros(len(moved), dtype=bool)
    shift = int(np.argmax(votes >= VOTES_SHARE * votes.max()))
    near = fits[:, max(0, shift - TOGETHER) : shift + TOGETHER + 1].any(axis=1)
    return np.asarray(moved & near)


def slide_of(
    times: Floats,
    tilts: Floats,
    views: Sequence[Array],
    ground: Ground,
    level: SingleFloats,
) -> Motion:
    """Return what moved on the tray, and how far the cloth has slid.

    Args:
        times: Of frames from the level tray to the steepest one, (N,) [s].
        tilts: Of the tray, (N,) [rad].
        views: The views of these frames, grey levels (H, W).
        ground: The view.
        level: The view of the level tray, without noise; NaN beyond the frame.
    """
    every = max(1, round(1.0 / (LOOKS * float(np.median(np.diff(times))))))
    rising = (tilts > STILL_TILT / 2) & (tilts < STILL_TILT)
    early = [views[frame] for frame in range(0, len(times), every) if rising[frame]]
    patches = _lying(level, early, patches_of(ground, level))
    looks = Looks(len(patches))
    for frame in range(0, len(times), every):
        looks.add(correlations(level, views[frame], patches).max(axis=2))
        if _is_cloth(patches[looks.cloth]):
            first = int(np.searchsorted(times, times[frame] - BEFORE))
            used = slice(first, int(np.searchsorted(times, times[frame] + AFTER)))
            offsets = _path(views[used], level, patches[looks.moving])
            tray = patches[looks.stayed]
            if len(tray) >= CLOTH_MIN:
                # What poses are off by moves the tray's own texture alike.
                tray = tray[:: 1 + len(tray) // TRAY_MAX]
                of_tray = _path(views[used], level, tray, BACK // 2)
                # Either may come to the end of its reach first.
                both = min(len(offsets), len(of_tray))
                offsets = offsets[:both] - of_tray[:both]
            slide = Slide(
                times[used][: len(offsets)], offsets, int(looks.moving.sum()), looks.together
            )
            return Motion(slide, len(patches), int(looks.left.sum()))
    return Motion(None, len(patches), int(looks.left.sum()))


def _is_cloth(patches: Array) -> bool:
    """Return whether patches (P, 2) that move together are a cloth, and no edge that creeps."""
    return len(patches) >= CLOTH_MIN and len(np.unique(patches[:, 0])) >= ROWS_MIN


def _lying(level: SingleFloats, views: Sequence[Array], patches: Array) -> Array:
    """Return the patches that lie on the tray, by views of the tray that begins to rise."""
    if not len(patches) or not views:
        return patches
    places = [_at_place(correlations(level, view, patches).max(axis=2)) for view in views]
    return np.asarray(patches[np.mean(places, axis=0) > STILL_LOOKS])


class Looks:
    """What looks at patches have shown so far."""

    def __init__(self, count: int) -> None:
        """Begin with so many patches."""
        nowhere = np.zeros(count, dtype=bool)
        # Only what has moved in two looks is no chance match.
        self._moved, self._moved_before = nowhere, nowhere
        self._moving_before = nowhere
        self.moving: Array = nowhere
        """Which patches have moved together in the last look, (P,)."""
        # A patch has left that is gone in two looks: one look may be blurred.
        self._gone, self._gone_before = nowhere, nowhere
        self.stayed: Array = ~nowhere
        """Which patches have stayed in all looks, (P,): the tray. A pattern with a period lies on
        itself from time to time."""

    def add(self, matches: SingleFloats) -> None:
        """Take another look, by correlations (P, S)."""
        self._moved_before, self._moved = self._moved, _moved(matches)
        self._moving_before, self.moving = self.moving, _cloth(matches, self._moved)
        self._gone_before, self._gone = self._gone, _at_place(matches) < GONE_MAX
        self.stayed = self.stayed & _still(matches)

    @property
    def cloth(self) -> Array:
        """Return which patches have moved together in two looks, (P,)."""
        return self.moving & self._moving_before

    @property
    def together(self) -> float:
        """Return the share of patches that moved in two looks and together in the last one."""
        moved = self._moved & self._moved_before
        return float((moved & self.moving).sum() / max(1, moved.sum()))

    @property
    def left(self) -> Array:
        """Return which patches have left their place, (P,)."""
        return self._gone & self._gone_before


def _path(
    views: Sequence[Array], level: SingleFloats, patches: Array, step: int = STEP_MAX
) -> Floats:
    """Return the common shift of patches in each view, (N,) [m]: up to `step` px from the last.

    It ends as the patches come to the end of the reach.
    """
    offsets: list[float] = []
    near = 0.0
    for view in views:
        # All shift aside alike: a striped patch alone may slip along its stripes.
        together = correlations(level, view, patches).mean(axis=0).max(axis=1)
        near = _shift(together, near, step)
        if near > REACH - 1:
            break
        offsets.append(near)
    return PIXEL * np.array(offsets)
