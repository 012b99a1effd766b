"""Import of a user's video of the drag scene: clock and registration from the path of the holders.

The path of the two holders is known, so it gives both the clock and the registration of the camera.
Two small patches of cloth under the holders are tracked [Lucas and Kanade 1981]. With P the
projection by the calibrated camera, and h_c(t) the place of holder c on the path,

    p_c(t) = P(h_c(t - t0)) + w(t)

gives the start t0 of the path. The common motion w(t) of both holders is that of a shaking camera,
which is removed. If the floor has marks, it gives w(t) to 0.1 px, and the holders' patches,
which change as they come nearer, to 0.3 px: see `floor_motion`. The difference between the two
holders is the residual.
"""

import math
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from pydantic import ValidationError
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from stickslip_schemas.installation import install_hint
from stickslip_schemas.spec.cameras import Camera, undistorted

from stickslip_training.arrays import Array, Floats
from stickslip_training.cloth.clips import INSTANTS, LATE_MAX, RATE, Clips, frames_at
from stickslip_training.cloth.crop import PATCH, Cameras, Crops, cut, holder_crops, holder_path

PATCH_BELOW = 0.005
"""Their depth below the held edge [m]."""

WINDOW = 0.012
"""Side of the tracked patch [m]."""

MATCH_MAX = 1.0
"""Largest distance of a match with the kept frame from the sum of the steps since; beyond it
another frame is kept [px]."""

_WIDE = 224  # width of the pictures that limits are for [px]

RESIDUAL_MAX = 1.0
"""[px of a picture 224 px wide]"""

TIMING_MAX = 0.1
"""Largest spread of the starts found in the whole video and in its two halves [s]."""

FLOOR_MAX = 0.08
"""Largest standard deviation of the floor's motion at which it counts as the camera's [px of a
picture 224 px wide]. Noise without marks has 0.09 or more, and 24 films over six floors have 0.073
or less."""

APART_MAX = 2.0
"""Largest difference between the motions of floor and holders [px of a picture 224 px wide]."""

CUT_MAX = 1.0
"""Latest time at which a video may begin after the start [s]: the holders have come 5 mm down by
then.
"""


class VideoError(ValueError):
    """The video cannot be measured; the message has the measured number and its limit."""


@dataclass(frozen=True)
class Registration:
    """Clock and registration of a video."""

    start: float
    """Time in the video at which the holders start [s]."""
    timing: float
    """Spread of the starts: of the whole video or as given, of its first and of its second half
    [s].
    """
    residual: float
    """RMS of the difference between the two holders, per coordinate [px of a picture 224 px wide].
    """

    def refusals(self) -> list[str]:
        """Return why the video must not be measured, if it must not."""
        rules = {
            f"the holders must move as one on their path to within {RESIDUAL_MAX:g} px of "
            "a picture 224 px wide, and "
            f"are {self.residual:.2f} px off": self.residual <= RESIDUAL_MAX,
            "the start must be the same in both halves of the video to within "
            f"{TIMING_MAX:g} s, and differs by "
            f"{self.timing:.2f} s": self.timing <= TIMING_MAX,
        }
        return [rule for rule, holds in rules.items() if not holds]


def load_camera(path: str | Path) -> Camera:
    """Read a camera: the keys of a camera of our rigs; `rotation` may be OpenCV's vector.

    Raises ValueError, naming the field, the rule and the value.
    """
    try:
        content = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path} must be TOML: {error}") from error
    rotation = content.get("rotation")
    if (
        isinstance(rotation, list)
        and len(rotation) == 3
        and all(isinstance(r, int | float) for r in rotation)
    ):
        content["rotation"] = Rotation.from_rotvec(rotation).as_matrix().tolist()
    try:
        return Camera.model_validate({"name": "custom", **content})
    except ValidationError as error:
        problems = [f"{'.'.join(map(str, each['loc']))}: {each['msg']}" for each in error.errors()]
        raise ValueError(f"{path} must describe a camera: {'; '.join(problems)}") from error


