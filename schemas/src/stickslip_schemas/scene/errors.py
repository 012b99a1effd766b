"""The error of a file that a scene cannot use."""


class UnfitFileError(ValueError):
    """A file cannot be what a scene needs; the message has the rule, and what was found."""
