"""From calibrated views of a hanging rod to its centreline.

1. Silhouettes: the coverage of each pixel [silhouette].
2. Starts: ways through all silhouettes at once, from the clamp, as long as the rod, and the
   centroid of a cylinder that moves through the visual hull, as in the thesis [starts].
3. Each start is moved until a tube about it looks as the views do [refinement]; the best fit
   wins.
4. The winner is judged: the parts that it leaves unexplained or unsupported, and whether
   another curve would do as well.

Nothing of rods' physics is used but that they do not stretch and bend smoothly, so hair and
tendrils will do.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.cameras import Camera

from stickslip_training.arrays import Floats
from stickslip_training.reconstruction.refinement import Fit, draw, refine, samples, start
from stickslip_training.reconstruction.starts import APART, follow, moving_cylinder, visual_hull
from stickslip_training.reconstruction.views import (
    ReconstructionError,
    View,
    arc_length,
    at_uniform_arc_length,
    basis,
    fit_curve,
    shrink_image,
    silhouette,
    to_linear,
)

CONTROL_POINTS = 44
STARTS = 4  # ways of the tracking that are refined
HOPELESS = 4.0  # a start whose coarse fit costs so many times the best one's is given up
LARGEST_IMAGE = 1600  # [px]: larger pictures are averaged down
WIDEST_ROD = 4.0  # half width [px]: of a rod that is wider, pictures are averaged down too
SLENDER = (0.0005, 0.05)  # radius over length that is believed


class Verdict(StrEnum):
    """Quality of a reconstruction."""

    good = "good"
    ambiguous = "ambiguous"
    """Another curve explains the views about as well."""
    failed = "failed"
    """The curve does not explain the views."""


LIMITS = {"misfit": 0.25, "unexplained share": 0.03, "unsupported share": 0.03, "stretch": 0.02}
"""Of a good curve, as shares of the silhouettes' area and of the length;
`benchmarks/reconstruction.py` says how they tell good from bad."""
RIVAL = 1.1  # a different curve whose misfit is less than so many times the winner's is a rival


@dataclass(frozen=True, slots=True)
class Reconstruction:
    """A centreline, and how far to trust it. Lengths are in the unit of the cameras."""

    centerline: Floats
    """Positions at uniform arc length, clamp first, (points, 3)."""
    deviation: Floats
    """Standard deviation of each position, if pixels err independently, (points,). Wrong turns are
    not in it.
    """
    residual: Floats
    """By how much each view would still move each point sideways [px], (views, points); NaN where
    it is hidden.
    """
    views_seen: npt.NDArray[np.int64]
    """Number of views in which each point lies open, (points,)."""
    radius: float
    """Of the rod, given or found."""
    misfit: float
    """Sum of |seen - drawn| over the sum of seen."""
    unexplained: float
    """Fraction of the silhouettes' area in which nothing is drawn."""
    unsupported: float
    """Fraction of the drawn area in which nothing is seen."""
    rival: float
    """Misfit of the best other curve over this one's; infinite if there is none."""
    verdict: Verdict
    reasons: tuple[str, ...]
    """Why the verdict is not good."""

    @property
    def residual_rms(self) -> float:
        """Root mean square of the residuals [px]."""
        return float(np.sqrt(np.nanmean(self.residual**2)))


