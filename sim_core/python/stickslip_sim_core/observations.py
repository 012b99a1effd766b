"""Observations of cloth for `fit`: vertices, marked points in pictures, and silhouettes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core.arrays import Floats, check_positive
from stickslip_sim_core.fit import Compared, check_observed
from stickslip_sim_core.scenes.scene import ClothRun

OUTLINE_STEP = 1e-3
"""Distance beside an edge, over its length, at which the picture must be empty for an outline."""

PIXEL_NOISE = 12.0**-0.5
"""Standard deviation of a place that is known to one pixel, evenly within it [px]."""


PATCH = 32
"""Side of the squares of a picture whose points of an outline are one group of errors [px].

Errors of pixels depend on one another along an outline that nearly follows a row or a column, and
those of a mesh over its cells. In a film of a drag four points have one independent error together,
so a patch is larger than that and still far smaller than the cloth.
"""


def check_frames(frames: Sequence[int], vertices: NDArray[np.intp], run: ClothRun) -> None:
    """Check that a run has these frames and vertices.

    Raises:
        ValueError: A frame or a vertex does not exist.
    """
    count, size = run.positions.shape[:2]
    if not all(0 <= frame < count for frame in frames):
        raise ValueError(f"frames: must be within 0 ... {count - 1} of the run, got {list(frames)}")
    if len(vertices) and not (vertices.min() >= 0 and vertices.max() < size):
        raise ValueError(
            f"vertices: must be within 0 ... {size - 1} of the run, got {vertices.max()}"
        )


def points_at(frames: Sequence[int], vertices: NDArray[np.intp], points: Floats) -> Floats:
    """Return an array of a run (frame, vertex, xyz) at some frames and vertices: (T, K, 3)."""
    return np.asarray(points[list(frames)][:, vertices])


def compared(difference: Floats, changes: Sequence[Floats], noise: float) -> Compared:
    """Return differences and their derivatives by each parameter over the noise, flat."""
    by = np.empty((difference.size, len(changes)))
    for number, change in enumerate(changes):
        by[:, number] = change.ravel() / noise
    return Compared(np.asarray(difference.ravel() / noise), by)


@dataclass(frozen=True, eq=False)
class Vertices:
    """Positions of vertices at some frames.

    Raises:
        ValueError: An argument breaks its rule.
    """

    frames: Sequence[int]
    """Numbers of frames: (T,)."""

    positions: Floats
    """Positions that were seen: (T, K, 3) [m]."""

    vertices: NDArray[np.intp]
    """Vertices that were seen: (K,)."""

    noise: float
    """Standard deviation of each coordinate [m]."""

    def __post_init__(self) -> None:
        check_positive(noise=self.noise)
        shape = (len(self.frames), len(self.vertices), 3)
        check_observed("positions", np.asarray(self.positions, float), shape)

    @property
    def count(self) -> int:
        return int(np.size(self.positions))

    def check(self, run: ClothRun) -> None:
        check_frames(self.frames, self.vertices, run)

    def compare(self, run: ClothRun, derivatives: Sequence[Floats]) -> Compared:
        difference = self._points(run.positions) - self.positions
        return compared(difference, [self._points(by) for by in derivatives], self.noise)

    def _points(self, points: Floats) -> Floats:
        return points_at(self.frames, self.vertices, points)


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole camera: the pixel of x is K (R x + t) over its third component."""

    matrix: Floats
    """K [R | t]: (3, 4), with pixels as the unit of its first two rows."""

    def __post_init__(self) -> None:
        check_observed("matrix", np.asarray(self.matrix, float), (3, 4))

    @staticmethod
    def of_camera(
        *,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        rotation: ArrayLike,
        translation: ArrayLike,
    ) -> "View":
        """Return the view of a camera without lens distortion, as manifests of datasets have it.

        Args:
            fx: Focal length along a row [px].
            fy: Focal length along a column [px].
            cx: Column of the principal point [px].
            cy: Row of the principal point [px].
            rotation: R from the world to the camera: (3, 3).
            translation: t [m]: (3,).
        """
        intrinsic = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        pose = np.column_stack([np.asarray(rotation, float), np.asarray(translation, float)])
        return View(intrinsic @ pose)

    def project(self, points: Floats) -> Floats:
        """Return the pixels of points (..., 3) [m]: (..., 2)."""
        homogeneous = points @ self.matrix[:, :3].T + self.matrix[:, 3]
        return np.asarray(homogeneous[..., :2] / homogeneous[..., 2:])

    def project_change(self, points: Floats, changes: Floats) -> Floats:
        """Return the changes of the pixels of points by changes of the points (..., 3)."""
        homogeneous = points @ self.matrix[:, :3].T + self.matrix[:, 3]
        moved = changes @ self.matrix[:, :3].T
        depth = homogeneous[..., 2:]
        return np.asarray((moved[..., :2] - moved[..., 2:] * homogeneous[..., :2] / depth) / depth)


