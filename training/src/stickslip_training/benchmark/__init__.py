"""Named test sets that are open to all: identity, scores of entries, table of results."""