def import_video(
    path: str | Path,
    camera: Camera,
    *,
    start: float | None = None,
    frame_rate: float | None = None,
    since: float = -math.inf,
) -> tuple[Clips, Registration]:
    """Return the clip of a video, of which nothing is known to be true, and the registration.

    Args:
        path: The video; it may begin up to `CUT_MAX` after the holders start.
        camera: The camera that took it.
        start: Time in the video at which the holders start [s]; by default it is found.
        frame_rate: Frames a second; by default the video has the time of every frame.
        since: Time of the first frame that is read [s]: what is before is no drag.

    Raises:
        VideoError: The video cannot be measured.
    """
    if frame_rate is not None and not 0 < frame_rate < math.inf:
        raise VideoError(
            f"frame_rate must be more than 0 frames a second and finite, and is {frame_rate:g}"
        )
    times, tracks = _follow(path, camera, frame_rate, since)
    _check_times(times)
    registration, holder_motion = _register(times, tracks, camera.straight, start)
    reasons = registration.refusals()
    if reasons:
        raise VideoError("; ".join(reasons))

    # Only the frames at the instants that a network reads are decoded in full.
    frames, instants = frames_at((times - registration.start) * RATE)
    first, *pictures = _pictures(path, camera, [0, *frames], since)
    motion = _camera_motion(first, pictures, holder_motion[frames], camera.width / _WIDE)

    # The crop follows the camera, so that the cloth is seen as by a camera that stands still.
    registered = holder_crops(Cameras.of([camera.straight]), instants)
    offset = torch.from_numpy(motion.astype(np.float32))[None]
    video = torch.from_numpy(np.stack(pictures).astype(np.float32) / 255)[None]
    crops = cut(video, Crops(registered.origin + offset, registered.scale))
    clip = Clips(
        crops=crops,
        direction=torch.tensor(camera.rotation[2])[None],
        material=np.array([-1]),
        mu=np.array([math.nan]),
        run=np.array([0]),
        cover=torch.full_like(crops, math.nan),
    )
    return clip, registration


def _check_times(times: Floats) -> None:
    """Raise VideoError if a video is too short, or has too few frames a second."""
    duration = times[-1] - times[0]
    shortest = INSTANTS[-1] / RATE - CUT_MAX
    if duration < shortest:
        raise VideoError(
            f"the video must show {shortest:.0f} s from the start on, and lasts {duration:.1f} s"
        )
    # A frame is then no farther from an instant than `LATE_MAX`.
    rate = 1.0 / float(np.median(np.diff(times)))
    slowest = 0.5 / LATE_MAX
    if rate < slowest:
        raise VideoError(
            f"frame_rate must be at least {slowest:.1f} frames a second, and is {rate:.1f}"
        )


def _camera_motion(
    first: npt.NDArray[np.uint8],
    pictures: Sequence[npt.NDArray[np.uint8]],
    holder_motion: Floats,
    pixel: float,
) -> Floats:
    """Return the motion of the camera at each picture, (F, 2) [px].

    It is that of the floor, which is surer, if the floor has marks. Otherwise it is the common
    motion of the holders, (F, 2) [px]. `pixel` is a pixel of a picture 224 px wide [px].
    """
    near = holder_motion / pixel
    pairs = zip(pictures, near, strict=True)
    motions, deviations = zip(
        *(floor_motion(first, picture, start) for picture, start in pairs), strict=True
    )
    if max(deviations) > FLOOR_MAX:
        return holder_motion
    motion = np.array(motions)
    difference = np.abs(motion - near).max()
    if difference > APART_MAX:
        raise VideoError(
            "the floor and the holders must show one motion of the camera to within "
            f"{APART_MAX:g} px of a picture 224 px wide, and differ by {difference:.1f}"
        )
    return np.asarray(motion * pixel)


# --- following the holders
# -------------------------------------------------------------------------------------


def read_frames(
    path: str | Path, since: float = -math.inf
) -> Iterator[tuple[float, npt.NDArray[np.uint8]]]:
    """Yield the time [s] and the grey levels (H, W) of every frame from a time on [s].

    Raises:
        VideoError: The file is no video that FFmpeg reads.
    """
    try:
        import av
    except ModuleNotFoundError as error:
        raise VideoError(
            "reading videos needs PyAV: " + install_hint("stickslip-training", "video")
        ) from error
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise VideoError(f"{path} must have a picture: it has none")
            for frame in container.decode(video=0):
                if frame.time is None:
                    raise VideoError(f"every frame of {path} must have a time, and one has none")
                if frame.time < since:
                    continue
                yield (
                    float(frame.time),
                    frame.to_ndarray(format="gray").astype(np.uint8, copy=False),
                )
    except (av.error.FFmpegError, OSError) as error:
        raise VideoError(f"{path} must be a video that FFmpeg reads: {error}") from error