@dataclass(frozen=True, eq=False)
class MarkedPixels:
    """Pixels of marked vertices at some frames.

    Raises:
        ValueError: An argument breaks its rule.
    """

    frames: Sequence[int]
    """Numbers of frames: (T,)."""

    pixels: Floats
    """Pixels that were seen: (T, K, 2)."""

    vertices: NDArray[np.intp]
    """Vertices that are marked: (K,)."""

    view: View
    noise: float
    """Standard deviation of each coordinate [px]."""

    def __post_init__(self) -> None:
        check_positive(noise=self.noise)
        shape = (len(self.frames), len(self.vertices), 2)
        check_observed("pixels", np.asarray(self.pixels, float), shape)

    @property
    def count(self) -> int:
        return int(np.size(self.pixels))

    def check(self, run: ClothRun) -> None:
        check_frames(self.frames, self.vertices, run)

    def compare(self, run: ClothRun, derivatives: Sequence[Floats]) -> Compared:
        points = self._points(run.positions)
        changes = [self.view.project_change(points, self._points(by)) for by in derivatives]
        return compared(self.view.project(points) - self.pixels, changes, self.noise)

    def _points(self, points: Floats) -> Floats:
        return points_at(self.frames, self.vertices, points)


@dataclass(frozen=True, eq=False)
class Silhouettes:
    """Points on the outlines of the cloth in pictures.

    The residual of a point is its distance from the outline of the run, along the outward normal.

    Raises:
        ValueError: An argument breaks its rule.
    """

    frames: Sequence[int]
    """Numbers of frames: (T,)."""

    outlines: Sequence[Floats]
    """Points on the outline of each frame: (N, 2) [px]."""

    view: View
    noise: float
    """Standard deviation of the distance [px]."""

    @staticmethod
    def of_masks(
        frames: Sequence[int],
        masks: NDArray[np.bool_],
        view: View,
        *,
        hidden: NDArray[np.bool_] | None = None,
        noise: float = PIXEL_NOISE,
    ) -> "Silhouettes":
        """Return the silhouettes of pictures in which each pixel is cloth or not.

        Args:
            frames: Numbers of frames: (T,).
            masks: Pixels whose middle shows cloth: (T, height, width).
            view: Camera of the pictures.
            hidden: Pixels before which something else may hide cloth, as `masks`. None: no pixel.
            noise: Standard deviation of the distance [px].

        Raises:
            ValueError: An argument breaks its rule, or a picture has no outline of cloth.
        """
        if hidden is None:
            hidden = np.zeros_like(masks)
        for name, pictures in (("masks", masks), ("hidden", hidden)):
            is_right = pictures.dtype == bool and pictures.ndim == 3
            if not is_right or len(pictures) != len(frames) or pictures.shape != masks.shape:
                raise ValueError(
                    f"{name}: must be booleans (frame, height, width) of {len(frames)} frames, "
                    f"got {pictures.dtype} {pictures.shape}"
                )
        outlines = [mask_outline(*pair) for pair in zip(masks, hidden, strict=True)]
        for frame, points in zip(frames, outlines, strict=True):
            if not len(points):
                raise ValueError(
                    f"masks: must show an outline of cloth in each frame, and do not in frame "
                    f"{frame}"
                )
        return Silhouettes(frames, outlines, view, noise)

    def __post_init__(self) -> None:
        check_positive(noise=self.noise)
        if len(self.outlines) != len(self.frames):
            raise ValueError(
                f"outlines: must be one for each of {len(self.frames)} frames, "
                f"got {len(self.outlines)}"
            )
        for number, points in enumerate(self.outlines):
            check_observed(f"outlines[{number}]", np.asarray(points, float), (None, 2))

    @property
    def count(self) -> int:
        return sum(len(points) for points in self.outlines)

    def check(self, run: ClothRun) -> None:
        check_frames(self.frames, np.empty(0, np.intp), run)

    def compare(self, run: ClothRun, derivatives: Sequence[Floats]) -> Compared:
        distances: list[Floats] = []
        changes: list[list[Floats]] = [[] for _ in derivatives]
        for frame, points in zip(self.frames, self.outlines, strict=True):
            # The search for the outline costs most, and all derivatives share it.
            nearest = self._nearest(run, frame, np.asarray(points, float))
            distances.append(nearest.distances)
            for of_parameter, derivative in zip(changes, derivatives, strict=True):
                of_parameter.append(self._change(run, frame, nearest, derivative))
        alone = compared(
            np.concatenate(distances), [np.concatenate(parts) for parts in changes], self.noise
        )
        return alone._replace(groups=self._groups())

    def _groups(self) -> NDArray[np.intp]:
        """Return the numbers of the squares of pictures in which points are: (N,)."""
        squares = [
            np.column_stack([np.full(len(points), number), np.asarray(points) // PATCH])
            for number, points in enumerate(self.outlines)
        ]
        groups = np.unique(np.concatenate(squares), axis=0, return_inverse=True)[1]
        return np.asarray(groups.ravel(), np.intp)

    def _change(self, run: ClothRun, frame: int, nearest: "_Nearest", derivative: Floats) -> Floats:
        """Return the derivatives of the distances of a frame: (N,)."""
        ends = nearest.edges
        moved = self.view.project_change(run.positions[frame][ends], derivative[frame][ends])
        change = (nearest.shares[..., None] * moved).sum(axis=1)
        # The distance from the observed point falls as the outline moves towards it.
        return np.asarray(-(change * nearest.normals).sum(axis=1))

    def _nearest(self, run: ClothRun, frame: int, points: Floats) -> "_Nearest":
        pixels = self.view.project(run.positions[frame])
        return _nearest_on_outline(pixels, run.triangles, points)


@dataclass(frozen=True, eq=False)
class _Nearest:
    """The points of an outline that are nearest to observed ones."""

    edges: NDArray[np.intp]
    """Ends of the edge of each: (N, 2)."""
    shares: Floats
    """Weights of these ends: (N, 2)."""
    normals: Floats
    """Unit vectors away from the cloth: (N, 2)."""
    distances: Floats
    """Distances of the observed points along the normals: (N,) [px]."""


def _nearest_on_outline(pixels: Floats, triangles: NDArray[np.int32], points: Floats) -> _Nearest:
    edges, normals = outline(pixels, triangles)
    a, b = pixels[edges[:, 0]], pixels[edges[:, 1]]
    along = b - a
    share = ((points[:, None] - a) * along).sum(axis=-1) / (along**2).sum(axis=-1)
    share = share.clip(0.0, 1.0)
    offsets = points[:, None] - (a + share[..., None] * along)
    nearest = (offsets**2).sum(axis=-1).argmin(axis=1)
    number = np.arange(len(points))
    at_edge = share[number, nearest]
    distances = (offsets[number, nearest] * normals[nearest]).sum(axis=1)
    shares = np.stack([1.0 - at_edge, at_edge], axis=1)
    return _Nearest(edges[nearest], shares, normals[nearest], distances)


def outline(pixels: Floats, triangles: NDArray[np.int32]) -> tuple[NDArray[np.intp], Floats]:
    """Return the edges of projected triangles (E, 2) that bound them all, and outward normals.

    Args:
        pixels: Projected vertices (V, 2) [px].
        triangles: Vertices of the triangles (T, 3).
    """
    edges = _rims(pixels, triangles)
    along = pixels[edges[:, 1]] - pixels[edges[:, 0]]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    edges, along, length = (part[length[:, 0] > 0.0] for part in (edges, along, length))
    across = np.stack([along[:, 1], -along[:, 0]], axis=1) / length
    middle = 0.5 * (pixels[edges[:, 0]] + pixels[edges[:, 1]])
    step = OUTLINE_STEP * length * across
    is_right = ~_covered(middle + step, pixels, triangles)
    is_left = ~_covered(middle - step, pixels, triangles)
    # An edge with cloth on neither side is the trace of a fold seen end on, and bounds nothing.
    is_outline = is_right != is_left
    normals = np.where(is_right[:, None], across, -across)
    return edges[is_outline], normals[is_outline]


def _rims(pixels: Floats, triangles: NDArray[np.int32]) -> NDArray[np.intp]:
    """Return the edges (E, 2) whose own triangles all lie on one side in the picture.

    Any other edge has cloth on both sides, and is no part of an outline.
    """
    corners = np.concatenate([triangles[:, order] for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1])])
    ends = np.sort(corners[:, :2], axis=1)
    edges, number = np.unique(ends, axis=0, return_inverse=True)
    along = pixels[ends[:, 1]] - pixels[ends[:, 0]]
    across = pixels[corners[:, 2]] - pixels[ends[:, 0]]
    is_left = along[:, 0] * across[:, 1] > along[:, 1] * across[:, 0]
    count = np.bincount(number.ravel(), minlength=len(edges))
    left = np.bincount(number.ravel(), weights=is_left, minlength=len(edges))
    return np.asarray(edges[(left == 0) | (left == count)], dtype=np.intp)


