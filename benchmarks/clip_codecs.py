"""How small real clips get without loss, and what it costs to write and read them, by order of axes and codec.

    .venv/bin/python benchmarks/clip_codecs.py CLIPS.npy [CLIPS.npy ...]

A file holds clips (textures, frames, height, width, 3) of uint8: `benchmarks/render_cloth.py --clip` writes one. Every
codec is one that Zarr v3 has: `transpose`, `numcodecs.delta`, and `zstd` or `blosc`. Seconds are CPU time for a clip,
the least of some; the ratio is that of all bytes.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numcodecs import blosc
from numcodecs.zstd import Zstd

AXES = "tyxc"
blosc.use_threads = False


@dataclass(frozen=True)
class Codec:
    """One way to write a clip."""

    order: str
    """Axes from slow to fast."""
    delta: bool
    """Whether differences of neighbours are written."""
    name: str
    encode: Callable[[np.ndarray], bytes]
    decode: Callable[[bytes], bytes]

    @property
    def label(self) -> str:
        return f"{self.order} {'delta ' * self.delta}{self.name}"

    def write(self, clip: np.ndarray) -> bytes:
        turned = np.ascontiguousarray(clip.transpose([AXES.index(axis) for axis in self.order]))
        return self.encode(np.diff(turned.ravel(), prepend=np.uint8(0)) if self.delta else turned)

    def read(self, data: bytes, clip: np.ndarray) -> None:
        shape = [clip.shape[AXES.index(axis)] for axis in self.order]
        flat = np.frombuffer(self.decode(data), dtype=np.uint8)
        if self.delta:
            flat = np.cumsum(flat, dtype=np.uint8)
        clip[:] = flat.reshape(shape).transpose([self.order.index(axis) for axis in AXES])


def zstd(level: int, order: str, *, delta: bool = False) -> Codec:
    return Codec(order, delta, f"zstd {level}", Zstd(level=level).encode, Zstd().decode)


def blosc_zstd(level: int, order: str, shuffle: int, *, delta: bool = False, block: int = 0) -> Codec:
    codec = blosc.Blosc("zstd", level, shuffle, blocksize=block)
    names = {blosc.NOSHUFFLE: "", blosc.SHUFFLE: ", shuffled", blosc.BITSHUFFLE: ", bits shuffled"}

    def encode(values: np.ndarray) -> bytes:
        return bytes(codec.encode(values.ravel().view("V3")))  # bits of red, green and blue apart

    return Codec(order, delta, f"blosc zstd {level}{names[shuffle]}", encode, codec.decode)


_BLOSC = ((6, blosc.SHUFFLE), (6, blosc.BITSHUFFLE), (6, blosc.NOSHUFFLE))


CODECS = [
    zstd(3, "tyxc"),  # of datasets before 2026-11-22
    *(zstd(level, "ytxc") for level in (3, 6, 9, 11, 12)),  # 11 is that of datasets since
    *(zstd(9, order) for order in ("tyxc", "ytcx", "tcyx", "cytx", "yxct", "cyxt")),
    *(zstd(9, order, delta=True) for order in ("ytxc", "tcyx", "cytx")),
    *(blosc_zstd(level, "ytxc", shuffle, block=16 * 30 * 224 * 3) for level, shuffle in _BLOSC),
]


def least(function: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("clips", type=Path, nargs="+")
    arguments.add_argument("--repeats", type=int, default=3)
    arguments.add_argument("--only", metavar="LABEL", help="codecs whose labels begin so, as in 'ytxc zstd'")
    options = arguments.parse_args()
    sets = {path.stem: np.load(path) for path in options.clips}
    if len(sets) > 1:
        sets["all of them"] = np.concatenate(list(sets.values()))
    for name, clips in sets.items():
        print(f"{name}: {len(clips)} clips, {clips.nbytes / 1e6:.1f} MB")
        for codec in CODECS:
            if options.only is None or codec.label.startswith(options.only):
                print(f"  {codec.label:40} {measured(codec, clips, options.repeats)}", flush=True)


def measured(codec: Codec, clips: np.ndarray, repeats: int) -> str:
    """Return how small clips get, and what it costs."""
    written = [codec.write(clip) for clip in clips]
    read = np.empty_like(clips)

    def decoded() -> None:
        for data, clip in zip(written, read, strict=True):
            codec.read(data, clip)

    encode = least(lambda: [codec.write(clip) for clip in clips], 1)
    decode = least(decoded, repeats)
    if not np.array_equal(read, clips):
        raise RuntimeError(f"{codec.name} in the order {codec.order} loses something")
    ratio = clips.nbytes / sum(map(len, written))
    per_clip = 1e3 / len(clips)
    return f"{ratio:5.2f} x, write {encode * per_clip:6.1f} ms, read {decode * per_clip:5.1f} ms"


if __name__ == "__main__":
    main()