def reconstruct(
    views: npt.ArrayLike | Sequence[npt.ArrayLike],
    cameras: Sequence[Camera],
    *,
    length: float = 1.0,
    clamp: npt.ArrayLike = (0.0, 0.0, 0.0),
    direction: npt.ArrayLike = (0.0, 0.0, -1.0),
    points: int = 150,
    radius: float | None = None,
) -> Reconstruction:
    """Return the centreline of the rod that `views` show, one picture (y, x, rgb) for each camera.

    `length`, `clamp` (the point at which the rod leaves its clamp), `direction` (of the rod there)
    and `radius` are in the unit and the axes of the cameras. A radius that is not given is found.
    Pictures must be free of lens distortion.
    """
    if not length > 0.0:
        raise ValueError(f"length must be positive; got {length}")
    if radius is not None and not SLENDER[0] <= radius / length <= SLENDER[1]:
        raise ValueError(
            f"radius must be {SLENDER[0]} to {SLENDER[1]} of the length; got {radius} of {length}"
        )
    if points < 2:
        raise ValueError(f"points must be at least 2; got {points}")
    origin = _vector("clamp", clamp)
    heading = _vector("direction", direction)
    if not np.linalg.norm(heading) > 0.0:
        raise ValueError("direction must not be zero")
    heading = heading / np.linalg.norm(heading)
    silhouettes = _silhouettes(views, cameras, length, origin)
    size = radius / length if radius is not None else _radius(silhouettes)
    fits = _refined(silhouettes, size, heading, radius is not None)
    judged = sorted(((_match(silhouettes, fit), fit) for fit in fits), key=lambda item: item[0])
    (misfit, unexplained, unsupported), fit = judged[0]
    shape = at_uniform_arc_length(fit.control, points)
    rivals = [
        other[0] / misfit
        for other, rival in judged[1:]
        if _distance(rival.control, fit.control) > APART
    ]
    rival = min(rivals, default=float("inf"))
    residual = _residual(silhouettes, fit, points)
    verdict, reasons = _judge(
        (misfit, unexplained, unsupported, abs(arc_length(shape)[-1] - 1.0)), rival
    )
    return Reconstruction(
        centerline=origin + length * shape,
        deviation=length * _deviation(fit, points),
        residual=residual,
        views_seen=np.isfinite(residual).sum(axis=0),
        radius=length * fit.radius,
        misfit=misfit,
        unexplained=unexplained,
        unsupported=unsupported,
        rival=rival,
        verdict=verdict,
        reasons=reasons,
    )


def _vector(name: str, value: npt.ArrayLike) -> Floats:
    vector = np.asarray(value, dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} must be three finite numbers; got {vector.tolist()}")
    return vector


def _silhouettes(
    pictures: npt.ArrayLike | Sequence[npt.ArrayLike],
    cameras: Sequence[Camera],
    length: float,
    clamp: Floats,
) -> list[View]:
    images = [np.asarray(picture) for picture in pictures]  # type: ignore[union-attr]
    if len(images) != len(cameras) or len(images) < 2:
        raise ValueError(
            f"there must be one view for each of at least 2 cameras; got {len(images)} for "
            f"{len(cameras)}"
        )
    silhouettes = []
    for image, camera in zip(images, cameras, strict=True):
        if image.shape[:2] != (camera.height, camera.width):
            raise ReconstructionError(
                f"view {camera.name} must be {camera.width} x {camera.height} pixels as "
                f"its camera; got {image.shape[1]} x {image.shape[0]}"
            )
        try:
            silhouettes.append(_view(image, camera, length, clamp))
        except ReconstructionError as error:
            raise ReconstructionError(f"view {camera.name}: {error}") from error
    return silhouettes


def _view(image: npt.NDArray[np.generic], camera: Camera, length: float, clamp: Floats) -> View:
    factor = int(np.ceil(max(image.shape[:2]) / LARGEST_IMAGE))
    light = shrink_image(to_linear(image), factor)
    coverage = silhouette(light)
    # A rod of many pixels is as good in fewer, and costs less.
    again = int(_half_width(coverage) / WIDEST_ROD * 2.0)
    if again > 1:
        factor = factor * again
        coverage = silhouette(shrink_image(light, again))
    return View.of(camera, coverage, length=length, clamp=clamp, factor=factor)


def _half_width(coverage: Floats) -> float:
    """Estimate the rod's half width [px] from its area and its outline.

    That of a strip is its area over the length of its outline, both sides counted.
    """
    solid = np.minimum(coverage, 1.0)
    return float(solid.sum() / max(float(np.hypot(*np.gradient(solid)).sum()), 1e-9))


def _radius(views: Sequence[View]) -> float:
    """Estimate the radius [L]."""
    # A half width in pixels is a length at the distance of the clamp. One view may be off.
    radii = [
        _half_width(view.coverage) * float(np.linalg.norm(view.t)) / view.focal for view in views
    ]
    return float(np.clip(np.median(radii), *SLENDER))


