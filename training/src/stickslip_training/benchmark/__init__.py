"""Named test sets that anybody can enter: what they are, how entries are scored, and the table of results."""
