"""Which arrays the dataset of a spec has."""

from stickslip_schemas.arrays import COMMON_ARRAYS, ArrayLayout
from stickslip_schemas.jobs import JobSpec
from stickslip_schemas.kinds import registered


def layout(spec: JobSpec) -> tuple[ArrayLayout, ...]:
    """Return the arrays of the dataset of `spec`; raise UnknownKindError where nobody registered its class."""
    return (*registered(spec).arrays(), *COMMON_ARRAYS)


def bytes_estimate(spec: JobSpec) -> int:
    """Return the size of the arrays of the dataset of `spec` before compression [bytes]."""
    return spec.sample_count * sum(array.sample_bytes for array in layout(spec))
