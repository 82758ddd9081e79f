"""``hdbridge run`` for `daemon.py`: all as it is, but the simulated drives live in real time.

    python tools/bench/daemon_realtime.py MACHINE --simulate

`hdbridge run --simulate` lets virtual time wait for a machine that is late, so nothing is ever late there.
Here the drives run by the machine's clock, and the control process has SCHED_FIFO and locked memory, as on a
real bus: its lateness shows, and a stall is a fault.
"""

from __future__ import annotations

import sys
import time
from functools import partial

from hdbridge.control.realtime import prepare_realtime
from hdbridge.sim.lockstep import VirtualClock

CONTROL = "--control"


class RealClock(VirtualClock):
    """Machine's clock, which advances the drives at each wait and each frame sent."""

    def __init__(self, start_s: float = 0.0, speed: float = 1.0) -> None:
        super().__init__(time.monotonic())
        self.woke_s = self.late_s = 0.0
        """End of the last wait, and its lateness; s."""

    def now(self) -> float:
        return time.monotonic()

    def sleep_until(self, deadline_s: float) -> None:
        delay_s = deadline_s - time.monotonic()
        if delay_s > 0.0:
            time.sleep(delay_s)
        self.woke_s = time.monotonic()
        self.late_s = self.woke_s - deadline_s
        super().sleep_until(max(deadline_s, self.woke_s))


def control(arguments: list[str]) -> int:
    """Runs the control process."""
    import hdbridge.sim.paced  # noqa: PLC0415 - the keeper needs no simulation
    from hdbridge.daemon.loop.process import main  # noqa: PLC0415

    hdbridge.sim.paced.PacedClock = RealClock  # type: ignore[assignment, misc]
    with prepare_realtime():
        return main(arguments)


def keeper() -> None:
    """Runs ``hdbridge run`` with that control process."""
    from hdbridge.cli import main  # noqa: PLC0415
    from hdbridge.daemon import hold  # noqa: PLC0415
    from hdbridge.daemon.keeper import Keeper, Programs  # noqa: PLC0415

    programs = Programs(control=(__file__, CONTROL))
    hold.Keeper = partial(Keeper, programs=programs)  # type: ignore[assignment, misc]
    sys.argv.insert(1, "run")
    main()


if __name__ == "__main__":
    if sys.argv[1] == CONTROL:
        sys.exit(control(sys.argv[2:]))
    keeper()
