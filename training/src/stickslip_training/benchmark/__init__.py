"""Named test sets that are open to all: their identity, the scores of entries, and the table of
results.
"""