def _refined(
    views: Sequence[View], radius: float, direction: Floats, fixed_radius: bool
) -> list[Fit]:
    """Return the fits of all different starts."""
    lines = follow(views, radius, direction, STARTS)
    # The cloud's polyline is a start only if it is about as long as the rod.
    by_hull = moving_cylinder(visual_hull(views), radius, direction)
    if 0.8 < arc_length(by_hull)[-1] < 1.2:
        lines.append(by_hull)
    # A coarse fit to blurred views of half the size finds the way from far off.
    coarse_views = [view.shrunk(2) for view in views]
    starts = [start(fit_curve(line, CONTROL_POINTS), radius, len(views)) for line in lines]
    coarse = [
        refine(
            coarse_views,
            fit,
            direction,
            extra_blur=1.2,
            shading=False,
            fixed_radius=True,
            iterations=10,
        )
        for fit in starts
    ]
    # A fine fit is expensive: starts that came to the same curve, or to a bad one, get none.
    promising: list[Fit] = []
    for fit in sorted(coarse, key=lambda fit: fit.cost):
        is_hopeless = bool(promising) and fit.cost > HOPELESS * promising[0].cost
        is_new = all(_distance(fit.control, other.control) > 0.5 * APART for other in promising)
        if is_new and not is_hopeless:
            promising.append(fit)
    return [refine(views, fit, direction, fixed_radius=fixed_radius) for fit in promising]


def _distance(control: Floats, other: Floats) -> float:
    """Return the largest distance of two curves at the same arc length [L]."""
    a = at_uniform_arc_length(control, 100)
    b = at_uniform_arc_length(other, 100)
    return float(np.linalg.norm(a - b, axis=1).max())


def _match(views: Sequence[View], fit: Fit) -> tuple[float, float, float]:
    """Return the misfit, and the unexplained and the unsupported share: see `Reconstruction`."""
    s = samples(views, fit)
    seen_sum = drawn_sum = difference = unexplained = unsupported = 0.0
    for index, view in enumerate(views):
        image = draw(view, index, fit, s)
        drawn = np.zeros(view.coverage.size)
        drawn[image.pixel] = image.value
        # Behind the clamp nothing is known.
        known = np.ones(view.coverage.size, dtype=bool)
        known[image.left_out] = False
        coverage = np.minimum(view.coverage.ravel(), 1.5)[known]
        drawn = drawn[known]
        # Pixels of one without the other count as unexplained or unsupported.
        seen_sum += coverage.sum()
        drawn_sum += drawn.sum()
        difference += np.abs(coverage - drawn).sum()
        unexplained += coverage[(drawn < 0.1 * coverage) & (coverage > 0.3)].sum()
        unsupported += drawn[(coverage < 0.1 * drawn) & (drawn > 0.3)].sum()
    return (difference / seen_sum, unexplained / seen_sum, unsupported / max(drawn_sum, 1e-9))


def _judge(values: Sequence[float], rival: float) -> tuple[Verdict, tuple[str, ...]]:
    """Compare values with `LIMITS`, in their order; return the verdict, and why it is not good."""
    limited = zip(LIMITS.items(), values, strict=True)
    reasons = tuple(
        f"{name} {value:.3f} is above {limit}" for (name, limit), value in limited if value > limit
    )
    if reasons:
        return Verdict.failed, reasons
    if rival < RIVAL:
        return Verdict.ambiguous, (
            f"another curve has {rival:.2f} times the misfit; less than {RIVAL} is too close",
        )
    return Verdict.good, ()


def _deviation(fit: Fit, points: int) -> Floats:
    B = basis(np.linspace(0.0, 1.0, points), len(fit.control))
    assert fit.covariance is not None
    variance = sum(
        np.einsum("ij,jk,ik->i", B, fit.covariance[axis::3, axis::3], B) for axis in range(3)
    )
    return np.asarray(np.sqrt(variance))


def _residual(views: Sequence[View], fit: Fit, points: int) -> Floats:
    """Return the sideways shift [px] that would fit the pixels about each point best.

    Each view has one.
    """
    s = samples(views, fit)
    residual = np.full((len(views), points), np.nan)
    for index, view in enumerate(views):
        image = draw(view, index, fit, s)
        error = view.coverage.ravel()[image.pixel] - image.value
        front = image.sides[0]
        point = np.rint(s[front.sample] * (points - 1)).astype(np.int64)
        # Least squares over the pixels about each point; points that are hidden have no slope.
        pull = np.bincount(point, front.by_normal * error, points)
        hold = np.bincount(point, front.by_normal**2, points)
        open_ = hold > 0.05
        residual[index, open_] = pull[open_] / hold[open_]
    return residual