def holder_points(instants: Array) -> Floats:
    """Return the middles of the two held patches, (F, 2, 3) [m], at instants (F,).

    Instants need not be whole.
    """
    x, z = (np.asarray(part, dtype=np.float64) for part in holder_path(instants))
    return np.stack(
        np.broadcast_arrays(x[:, None], (-PATCH, PATCH), z[:, None] - PATCH_BELOW), axis=-1
    )


def _follow(
    path: str | Path, camera: Camera, frame_rate: float | None, since: float
) -> tuple[Floats, Floats]:
    """Return times (N,), and places (N, 2, 2) of the held patches without distortion [px]."""
    try:
        import cv2
    except ModuleNotFoundError as error:
        raise VideoError(
            "following the holders needs OpenCV: " + install_hint("stickslip-training", "video")
        ) from error
    # A window of the same size on the cloth, whatever the camera.
    start, depth = camera.project(holder_points(np.zeros(1))[0])
    window = max(9, round(WINDOW * camera.fx / float(depth.mean())) | 1)
    precise = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 0.003)
    flow = partial(cv2.calcOpticalFlowPyrLK, winSize=(window, window), criteria=precise)
    times: list[float] = []
    tracks: list[Any] = []
    before = reference = None
    patches = reference_patches = start.astype(np.float32)[:, None]
    for number, (frame_time, picture) in enumerate(read_frames(path, since)):
        time = frame_time if frame_rate is None else number / frame_rate
        _check_size(picture, camera)
        if before is None:
            reference = picture
        else:
            step, is_tracked, _ = flow(before, picture, patches, None, maxLevel=2)
            if not is_tracked.all():
                raise VideoError(f"the holders must stay in sight, and are lost at {time:.1f} s")
            # Errors of steps from frame to frame add up. Those of a match with one frame that is
            # kept for long do not.
            near = {"maxLevel": 0, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
            patches, is_tracked, _ = flow(
                reference, picture, reference_patches, step.copy(), **near
            )
            if not is_tracked.all() or np.abs(patches - step).max() > MATCH_MAX:
                patches = reference_patches = step
                reference = picture
        times.append(time)
        tracks.append(patches.reshape(2, 2).copy())
        before = picture
    if len(times) < 2:
        raise VideoError(f"{path} must have frames, and has {len(times)}")

    # Take the distortion of the lens out of the tracks.
    focal = np.array((camera.fx, camera.fy))
    center = np.array((camera.cx, camera.cy))
    u, v = np.moveaxis((np.array(tracks, dtype=np.float64) - center) / focal, -1, 0)
    flat = np.stack(undistorted(u, v, camera.distortion), axis=-1)
    return np.array(times), focal * flat + center


def _check_size(picture: npt.NDArray[np.uint8], camera: Camera) -> None:
    """Raise VideoError if a frame does not have the size of the calibration."""
    height, width = picture.shape
    if (width, height) != (camera.width, camera.height):
        raise VideoError(
            f"frames must have the size of the calibration, {camera.width} x {camera.height}, "
            f"and have {width} x {height}"
        )


def _register(
    times: Floats, tracks: Floats, camera: Camera, start: float | None
) -> tuple[Registration, Floats]:
    """Return the registration, and the motion of the camera, (N, 2) [px].

    The motion is the common motion of both holders besides the path, from the first frame on.
    """

    def path_error(t0: float, part: slice = slice(None)) -> Floats:
        """Return tracks less the path, less their median, (N, 2, 2)."""
        path = camera.project(holder_points(np.maximum(times[part] - t0, 0.0) * RATE))[0]
        error = tracks[part] - path
        return np.asarray(error - np.median(error, axis=(0, 1)))

    second = max(1, round(1.0 / float(np.median(np.diff(times)))))  # in frames

    def fitted_start(part: slice, near: float) -> float:
        """Return the start that fits a part of the video best."""

        def residuals(t0: Floats) -> Floats:
            # Changes within a second tell: a hand wanders slowly, and the holders turn fast.
            error = path_error(float(t0[0]), part)
            return np.asarray(error[second:] - error[:-second]).ravel()

        fit = least_squares(residuals, np.array([near]), loss="soft_l1", diff_step=np.array([1e-4]))
        return float(fit.x[0])

    if start is None:
        # The error has several minima, so half seconds are tried first, on 600 frames or so.
        tried = np.arange(times[0] - CUT_MAX, times[-1] - 30.0, 0.5)
        thinned = slice(None, None, max(1, len(times) // 600))
        costs = [np.abs(path_error(t0, thinned)).sum() for t0 in tried]
        start = fitted_start(slice(None), float(tried[np.argmin(costs)]))

    # Both halves must agree: another path, or another speed, fits each half at another start.
    half = int(np.searchsorted(times, start + 0.5 * (times[-1] - start)))
    halves = [fitted_start(part, start) for part in (slice(None, half), slice(half, None))]
    timing = float(np.ptp([start, *halves]))

    # A camera moves both holders alike. Their difference is no motion of the camera.
    error = path_error(start)
    common = error.mean(axis=1)
    difference = error - common[:, None]
    residual = float(np.sqrt(difference.var(axis=0).mean())) * _WIDE / camera.width
    return Registration(start, timing, residual), common - common[0]


def _pictures(
    path: str | Path, camera: Camera, chosen: list[int], since: float
) -> list[npt.NDArray[np.uint8]]:
    """Return some frames without the distortion of the lens, (H, W) each."""
    import cv2

    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    frames = {
        number: picture
        for number, (_, picture) in enumerate(read_frames(path, since))
        if number in chosen
    }
    return [cv2.undistort(frames[number], matrix, np.array(camera.distortion)) for number in chosen]


def floor_motion(
    before: npt.NDArray[np.uint8], after: npt.NDArray[np.uint8], near: Floats
) -> tuple[Floats, float]:
    """Return the motion of the floor between two pictures (H, W), (2,), and its deviation.

    All are in pixels of a picture 224 px wide. The motion is looked for within 2 px or so of
    `near`, which the holders tell, and of 0, since they may be lost and a tripod does not move. The
    surer of both is returned.
    """
    import cv2

    size = (_WIDE, round(_WIDE * before.shape[0] / before.shape[1]))
    small = [
        cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        for picture in (before, after)
    ]
    a, b = (
        cv2.GaussianBlur(picture, (0, 0), 0.7) - cv2.GaussianBlur(picture, (0, 0), 3.0)
        for picture in small
    )
    return min(
        (_aligned(a, b, start) for start in (near, np.zeros(2))), key=lambda alignment: alignment[1]
    )


def _aligned(a: Any, b: Any, start: Floats) -> tuple[Floats, float]:
    """Return the motion d from picture A to B, (H, W) each, and its deviation [px].

    The pictures have nothing that is wider than 3 px.

    From `start` on, Gauss-Newton steps with the weights of the step before minimize

        sum_x r^2 / (1 + (e / e_f)^4),   r(x) = B(x + d) - A(x),   e^2 = r^2 within 3 px of x

    A fifth of the picture has an e below e_f: that is floor, and not cloth. Only slopes of both
    make d certain.
    """
    import cv2

    def inner(field: Any) -> Any:
        return np.asarray(field)[..., 8:-8, 8:-8].reshape(*np.shape(field)[:-2], -1)

    rounded = 1 / 12  # variance of grey levels that are rounded to whole ones
    motion = start.copy()
    step = np.ones(2)
    slopes = inner(np.gradient(a)[::-1])
    for _ in range(20):
        place = np.hstack([np.eye(2), motion[:, None]])
        moved = cv2.warpAffine(
            b, place, a.shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        )
        energy = inner(cv2.GaussianBlur((moved - a) ** 2, (0, 0), 3.0))
        weight = 1 / (1 + (energy / max(rounded, np.quantile(energy, 0.2))) ** 2)
        if np.abs(step).max() < 0.01:
            break
        step = np.linalg.lstsq(
            (weight * slopes) @ slopes.T, (weight * slopes) @ inner(moved - a), rcond=None
        )[0]
        motion -= step
    common = (weight * slopes) @ inner(np.gradient(moved)[::-1]).T
    sure = np.linalg.eigvalsh((common + common.T) / 2)[0]
    noise = max(rounded, np.average(inner(moved - a) ** 2, weights=weight))
    return motion, math.sqrt(noise / sure) if sure > 0 else math.inf
