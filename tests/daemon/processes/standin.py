"""Stand-in for a child of the keeper: ``control`` counts cycles, the others report that they are alive.

If HDBRIDGE_TEST_CONTROL or HDBRIDGE_TEST_SERVICE is set in the environment, that process ends at once with
this exit status. SIGUSR1 makes the service ask for the bus.
"""

import os
import signal
import sys
import time

from hdbridge.daemon.memory import Cell, Memory
from hdbridge.daemon.start import Start, begin_child


def say(line: str) -> None:
    """Writes a line in one piece, whatever other processes write at the same time."""
    os.write(1, f"{line}\n".encode())


def main(kind: str, *arguments: str) -> int:
    start = Start.inherited(list(arguments))
    begin_child(start, f"standin-{kind}")
    if status := os.environ.get(f"HDBRIDGE_TEST_{kind.upper()}"):
        return int(status)
    signals = []
    wanted = []
    signal.signal(signal.SIGTERM, lambda *_: signals.append("term"))
    signal.signal(signal.SIGUSR1, lambda *_: wanted.append(1))
    with Memory.attach(start.memory_fd) as memory:
        status = memory.status
        time.sleep(0.05)
        own = {"control": Cell.LOOP_PID, "service": Cell.SERVICE_PID, "gateway": Cell.GATEWAY_PID}
        status[own[kind]] = os.getpid()
        say(f"{kind} {os.getpid()}")
        while not signals and not (kind == "control" and status[Cell.STOP_REQUESTED]):
            if kind == "control":
                status[Cell.LOOP_COUNT] = status[Cell.LOOP_COUNT] + 1
            else:
                if wanted:
                    status[Cell.BUS_REQUESTED] = 1
                    if status[Cell.BUS_LENT]:
                        wanted.clear()
                        status[Cell.BUS_REQUESTED] = 0
                        say("bus is lent")
                alive = Cell.SERVICE_TIME_NS if kind == "service" else Cell.GATEWAY_TIME_NS
                status[alive] = time.monotonic_ns()
            time.sleep(0.02)
        say(f"{kind} ends")
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
