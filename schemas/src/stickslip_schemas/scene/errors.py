"""The errors of files that a scene cannot use, and of scenes that can never work."""


class UnfitFileError(ValueError):
    """A file that a scene cannot use; the message has the rule and the value."""


class UnfitStartError(ValueError):
    """A scene can never work; the message names each place and rule."""
