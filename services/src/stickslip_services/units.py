"""Durations and sizes as text."""


def duration(seconds: float) -> str:
    """Return a time span: 4 ms, 0.4 s, 9.0 s, 40 s, 4 min, 2 h 10 min.

    The least is 0.1 ms, and only nothing is 0 s.
    """
    if seconds <= 0:
        return "0 s"
    milliseconds = max(1000 * seconds, 0.1)
    if milliseconds < 100:
        return f"{milliseconds:.2g} ms" if milliseconds < 10 else f"{milliseconds:.0f} ms"
    if seconds < 90:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def percent(part: float, whole: float) -> str:
    """Return a share: 0 %, 0.1 %, 99.9 %, 100 %. Only all of it is 100 %, and only nothing 0 %."""
    if part <= 0 or whole <= 0:
        return "0 %"
    if part >= whole:
        return "100 %"
    return f"{min(max(100 * part / whole, 0.1), 99.9):.1f} %"


def size(count: float) -> str:
    """Return a number of bytes: 512 B, 13.5 kB, 1.2 GB."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" or count >= 100 else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"
