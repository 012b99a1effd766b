"""Durations and sizes as text."""


def duration(seconds: float) -> str:
    """Return a time span in whole units: 9 s, 4 min, 2 h 10 min; below a second with one digit: 0.3 s."""
    if seconds < 90:
        return f"{seconds:.1g} s" if 0.01 < seconds < 1 else f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def size(count: float) -> str:
    """Return a number of bytes: 512 B, 13.5 kB, 1.2 GB."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" or count >= 100 else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"
