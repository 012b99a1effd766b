"""The Zarr metadata of a dataset, made by zarr-python itself."""

import warnings

import numpy as np
from stickslip_schemas.format.codecs import ZSTD_LEVEL, axes_order, packing
from stickslip_schemas.format.manifest import layout, samples_per_file
from stickslip_schemas.spec.arrays import FORMAT, ArrayLayout, describe
from stickslip_schemas.spec.jobs import JobSpec


def metadata_files(spec: JobSpec, *, dataset: str, version: int, sample_count: int) -> dict[str, bytes]:
    """Return the metadata files of a dataset by path: the group, consolidated, and every array."""
    import zarr
    from zarr.storage import MemoryStore

    files: dict[str, object] = {}
    group = zarr.create_group(
        MemoryStore(files),  # type: ignore[arg-type]  # the values are zarr's own buffers
        zarr_format=3,
        attributes={
            "format": FORMAT,
            "dataset": dataset,
            "version": version,
            "kind": spec.kind,
            "spec_digest": spec.content_digest,
        },
    )
    for array in layout(spec):
        create_array(group, array, sample_count=sample_count, samples_per_file=samples_per_file(array, spec))
    with warnings.catch_warnings():
        # Not in the Zarr v3 text yet, but the only way to open a group over plain HTTP [zarr-specs #383].
        warnings.filterwarnings("ignore", message="Consolidated metadata", category=UserWarning)
        zarr.consolidate_metadata(group.store)
    return {path: buffer.to_bytes() for path, buffer in files.items()}  # type: ignore[attr-defined]


def create_array(group: object, array: ArrayLayout, *, sample_count: int, samples_per_file: int) -> object:
    """Create `array` in a zarr group, empty, with the codecs that the packer writes."""
    from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec, TransposeCodec, ZstdCodec

    group_shape = (samples_per_file, *array.shape)
    order = axes_order(array)
    compressor: object = ZstdCodec(level=ZSTD_LEVEL, checksum=False)
    if (packed := packing(array)) is not None:
        compressor = BloscCodec(typesize=np.dtype(array.dtype).itemsize, blocksize=0, **packed._asdict())
    return group.create_array(  # type: ignore[attr-defined]  # zarr.Group; zarr is imported late
        array.name,
        shape=(sample_count, *array.shape),
        dtype=array.dtype,
        chunks=(1, *array.shape) if array.per_sample else group_shape,
        shards=group_shape if array.per_sample else None,  # the index: crc32c, at the end, as zarr has it
        filters=() if order is None else (TransposeCodec(order=order),),
        serializer=BytesCodec(endian="little"),
        compressors=(compressor, Crc32cCodec()),
        fill_value=array.fill,
        dimension_names=("sample", *array.dimensions),
        attributes=describe(array),
    )
