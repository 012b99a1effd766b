"""What can be wrong with a dataset.

DatasetError
├── InvalidDatasetError    the manifest or the metadata contradict the contract, or each other
├── MissingFileError       a file of the manifest is not there
├── CorruptDataError       bytes are not what a size, a checksum or a digest says they are
├── RejectedSampleError    the sample was rejected when the dataset was made: there is nothing to read
└── SourceError            the server does not answer, or not with the requested data
"""

from stickslip_schemas.format.codecs import CorruptChunkError


class DatasetError(Exception):
    """The base of everything that reading a dataset raises on purpose."""


class InvalidDatasetError(DatasetError, ValueError):
    """The manifest or the metadata contradict the contract, or each other."""


class MissingFileError(DatasetError, FileNotFoundError):
    """A file that belongs to the dataset is not there."""


class CorruptDataError(DatasetError, CorruptChunkError):
    """Bytes are not what a size, a checksum or a digest says they are."""


class RejectedSampleError(DatasetError, LookupError):
    """The sample was rejected when the dataset was made."""


class SourceError(DatasetError, OSError):
    """The server does not answer, or not with the requested data."""
