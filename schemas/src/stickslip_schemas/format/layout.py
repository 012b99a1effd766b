"""Which arrays the dataset of a spec has."""

from stickslip_schemas.kinds import registered
from stickslip_schemas.spec import arrays
from stickslip_schemas.spec.arrays import COMMON_ARRAYS, ArrayLayout
from stickslip_schemas.spec.jobs import JobSpec


def layout(spec: JobSpec) -> tuple[ArrayLayout, ...]:
    """Return the arrays of the dataset of `spec`; raise UnknownKindError where nobody registered its class."""
    return (*registered(spec).arrays(), *COMMON_ARRAYS)


def samples_per_file(array: ArrayLayout, spec: JobSpec) -> int:
    """Return the number of consecutive samples in every file of an array except the last."""
    if array.is_label:
        most = max(arrays.LEAST_LABEL_SAMPLES, arrays.LABEL_CHUNK_BYTES // array.sample_bytes)
        return min(most, arrays.LABEL_SAMPLES, spec.sample_count)
    return spec.samples_per_shard


def bytes_estimate(spec: JobSpec) -> int:
    """Return the size of the arrays of the dataset of `spec` before compression [bytes]."""
    return spec.sample_count * sum(array.sample_bytes for array in layout(spec))
