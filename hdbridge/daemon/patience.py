"""How often, and how soon, something that died is started again. Pure: the time is passed in."""

from __future__ import annotations

from collections import deque


class Budget:
    """So many within a window of time, and no more."""

    def __init__(self, most: int, window_s: float) -> None:
        self._most, self._window_s = most, window_s
        self._times: deque[float] = deque()

    def spend(self, now_s: float) -> bool:
        """Take one; False where the budget of the window is used up."""
        while self._times and now_s - self._times[0] >= self._window_s:
            self._times.popleft()
        if len(self._times) >= self._most:
            return False
        self._times.append(now_s)
        return True


class BackOff:
    """Delays that double from one failure to the next, up to a longest; a long life begins anew."""

    def __init__(self, first_s: float, longest_s: float, well_after_s: float) -> None:
        self._first_s, self._longest_s, self._well_after_s = first_s, longest_s, well_after_s
        self._next_s = first_s

    def delay_s(self, lived_s: float) -> float:
        """How long to wait after something has died that had lived so long."""
        if lived_s >= self._well_after_s:
            self._next_s = self._first_s
        delay_s, self._next_s = self._next_s, min(2.0 * self._next_s, self._longest_s)
        return delay_s