def mask_outline(mask: NDArray[np.bool_], hidden: NDArray[np.bool_]) -> Floats:
    """Return points on the outline of a mask (height, width): (N, 2) [px].

    A point is halfway between the middles of two neighbours in a row or a column, one of cloth and
    one not. Neighbours that are hidden have none, and neither has the border of the picture.
    """
    rows, columns = np.mgrid[: mask.shape[0], : mask.shape[1]]
    middles = np.stack([columns, rows], axis=-1).astype(float)
    points = []
    for before, after in (
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:-1, :], np.s_[1:, :]),
    ):
        is_outline = (mask[before] != mask[after]) & ~hidden[before] & ~hidden[after]
        points.append(0.5 * (middles[before][is_outline] + middles[after][is_outline]))
    return np.concatenate(points)


def _covered(points: Floats, pixels: Floats, triangles: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Return which points (N, 2) are in a projected triangle."""
    corners = pixels[triangles]
    sides = []
    for first, second in ((0, 1), (1, 2), (2, 0)):
        a, b = corners[:, first], corners[:, second]
        d = b - a
        offset = points[:, None] - a
        sides.append(d[:, 0] * offset[..., 1] - d[:, 1] * offset[..., 0])
    signs = np.stack(sides)
    inside = np.asarray((signs > 0.0).all(axis=0) | (signs < 0.0).all(axis=0))
    return np.asarray(inside.any(axis=1), dtype=np.bool_)
