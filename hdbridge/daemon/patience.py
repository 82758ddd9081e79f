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


class Pulse:
    """Whether a counter goes on, judged by how often one has looked.

    Not by the time: who has stood still himself, with his process group for example, blames nobody else.
    """

    def __init__(self) -> None:
        self._last = 0
        self.misses = 0
        """Looks in a row without an advance."""
        self.begun = False
        """Whether it has ever advanced, since it was started anew."""

    def look(self, value: int) -> bool:
        """Whether the counter has advanced since the last look."""
        advanced = value != self._last
        self._last = value
        self.misses = 0 if advanced else self.misses + 1
        self.begun = self.begun or advanced
        return advanced

    def restart(self, value: int) -> None:
        """Whoever counts has been started anew, and the counter stands at this."""
        self._last, self.misses, self.begun = value, 0, False
