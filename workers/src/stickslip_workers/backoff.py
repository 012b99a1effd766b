"""When to try again."""

import random
import time


class Backoff:
    """Doubles the wait after every failure, with jitter so that many dispatchers do not come back as one."""

    def __init__(self, *, first: float = 0.2, most: float = 5.0) -> None:
        self._first = first
        self._most = most
        self.failures = 0
        self.next_try = 0.0
        """Monotonic time before which not to try [s]."""

    def failed(self) -> None:
        """Wait longer."""
        delay = min(self._most, self._first * 2.0 ** min(self.failures, 16))
        self.failures += 1
        self.next_try = time.monotonic() + delay * random.uniform(0.5, 1.0)

    def succeeded(self) -> None:
        """Forget the failures."""
        self.failures = 0
        self.next_try = 0.0
