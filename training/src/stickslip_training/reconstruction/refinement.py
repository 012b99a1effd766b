"""Move a curve until the tube about it looks as the views do (analysis by synthesis).

Unknown are the control points of the curve, the radius, the blur, and how light falls on the rod in
each view. The sum of squares

    rho((seen - drawn) / 0.05) over the pixels near the rod
    + length, clamp and smoothness, each against its tolerance (the constants below)

is reduced by Levenberg-Marquardt steps with exact derivatives of the drawing; rho is Cauchy's, so
that dirt, highlights and specks pull little.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from stickslip_training.arrays import Floats
from stickslip_training.reconstruction.views import TubeImage, View, basis, tube_image

PIXEL = 0.12  # of the brightness of the rod: what a pixel may be off
ROBUST = 3.0  # in units of PIXEL: beyond it a pixel's pull falls again
CLAMP = 1e-4  # [L]
CLAMP_TANGENT = 0.01  # [rad]
STRETCH = 1e-3  # of the length of each piece between two samples of the prior
JERK = 2000.0  # third derivative of the curve [1/L^2]: a curl of radius L/20 has 400
LIGHT = 0.3  # of the brightness of the rod about it
SLOPE = 0.4
LIGHT_BEND = 0.15  # second difference of light and slope from one of their nodes to the next
LIGHT_NODES = 24
BLUR = 0.45  # [px], to start with
LOG_RADIUS = 0.5  # of a radius that is only estimated
LOG_BLUR = 0.3
TOLERANCE = 1e-4  # of the cost: smaller gains end the search


@dataclass(frozen=True, slots=True)
class Fit:
    """A curve with all that its picture needs."""

    control: Floats
    """Control points [L], (K, 3)."""
    radius: float
    """[L]."""
    blur: float
    """Standard deviation [px]."""
    light: Floats
    """Brightness in the middle at LIGHT_NODES places along the rod, (views, nodes)."""
    slope: Floats
    """Its gain from the middle to the edge, (views, nodes)."""
    cost: float = np.inf
    """Half the sum of squares."""
    covariance: Floats | None = None
    """Of the control points [L^2], (3 K, 3 K), if the measured errors of pixels are independent."""


def start(control: Floats, radius: float, views: int) -> Fit:
    """Return the fit to begin with: even light."""
    light = np.ones((views, LIGHT_NODES))
    return Fit(control, radius, BLUR, light, np.zeros_like(light))


def samples(views: Sequence[View], fit: Fit) -> Floats:
    """Return the parameters at which the curve is drawn: half a pixel apart in every view, (n,)."""
    span = max(view.focal / view.project(fit.control)[1].min() for view in views)  # [px / L]
    return np.linspace(0.0, 1.0, int(np.clip(2.2 * span, 200, 4000)))


def draw(view: View, index: int, fit: Fit, s: Floats, extra_blur: float = 0.0) -> TubeImage:
    """Draw the fit as view number `index` sees it, at parameters s half a pixel apart."""
    N = _hats(s)
    points = basis(s, len(fit.control)) @ fit.control
    blur = float(np.hypot(fit.blur, extra_blur))
    return tube_image(view, points, fit.radius, blur, N @ fit.light[index], N @ fit.slope[index])


def refine(
    views: Sequence[View],
    fit: Fit,
    direction: Floats,
    *,
    extra_blur: float = 0.0,
    shading: bool = True,
    fixed_radius: bool = False,
    iterations: int = 30,
) -> Fit:
    """Minimise.

    `extra_blur` [px] blurs the views first, which makes the curve findable from farther off.
    """
    # The drawing is blurred as much, so the two stay alike.
    if extra_blur > 0.0:
        views = [
            replace(view, coverage=ndimage.gaussian_filter(view.coverage, extra_blur))
            for view in views
        ]
    problem = _Problem(views, fit, direction, extra_blur, shading, fixed_radius)
    x = problem.pack(fit)
    system = problem.system(x)
    damping = 1e-3
    for _ in range(iterations):
        step = system.step(damping)
        # A step that does not help is shortened, and one that does lets the next be longer.
        tried = problem.system(x + step)
        if tried.cost < system.cost:
            gain = system.cost - tried.cost
            x = x + step
            system = tried
            damping = max(damping / 5.0, 1e-9)
            if gain < TOLERANCE * system.cost:
                break
        else:
            damping *= 8.0
            if damping > 1e4:
                break
    # The errors of pixels, as measured, give those of the control points.
    K = len(fit.control)
    spread = system.inverse()[: 3 * K, : 3 * K] * system.pixel_variance
    return replace(problem.unpack(x), cost=system.cost, covariance=spread)


@dataclass(frozen=True, slots=True)
class _System:
    cost: float
    normal: Floats
    gradient: Floats
    pixel_variance: float

    def step(self, damping: float) -> Floats:
        # Damping by the diagonal makes the step independent of the units of the unknowns.
        H = self.normal + damping * np.diag(np.diag(self.normal) + 1e-9)
        try:
            return np.asarray(-cho_solve(cho_factor(H), self.gradient))
        # A gradient step needs no factorisation.
        except LinAlgError:
            return np.asarray(-self.gradient / (np.diag(H) + 1.0))

    def inverse(self) -> Floats:
        H = self.normal + 1e-9 * np.diag(np.diag(self.normal) + 1e-9)
        return np.asarray(cho_solve(cho_factor(H), np.eye(len(H))))


class _Problem:
    """Least squares with the unknowns of a fit.

    The unknowns x are control points, log radius, log blur, and light and slope of each view.
    """

    def __init__(
        self,
        views: Sequence[View],
        fit: Fit,
        direction: Floats,
        extra_blur: float,
        shading: bool,
        fixed_radius: bool,
    ) -> None:
        self._views = views
        self._extra = extra_blur
        self._K = K = len(fit.control)
        self._s = samples(views, fit)
        self._B = basis(self._s, K)
        self._N = _hats(self._s)
        self._shape = shape = fit.light.shape
        # Light and slope belong to one view; all else is shared, so each view touches few columns.
        by_view = np.arange(fit.light.size).reshape(shape)
        shared = np.arange(3 * K + 2)
        self._columns = [
            np.concatenate([shared, 3 * K + 2 + row, 3 * K + 2 + by_view.size + row])
            for row in by_view
        ]
        # Unknowns that stay as they are.
        self._free = np.ones(3 * K + 2 + 2 * fit.light.size, dtype=bool)
        self._free[3 * K] = not fixed_radius
        self._free[3 * K + 1] = shading
        self._free[3 * K + 2 :] = shading
        self._start = fit
        self._prior_rows, self._prior_target = self._linear_priors(direction)
        t = np.linspace(0.0, 1.0, 3 * K)
        self._speed = basis(t, K, 1)

    def pack(self, fit: Fit) -> Floats:
        return np.concatenate(
            [
                fit.control.ravel(),
                [np.log(fit.radius), np.log(fit.blur)],
                fit.light.ravel(),
                fit.slope.ravel(),
            ]
        )

    def unpack(self, x: Floats) -> Fit:
        K = self._K
        n = self._shape[0] * self._shape[1]
        return Fit(
            control=x[: 3 * K].reshape(K, 3),
            radius=float(np.exp(x[3 * K])),
            blur=float(np.exp(x[3 * K + 1])),
            light=x[3 * K + 2 : 3 * K + 2 + n].reshape(self._shape),
            slope=x[3 * K + 2 + n :].reshape(self._shape),
        )

    def system(self, x: Floats) -> _System:
        """Return the cost at x with its gradient and Gauss-Newton matrix."""
        fit = self.unpack(x)
        size = len(x)
        # Priors that are linear in x.
        normal = self._prior_rows.T @ self._prior_rows
        gradient = np.zeros(size)
        error = self._prior_rows @ x - self._prior_target
        gradient += self._prior_rows.T @ error
        cost = 0.5 * float(error @ error)

        # A rod does not stretch: its speed along the parameter is 1.
        velocity = self._speed @ fit.control
        speed = np.linalg.norm(velocity, axis=1)
        stretch = (speed - 1.0) / STRETCH / np.sqrt(3.0)  # three of them to a control point
        J = (
            (velocity / speed[:, None])[:, None, :]
            * self._speed[:, :, None]
            / STRETCH
            / np.sqrt(3.0)
        )
        J = J.reshape(len(speed), -1)
        end = 3 * self._K
        normal[:end, :end] += J.T @ J
        gradient[:end] += J.T @ stretch
        cost += 0.5 * float(stretch @ stretch)

        # Pixels, with the weights of Cauchy's loss.
        squares = 0.0
        count = 0
        for index, view in enumerate(self._views):
            image = draw(view, index, fit, self._s, self._extra)
            error = (image.value - view.coverage.ravel()[image.pixel]) / PIXEL
            weight = 1.0 / (1.0 + (error / ROBUST) ** 2)
            cost += 0.5 * ROBUST**2 * float(np.log1p((error / ROBUST) ** 2).sum())
            squares = squares + float(weight @ error**2)
            count = count + len(error)
            J = self._derivatives(image, fit) / PIXEL
            columns = self._columns[index]
            normal[np.ix_(columns, columns)] += (J * weight[:, None]).T @ J
            gradient[columns] += J.T @ (weight * error)
        # A fixed unknown has the equation step = 0.
        fixed = ~self._free
        normal[fixed] = 0.0
        normal[:, fixed] = 0.0
        gradient[fixed] = 0.0
        normal[fixed, fixed] = 1.0
        return _System(cost, normal, gradient, squares / max(count, 1))

    def _derivatives(self, image: TubeImage, fit: Fit) -> Floats:
        """Return d I / d (control points, log radius, log blur, this view's light and slope)."""
        K = self._K
        nodes = self._shape[1]
        J = np.zeros((len(image.pixel), 3 * K + 2 + 2 * nodes))
        for side in image.sides:
            B = self._B[side.sample]
            N = self._N[side.sample]
            # The picture moves with the sample, and the sample with the control points.
            for axis in range(3):
                J[:, axis : 3 * K : 3] += B * side.by_point[:, axis, None]
            J[:, 3 * K] += side.by_radius
            J[:, 3 * K + 1] += side.by_blur * fit.blur**2 / (fit.blur**2 + self._extra**2)
            J[:, 3 * K + 2 : 3 * K + 2 + nodes] += N * side.by_light[:, None]
            J[:, 3 * K + 2 + nodes :] += N * side.by_slope[:, None]
        return J

    def _linear_priors(self, direction: Floats) -> tuple[Floats, Floats]:
        """Return rows A and targets b of the priors |A x - b|^2 that are linear in x."""
        K = self._K
        (views, nodes) = self._shape
        size = len(self._free)
        blocks: list[tuple[Floats, Floats]] = []

        def add(rows: Floats, target: Floats | float = 0.0) -> None:
            blocks.append(
                (rows, np.broadcast_to(np.asarray(target, dtype=np.float64), (len(rows),)))
            )

        def on_axes(row: Floats) -> Floats:  # one row for each of x, y and z
            rows = np.zeros((3, size))
            for axis in range(3):
                rows[axis, axis : 3 * K : 3] = row
            return rows

        # The rod begins at the clamp, in the direction of the clamp.
        add(on_axes(basis(np.zeros(1), K)[0] / CLAMP))
        add(on_axes(basis(np.zeros(1), K, 1)[0] / CLAMP_TANGENT), direction / CLAMP_TANGENT)
        # It bends smoothly: its third derivative, one in each interval of knots, is small.
        intervals = K - 3
        for row in basis((np.arange(intervals) + 0.5) / intervals, K, 3):
            add(on_axes(row / JERK))
        # Radius and blur stay near their first values, unless pixels say otherwise.
        for unknown, value, spread in (
            (3 * K, np.log(self._start.radius), LOG_RADIUS),
            (3 * K + 1, np.log(self._start.blur), LOG_BLUR),
        ):
            row = np.zeros((1, size))
            row[0, unknown] = 1.0 / spread
            add(row, value / spread)
        # Light is about 1 and even over the picture, and changes smoothly along the rod.
        bend = np.diff(np.eye(nodes), 2, axis=0) / LIGHT_BEND
        for group, (value, spread) in enumerate(((1.0, LIGHT), (0.0, SLOPE))):
            for view in range(views):
                at = 3 * K + 2 + (group * views + view) * nodes
                rows = np.zeros((nodes + len(bend), size))
                rows[:nodes, at : at + nodes] = np.eye(nodes) / spread
                rows[nodes:, at : at + nodes] = bend
                add(rows, np.concatenate([np.full(nodes, value / spread), np.zeros(len(bend))]))
        matrix = np.concatenate([rows for rows, _ in blocks])
        targets = np.concatenate([target for _, target in blocks])
        return matrix, targets


def _hats(s: Floats) -> Floats:
    """Return hat functions on evenly spaced nodes, (n, LIGHT_NODES)."""
    position = s[:, None] * (LIGHT_NODES - 1)
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(position - np.arange(LIGHT_NODES))))
