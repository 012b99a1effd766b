"""The errors of files that a scene cannot use, and of scenes that can never work."""


class UnfitFileError(ValueError):
    """A file cannot be what a scene needs; the message has the rule, and what was found."""


class UnfitStartError(ValueError):
    """A scene can never work; the message names each place and rule."""
