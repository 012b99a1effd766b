"""Limits on the answers of servers: a server may be broken, or hostile."""

DOCUMENT_BYTES = 16 * 2**20
"""Largest JSON document that is read [bytes].

A manifest of 10,000 samples that were all rejected has about 6 MB.
"""

DOCUMENT_SECONDS = 300.0
"""Longest time for one document [s]: a server that sends a byte a minute never ends, either."""

EVENT_BYTES = 2**20
"""Largest event of a stream [bytes]. The progress of a job has about 1 kB."""
