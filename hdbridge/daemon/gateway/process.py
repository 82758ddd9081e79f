"""Gateway process: ``python -m hdbridge.daemon.gateway.process FD``, started by the keeper.

It uses the outer bus and the shared memory. The control process does not wait for it. If the gateway process
dies, the set-points of its axes end, so the axes brake and lose their power.
"""

from __future__ import annotations

import logging
import os
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final

from hdbridge.clock import Clock, MonotonicClock
from hdbridge.control.realtime import prepare_realtime
from hdbridge.daemon.gateway.slave import Gateway
from hdbridge.daemon.logs import begin_log
from hdbridge.daemon.memory import Cell, Memory
from hdbridge.daemon.start import Start, run_child, when_terminated
from hdbridge.device.run import run
from hdbridge.drive.link import open_bus
from hdbridge.errors import HdbridgeError
from hdbridge.files.atomic import make_folder

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig

_LOG: Final = logging.getLogger(__name__)
ALIVE_S: Final = 0.1


class ControlLoopClock:
    """Virtual clock of simulated drives: time of the control loop's last cycle, plus the time since then.

    It waits for a control loop that lags, but not for one whose process has ended.
    """

    def __init__(self, memory: Memory, speed: float) -> None:
        self._status, self._reader = memory.status, memory.reader()
        self._period_s, self._speed = memory.period_s, speed
        self._turn_s, self._turned_s = time.monotonic(), time.monotonic()
        self._latest_s = 0.0

    def now(self) -> float:
        """Returns the time on the control loop's clock in seconds, which does not decrease."""
        samples, _ = self._reader.read()
        if len(samples):
            self._turn_s = 1e-9 * int(samples[-1]["time_ns"])
            self._turned_s = time.monotonic()
        since_s = (time.monotonic() - self._turned_s) * self._speed
        if self._status[Cell.LOOP_PID]:
            since_s = min(since_s, self._period_s)
        self._latest_s = max(self._latest_s, self._turn_s + since_s)
        return self._latest_s

    def sleep_until(self, deadline_s: float) -> None:
        """Sleeps until ``deadline_s`` on this clock."""
        while (left_s := deadline_s - self.now()) > 0.0:
            time.sleep(min(left_s / self._speed, self._period_s))


def serve(start: Start) -> None:
    """Serves the gateway's drives on the outer bus until SIGTERM. Raises `BusError` if the bus fails."""
    begin_log(start.log)
    machine, terminated = start.machine, when_terminated()
    settings = machine.gateway
    assert settings is not None
    with (
        Memory.attach(start.memory_fd) as memory,
        open_bus(settings.bus, shared=True) as bus,
        TemporaryDirectory(prefix="hdbridge-gateway-") as folder,
    ):

        def store_of(axis: AxisConfig) -> Path | None:
            try:
                return (
                    make_folder(machine.axis_folder(machine.axis(axis.name), "gateway")) / "parameters.json"
                )
            except (HdbridgeError, OSError):
                return None  # parameters stored by 1010h are lost when the process ends

        simulation = start.simulation
        clock: Clock = MonotonicClock() if simulation is None else ControlLoopClock(memory, simulation.speed)
        gateway = Gateway(
            bus,
            [(axis.config, axis.model()) for axis in machine.axes],
            settings,
            memory,
            clock,
            Path(folder),
            store_of,
        )
        status = memory.status
        status[Cell.GATEWAY_PID] = os.getpid()
        reported_s = 0.0

        def should_stop() -> bool:
            nonlocal reported_s
            now_s = time.monotonic()
            if now_s - reported_s > ALIVE_S:
                reported_s = now_s
                status[Cell.GATEWAY_TIME_NS] = time.monotonic_ns()
            return terminated()

        # One below the priority of the control loop, which must not wait for this process on a shared CPU.
        priority, cpus = max(machine.realtime.priority - 1, 0), machine.realtime.cpus
        with prepare_realtime(priority, cpus) if simulation is None else nullcontext() as conditions:
            _LOG.info("gateway process", {"conditions": str(conditions or "simulated")})
            run(bus, gateway, clock, should_stop, longest_wait_s=machine.cycle_s)


if __name__ == "__main__":
    sys.exit(run_child(sys.argv[1:], "hdbridge-outer", serve))
