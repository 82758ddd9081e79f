"""The control process: ``python -m hdbridge.daemon.loop.process FD``, started by the keeper.

It has one thread, one bus and the shared memory. All memory is allocated before the first cycle. While the
loop runs, the process opens no files, writes no log and makes no SDO transfers of its own.
"""

import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from typing import Final

from hdbridge.axis import BusConfig
from hdbridge.clock import Clock, MonotonicClock
from hdbridge.control.buscycle import BusCycle
from hdbridge.control.realtime import prepare_realtime
from hdbridge.daemon.logs import log_once
from hdbridge.daemon.loop.controller import Controller
from hdbridge.daemon.machine import Machine
from hdbridge.daemon.memory import Cell, Memory
from hdbridge.daemon.start import Simulation, Start, run_child, when_terminated
from hdbridge.drive.link import Link, open_bus
from hdbridge.drive.masterdetection import refuse_other_masters
from hdbridge.errors import BusError, HdbridgeError

_POLLS: Final = 256
"""Number of frames read to test whether an opened interface works."""
AT_ONCE: Final = 2
"""Value of ``STOP_REQUESTED`` that requests an end by quick stop."""
SIMULATED_BITRATE_BPS: Final = 1_000_000


class Interface(ExitStack):
    """Opens the bus of a machine file. The keeper, which outlives this process, holds the lock."""

    def __init__(self, settings: BusConfig, clock: Clock) -> None:
        super().__init__()
        self._settings, self._clock = settings, clock

    def open(self) -> Link:
        """Opens the bus and returns a link; raises BusError on failure."""
        self.close()
        bus = self.enter_context(open_bus(self._settings, shared=True))
        return Link(bus, self._clock)

    def reopen(self) -> Link | None:
        """Reopens the bus after a failure; returns a link, or None if the interface does not work yet.

        An interface that is down can be opened; only the first read fails.
        """
        try:
            link = self.open()
            for _ in range(_POLLS):
                if link.recv(self._clock.now()) is None:
                    break
        except BusError:
            self.close()
            return None
        return link

    def close(self) -> None:
        with suppress(HdbridgeError):
            super().close()


def run(start: Start) -> None:
    """Runs the loop of a machine until SIGTERM or ``STOP_REQUESTED`` has brought it to rest.

    Raises `BusError` if the bus cannot be opened, `BusInUseError` if another master is active on it.
    """
    machine = start.machine
    terminated = when_terminated()
    realtime = machine.realtime
    bitrate = machine.bus.bitrate_bps if start.simulation is None else SIMULATED_BITRATE_BPS
    with Memory.attach(start.memory_fd) as memory, _bus(start) as (link, clock, interface):
        cycle = BusCycle(link, clock, machine.cycle_s, bitrate_bps=bitrate)
        reopen = interface.reopen if interface is not None else lambda: None
        axes = [(axis.config, axis.load_loop) for axis in machine.axes]
        controller = Controller(cycle, axes, memory, reopen)
        status = memory.status
        # A simulation has no real-time priority, because one that lags never sleeps and would starve its CPU.
        real = interface is not None
        with prepare_realtime(realtime.priority, realtime.cpus) if real else nullcontext() as conditions:
            log_once(
                start.log,
                "hdbridge.daemon.loop",
                "control process",
                {"conditions": str(conditions or "simulated")},
            )
            while not controller.ended:
                if terminated() or status[Cell.STOP_REQUESTED]:
                    controller.end(at_once=status[Cell.STOP_REQUESTED] >= AT_ONCE)
                controller.turn()


@contextmanager
def _bus(start: Start) -> Iterator[tuple[Link, Clock, Interface | None]]:
    """Yields the bus, its clock and the interface that reopens it (None for simulated drives)."""
    machine = start.machine
    if start.simulation is not None:
        with _simulated(machine, start.simulation) as (link, clock):
            yield link, clock, None
        return
    clock = MonotonicClock()
    with Interface(machine.bus, clock) as interface:
        link = interface.open()
        if not (start.force or link.private):
            refuse_other_masters(link, [axis.config for axis in machine.axes])
        yield link, clock, interface


@contextmanager
def _simulated(machine: Machine, simulation: Simulation) -> Iterator[tuple[Link, Clock]]:
    # Imported here: with real drives the simulation is not needed.
    from hdbridge.sim.lockstep import SimulatedAxis, simulated_benches  # noqa: PLC0415
    from hdbridge.sim.paced import PacedClock  # noqa: PLC0415

    axes = [
        SimulatedAxis(
            truth,
            axis.config.eds_path,
            axis.config.drive.node_id,
            simulation.seed + place,
            axis.config.load_encoder.source.address,
        )
        for place, (axis, truth) in enumerate(zip(machine.axes, simulation.truths, strict=True))
    ]
    clock = PacedClock(time.monotonic(), simulation.speed)
    with simulated_benches(axes, clock=clock) as (bus, _, _):
        yield Link(bus, clock), clock


if __name__ == "__main__":
    sys.exit(run_child(sys.argv[1:], "hdbridge-loop", run))
