"""Punctuality of the control cycle on SocketCAN; master and simulated drive are two processes.

    tools/socketcan.sh .venv/bin/python tools/bench/socketcan_cycle.py [--cycles 5000]

First an empty loop with the same number of periods is timed; the periods that it misses are due neither to
the bus nor to the drive. Then `hdbridge simulate` is started, the drive is booted and enabled over the bus,
and the axis moves to and fro, compensated by the article's model in every cycle. Prints the periods missed
(begun more than half a period late), the cycles in which a TPDO was missing, and the lateness of the cycles.
Exit status 0 if nothing was missed, 1 otherwise.
"""

from __future__ import annotations

import math
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from harness import CHANNEL, PROFILE, parser

from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.clock import MonotonicClock
from hdbridge.control.compensation import Compensation, CompensationLimits
from hdbridge.control.cycle import LATE, Cycle, Feedback
from hdbridge.control.latency import wake_ups
from hdbridge.control.realtime import prepare_realtime
from hdbridge.drive.drive import Drive
from hdbridge.drive.link import open_bus
from hdbridge.drive.objects import Mode
from hdbridge.drive.states import State
from hdbridge.drive.supervision import Fault, Supervision
from hdbridge.errors import HdbridgeError, SafetyStop

SWING_DEG = 2.0
BOOT_ATTEMPTS = 20


@contextmanager
def simulated_drive() -> Iterator[None]:
    """Runs `hdbridge simulate` in its own process for the duration of the block."""
    command = [sys.executable, "-m", "hdbridge", "simulate", str(PROFILE)]
    process = subprocess.Popen([*command, "--interface", "socketcan", "--channel", CHANNEL])
    try:
        yield
    finally:
        process.terminate()
        process.wait(20.0)


def boot(drive: Drive) -> None:
    """Boots the drive, repeatedly until its process is ready."""
    for attempt in range(BOOT_ATTEMPTS):
        try:
            drive.boot()
        except HdbridgeError:
            if attempt == BOOT_ATTEMPTS - 1:
                raise
            time.sleep(0.5)
        else:
            return


def measure(drive: Drive, model: TransmissionModel, cycles: int) -> dict[str, object]:
    """Runs cycles; returns the missed periods and the lateness of the cycles."""
    axis, image = drive.axis, drive.image
    clock, supervision = drive.link.clock, Supervision()
    cycle = Cycle(drive.link, clock, image, supervision, axis.drive.cycle_s, monitor=drive.monitor)
    drive.enable(Mode.CSP)
    cycle.restart()
    while image.power.state is not State.OPERATION_ENABLED:
        feedback = cycle.tick()
    compensation = Compensation(model, CompensationLimits(), cycle.period_s)
    compensation.reset(image.motor_deg(feedback.motor_counts))
    compensation.engage()
    start_deg = image.motor_deg(feedback.motor_counts) / axis.gear.ratio
    step = 2.0 * math.pi * cycle.period_s / 4.0
    count = 0

    def command(feedback: Feedback) -> int:
        load_deg = start_deg + SWING_DEG * (1.0 - math.cos(step * count)) / 2.0
        give = compensation.command if feedback.fresh else compensation.hold
        return image.target_counts_for(give(load_deg))

    begin_s, missed_before = clock.now(), cycle.skipped
    stopped = None
    try:
        for count in range(cycles):  # noqa: B007 - read by `command`
            cycle.tick(command)
    except SafetyStop as stop:
        stopped = str(stop)
    return {
        "cycles": count + 1,
        "period_ms": 1e3 * cycle.period_s,
        "took_s": round(clock.now() - begin_s, 3),
        "missed_periods": cycle.skipped - missed_before,
        "cycles_without_all_tpdos": supervision.counts[Fault.LOST_TPDO],
        "stopped": stopped,
        "lateness": cycle.histogram.as_dict(),
    }


def main() -> int:
    given = parser(__doc__)
    given.add_argument("--cycles", type=int, default=5000)
    wanted = given.parse_args().cycles
    axis = AxisConfig.load(PROFILE)
    bus = axis.bus.model_copy(update={"interface": "socketcan", "channel": CHANNEL})
    model = TransmissionModel.load(PROFILE / "model.yaml")
    clock = MonotonicClock()
    with prepare_realtime():
        empty = wake_ups(axis.drive.cycle_s, wanted * axis.drive.cycle_s, clock)
    with (
        simulated_drive(),
        prepare_realtime() as realtime,
        open_bus(bus) as opened,
        Drive(opened, axis, clock) as drive,
    ):
        boot(drive)
        result = measure(drive, model, wanted)
    result["conditions"] = str(realtime)
    late = empty.histogram.later_than_us(round(1e6 * LATE * axis.drive.cycle_s))
    result["empty_loop"] = {"begun_late": late, "skipped": empty.skipped, **empty.histogram.as_dict()}
    for name, value in result.items():
        print(f"{name:>26}: {value}")
    good = not result["missed_periods"] and not result["cycles_without_all_tpdos"] and not result["stopped"]
    return 0 if good and result["cycles"] == wanted else 1


if __name__ == "__main__":
    raise SystemExit(main())
