"""Limits and delays for restarting processes, and hang detection. Pure: the time is passed in."""

from __future__ import annotations

from collections import deque


class Budget:
    """Maximum number of events within a sliding time window."""

    def __init__(self, most: int, window_s: float) -> None:
        self._most, self._window_s = most, window_s
        self._times: deque[float] = deque()

    def spend(self, now_s: float) -> bool:
        """Counts an event; returns False if the window's budget is used up."""
        while self._times and now_s - self._times[0] >= self._window_s:
            self._times.popleft()
        if len(self._times) >= self._most:
            return False
        self._times.append(now_s)
        return True


class BackOff:
    """Delays that double with each failure up to a maximum; a long life resets them."""

    def __init__(self, first_s: float, longest_s: float, well_after_s: float) -> None:
        self._first_s, self._longest_s, self._well_after_s = first_s, longest_s, well_after_s
        self._next_s = first_s

    def delay_s(self, lived_s: float) -> float:
        """Returns the delay before the restart of a process that ran for ``lived_s``."""
        if lived_s >= self._well_after_s:
            self._next_s = self._first_s
        delay_s, self._next_s = self._next_s, min(2.0 * self._next_s, self._longest_s)
        return delay_s


class Pulse:
    """Hang detection by a counter, measured in looks without an advance.

    It does not use time, so a monitor that was itself suspended blames nobody else.
    """

    def __init__(self) -> None:
        self._last = 0
        self.misses = 0
        """Consecutive looks without an advance."""
        self.begun = False
        """True if the counter has advanced since the restart."""

    def look(self, value: int) -> bool:
        """Returns True if the counter has advanced since the last look."""
        advanced = value != self._last
        self._last = value
        self.misses = 0 if advanced else self.misses + 1
        self.begun = self.begun or advanced
        return advanced

    def restart(self, value: int) -> None:
        """Starts again with a restarted process, whose counter has this value."""
        self._last, self.misses, self.begun = value, 0, False
