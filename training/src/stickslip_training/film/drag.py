"""The drag in a film, after the tray lies level again: the network reads its friction.

The tray's board gives the camera of the drag: axes of `cloth_drag` begin at the start line,
`START_LINE` down the slope from the middle of the board, x down the slope and z out of the tray.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from stickslip_schemas.spec.cameras import Camera

from stickslip_training.arrays import Floats
from stickslip_training.cloth.clips import INSTANTS, RATE
from stickslip_training.cloth.evaluation import predictions
from stickslip_training.cloth.model import WEIGHTS, load_friction
from stickslip_training.cloth.video import CUT_MAX, VideoError, import_video
from stickslip_training.film.measuring import Film
from stickslip_training.film.poses import Lens, Pose, pose_of

START_LINE = 0.2
"""Distance of the start line from the middle of the tray's board, down the slope [m]: a sheet of
0.2 m is then free of the paper."""
SHORTEST = INSTANTS[-1] / RATE - CUT_MAX
"""Time that a drag takes in a film [s]."""


@dataclass(frozen=True)
class Drag:
    """What the network says of a drag."""

    begins: float | None
    """Time of the first frame that was read [s]."""
    mu: Mapping[str, Any] | None
    """Median, low and high of the 80 % interval, and above; None without an answer."""
    no_answer: str | None
    """Why there is no answer."""


def read_drag(film: Film, begin: float | None = None) -> Drag:
    """Return what the network of the package says of the drag in a film.

    Args:
        film: The measured film.
        begin: Time at which the holders are at their start [s]; by default when the tray lies level
            again.
    """
    start = film.level_again if begin is None else begin
    if start is None:
        return Drag(None, None, "the tray never lies level again after the tilt")
    left = film.sightings.end - start
    if left < SHORTEST:
        return Drag(
            start,
            None,
            f"the film has no drag: it goes on for {left:.1f} s after {start:.1f} s, and a drag "
            f"takes {SHORTEST:.0f} s or more",
        )
    try:
        camera = camera_of(film, start)
        clips, _ = import_video(film.path, camera, since=start)
    except VideoError as error:
        return Drag(start, None, str(error))
    model = load_friction(WEIGHTS)
    answer = predictions(model.estimate(clips), [0], model.judge(clips))[0]
    return Drag(start, answer["mu"], answer["no_answer"])


def camera_of(film: Film, time: float) -> Camera:
    """Return the camera of the drag scene, from the tray's board in the first frame from a time on.

    Raises:
        VideoError: No later frame shows both boards.
    """
    later = np.flatnonzero(film.sightings.times >= time)
    if not len(later):
        raise VideoError(
            f"boards: both must be in sight at {time:.1f} s, when the drag begins, and no later "
            "frame shows both"
        )
    first = int(later[0])
    pose = pose_of(film.sightings.sights[first]["tray"], film.lens)
    return scene_camera(pose, film.lens, film.downhill)


def scene_camera(pose: Pose, lens: Lens, downhill: Floats) -> Camera:
    """Return a camera in axes of `cloth_drag`.

    `downhill` is the direction of the slope on the board.
    """
    x = np.append(downhill, 0.0)
    z = np.array([0.0, 0.0, 1.0])
    axes = np.column_stack([x, np.cross(z, x), z])
    rotation = pose.rotation @ axes
    place = pose.rotation @ (START_LINE * x) + pose.place
    return Camera(
        name="phone",
        width=lens.width,
        height=lens.height,
        fx=lens.focal,
        fy=lens.focal,
        cx=(lens.width - 1) / 2,
        cy=(lens.height - 1) / 2,
        rotation=tuple(map(tuple, rotation.tolist())),
        translation=tuple(place.tolist()),
        distortion=tuple(lens.distortion.tolist()),
    )
