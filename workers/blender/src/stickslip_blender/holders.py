"""The two holders that a dragged cloth hangs from [thesis, 4.2.3]."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from stickslip_blender.geometry import Prop, box

HOLDER = (0.004, 0.01, 0.01)
"""Of the clip at a corner [m]: across the cloth, and in its plane as in the simulation."""
ROD = (0.003, 0.003, 0.5)
"""Of the rod that the clip hangs on [m]."""
_AIM = 0.05  # [m], the height that the lamp points to, under the holders

Array = npt.NDArray[np.float64]


class Holders:
    """Two holders at the upper corners of the cloth; the lamp follows them."""

    def __init__(self, rest: npt.ArrayLike) -> None:
        """Find the corners of a cloth whose held edge is the last one of its rest shape (V, 2) [m]."""
        flat = np.asarray(rest, dtype=np.float64)
        low, high = flat.min(axis=0), flat.max(axis=0)
        corners = np.array([(low[0], high[1]), (high[0], high[1])])
        self._held = np.abs(flat[:, None] - corners).sum(axis=2).argmin(axis=0)
        inward = np.sign((low + high) / 2 - corners) * HOLDER[1] / 2
        self._grips = np.pad(inward, ((0, 0), (1, 0)))  # from a corner to the middle of its holder (x, y, z) [m]
        vertices, faces = _holder()
        self.props = tuple(Prop(f"holder-{n}", vertices, faces, (0.05, 0.05, 0.052), 0.45) for n in (1, 2))

    def placed(self, _instant: int, vertices: Array) -> list[Array]:
        """Let the holders follow the corners that they hold."""
        return [prop.vertices + at for prop, at in zip(self.props, vertices[self._held] + self._grips, strict=True)]

    def aim(self, _instant: int, vertices: Array) -> Array:
        """Return a point below the middle of the holders."""
        return np.array([vertices[self._held, 0].mean(), 0.0, _AIM])


def _holder() -> tuple[Array, list[tuple[int, ...]]]:
    """Return a clip of one centimetre, about its middle, and the rod it hangs on."""
    boxes = [box(HOLDER, (0.0, 0.0, 0.0)), box(ROD, (0.0, 0.0, ROD[2] / 2))]
    faces = [tuple(8 * number + index for index in face) for number, (_, sides) in enumerate(boxes) for face in sides]
    return np.concatenate([corners for corners, _ in boxes]), faces
