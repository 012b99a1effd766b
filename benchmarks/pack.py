"""Cost of packing a 64-sample shard of views against the cost of encoding its chunks [CPU seconds].

    .venv/bin/python benchmarks/pack.py

Pictures are made up: a bright tube on a dark ground, as smooth as rendered ones.
"""

import tempfile
import time
from collections.abc import Callable

import numpy as np
from stickslip_schemas.documents.tasks import ChunkRef, PackSlot, PackTask, RecordRef
from stickslip_schemas.format.codecs import encode_chunk
from stickslip_schemas.format.manifest import layout
from stickslip_schemas.kinds.rod_hang import RodHangSpec
from stickslip_schemas.store import DirectoryStore
from stickslip_workers.stages.pack import pack
from stickslip_workers.stages.run import encode_records

SAMPLES = 64
REPEATS = 5


def picture(sample: int) -> np.ndarray:
    """Return four views, (1, 4, 224, 224, 3) uint8."""
    y, x = np.mgrid[:224, :224] / 224
    views = []
    for view in range(4):
        middle = 0.5 + 0.3 * np.sin(7 * y + sample + view) * y
        tube = np.clip(1 - ((x - middle) / 0.03) ** 2, 0, 1)
        views.append(tube[..., None] * (0.3 + 0.7 * np.random.default_rng(sample).random(3)) * 255)
    return np.stack(views)[None].astype(np.uint8)


def cpu_seconds(function: Callable[[], object]) -> float:
    """Return the least CPU time of some runs."""
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times)


def main() -> None:
    """Measure and print."""
    spec = RodHangSpec.model_validate(
        {
            "kind": "rod_hang",
            "axes": {
                "gamma": {"type": "linspace", "start": 1.0, "stop": 100.0, "num": SAMPLES},
                "phi0": 1.0,
                "phi1": 5.0,
            },
            "samples_per_shard": SAMPLES,
        }
    )
    pictures = [picture(sample) for sample in range(SAMPLES)]
    with tempfile.TemporaryDirectory() as scratch:
        store = DirectoryStore(scratch)
        chunks = [encode_chunk(views) for views in pictures]
        encode = cpu_seconds(lambda: [encode_chunk(views) for views in pictures])
        curves = {
            array.name: np.zeros((SAMPLES, *array.shape), np.float32)
            for array in layout(spec)
            if array.name in ("centerline", "curvature", "frame")
        }
        record = store.publish(encode_records(curves))
        slots = tuple(
            PackSlot(
                slot=slot,
                sample_key=f"{slot:064x}",
                split=0,
                labels={
                    "gamma": 1.0,
                    "phi0": 1.0,
                    "phi1": 5.0,
                    "energy": 0.0,
                    "color": [0.5, 0.5, 0.5],
                },
                record=RecordRef(digest=record, row=slot),
                chunks={
                    "views": ChunkRef(digest=store.publish(chunk), offset=0, length=len(chunk))
                },
            )
            for slot, chunk in enumerate(chunks)
        )
        task = PackTask(spec=spec, shard=0, slots=slots)
        packing = cpu_seconds(lambda: pack(task, store))
    raw, size = sum(views.nbytes for views in pictures), sum(map(len, chunks))
    print(f"{SAMPLES} samples, {raw / 1e6:.1f} MB raw, {size / 1e6:.2f} MB encoded")
    print(
        f"encode {encode * 1e3:.1f} ms, pack (all {len(layout(spec))} arrays) {packing * 1e3:.1f} "
        "ms CPU"
    )
    print(f"pack / encode {packing / encode:.1%}")


if __name__ == "__main__":
    main()
