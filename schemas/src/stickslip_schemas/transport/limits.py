"""Limits on the answers of servers: a server may be broken, or hostile."""

DOCUMENT_BYTES = 16 * 2**20
"""Largest JSON document that is read [bytes].

A manifest of 10,000 samples that were all rejected has about 6 MB.
"""

DOCUMENT_SECONDS = 300.0
"""Longest time for one document [s]: a server that sends a byte a minute never ends, either."""

EVENT_BYTES = 2**20
"""Largest event of a stream [bytes]. The progress of a job has about 1 kB."""

DOCUMENT_CONTAINERS = 250_000
"""Most lists and objects of a document.

A manifest of 10,000 samples has at most about 80,000: its files and its rejections.
"""

DOCUMENT_VALUES = 1_000_000
"""Most values of a document; each takes up to 100 bytes of memory when it is parsed."""


def check_values(document: bytes) -> None:
    """Check that a JSON document does not hold too many values, before it is parsed.

    Characters in strings count too: they are few, and finding them costs a parser.

    Raises:
        ValueError: It holds more lists and objects, or more values, than any document of ours.
    """
    containers = document.count(b"[") + document.count(b"{")
    if containers > DOCUMENT_CONTAINERS:
        raise ValueError(
            f"must have at most {DOCUMENT_CONTAINERS} lists and objects, and has {containers}"
        )
    values = document.count(b",") + 1
    if values > DOCUMENT_VALUES:
        raise ValueError(f"must have at most {DOCUMENT_VALUES} values, and has {values}")
