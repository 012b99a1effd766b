"""Services for the scenes of all kinds.

They give a build, records and pictures in the store, and one renderer at a time.
"""

from __future__ import annotations

import hashlib
import io
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.base import Reason, content_key
from stickslip_schemas.documents.tasks import ChunkRef, RecordRef, TaskResult
from stickslip_schemas.format.codecs import encode_chunk
from stickslip_schemas.plan.builds import UNCOUNTED, digests, sources
from stickslip_schemas.spec.cameras import Camera, rig_digest
from stickslip_schemas.store import open_store, write_durably

from stickslip_blender.cycles.engine import blender_version, described
from stickslip_blender.raster._raster import BUILD_HASH

if TYPE_CHECKING:  # content keys hold whole documents; the modules that define them are in no build
    from stickslip_schemas.spec.jobs import Render

ShadingArray = npt.NDArray[np.float16]
"""A linear shading, shape (frames, FINE height, FINE width, 3).

The channels belong to the albedos of `shading.CAMERA_ALBEDOS`.
"""

FRAME_MARGIN = 1.0
"""Least distance of a rod or a cloth from the edge of the frame [px]."""
SHADING_BYTES = 4 * 2**30
"""Limit of the shadings kept in a store [bytes]: some hundred clips of 30 frames."""

_LIBRARIES = ("numcodecs", "google-crc32c", "numpy", "pillow")

Array = npt.NDArray[Any]


def roots(kind: str) -> tuple[str, ...]:
    """Return the modules that start the build of a kind's renderer."""
    return ("stickslip_blender.actor", f"stickslip_blender.scenes.{kind}")


@cache
def build_digest(kind: str) -> str:
    """Return the SHA-256 over the sources that render a kind, and versions.

    No path, time or host name is part of it.
    """
    content = {
        "kind": kind,
        "sources": digests(sources(roots(kind), cut=UNCOUNTED)),
        "raster": BUILD_HASH,
        "libraries": {library: metadata.version(library) for library in _LIBRARIES},
        **blender_version(),
        **described(),
    }
    return content_key("build/render", content)


class RenderContext:
    """Reads records and publishes pictures.

    It keeps the last record and one renderer, because Blender holds one scene per process. Several
    tasks share them.
    """

    def __init__(self, store: str) -> None:
        self.store = open_store(store)
        self.shadings: OrderedDict[str, ShadingArray] = OrderedDict()
        """The last shadings of cloth, by key.

        Clips that differ only in their texture share a shading.
        """
        self._renderer: tuple[object, Any] | None = None
        self._records: tuple[str, dict[str, Array]] = ("", {})

    def kept_shading(self, key: str) -> bytes | None:
        """Return a shading that any process kept in the store.

        Return None for a missing or damaged shading.
        """
        path = self._shading_path(key)
        if path is None:
            return None
        try:
            data = path.read_bytes()
            path.touch()  # the oldest are deleted first
        except OSError:
            return None
        digest = data[:32]
        body = data[32:]
        return body if hashlib.sha256(body).digest() == digest else None

    def keep_shading(self, key: str, data: bytes) -> None:
        """Keep a shading in the store for later textures.

        If the shadings exceed SHADING_BYTES, the oldest are deleted. No result depends on a kept
        shading: if it cannot be written, it is rendered again.
        """
        path = self._shading_path(key)
        if path is None:
            return
        with suppress(OSError):
            write_durably(path, hashlib.sha256(data).digest() + data)
            files = sorted(path.parent.glob("[0-9a-f]*"), key=lambda file: file.stat().st_mtime)
            room = SHADING_BYTES - sum(file.stat().st_size for file in files)
            for file in files[:-1]:
                if room >= 0:
                    break
                room += file.stat().st_size
                file.unlink(missing_ok=True)

    def _shading_path(self, key: str) -> Path | None:
        return None if self.store.cache is None else self.store.cache / "shadings" / key

    def record(self, record: RecordRef) -> dict[str, Array]:
        """Return one row of all arrays of an artifact, by name."""
        digest, arrays = self._records
        if digest != record.digest:
            with np.load(io.BytesIO(self.store.read(record.digest)), allow_pickle=False) as file:
                arrays = dict(file)
            self._records = record.digest, arrays
        rows = len(next(iter(arrays.values())))
        if record.row >= rows:
            raise ValueError(
                f"record.row must be below {rows}, the rows of {record.digest}; got {record.row}"
            )
        return {name: values[record.row] for name, values in arrays.items()}

    def renderer(self, scene: object, build: Callable[[], Any]) -> Any:
        """Return the renderer of a scene: the last one if it fits, or a new one in its place."""
        if self._renderer is None or self._renderer[0] != scene:
            self._renderer = None  # a build ends the last renderer, even if it fails
            self._renderer = scene, build()
        return self._renderer[1]

    def chunk(self, values: Array, encode: Callable[[Array], bytes] = encode_chunk) -> ChunkRef:
        """Publish the values of one sample as a chunk."""
        chunk = encode(np.ascontiguousarray(values))
        return ChunkRef(digest=self.store.publish(chunk), offset=0, length=len(chunk))


def check_rig(render: Render) -> None:
    """Raise ValueError if a render document has other cameras than this installation."""
    if render.rig is not None and render.rig_digest != rig_digest(render.rig):
        raise ValueError(
            f"render.rig_digest must be that of {render.rig} here, {rig_digest(render.rig)}; got "
            f"{render.rig_digest}"
        )


def why_unfit(
    thing: str, points: Array, radius: float, cameras: tuple[Camera, ...]
) -> TaskResult | None:
    """Return a rejection of points (..., 3) that cannot be rendered, or None.

    Such points are not finite, or they leave the frame of a camera.
    """
    if not np.isfinite(points).all():
        return rejected(Reason.invalid_sample, f"the {thing} has positions that are not finite")
    overflow = {camera.name: camera.overflow(points, radius, FRAME_MARGIN) for camera in cameras}
    outside = [
        f"the {thing} leaves view {name} by {excess:.1f} px"
        for name, excess in overflow.items()
        if excess > 0.0
    ]
    return rejected(Reason.out_of_frame, "; ".join(outside)) if outside else None


def rejected(reason: Reason, message: str) -> TaskResult:
    """Return the result of a sample that is rejected for a physical reason."""
    return TaskResult(outcome="rejected", reason=reason, message=message)
