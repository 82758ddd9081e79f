"""Two simulated axes on one virtual bus and one clock, driven by one `BusCycle`."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from uuid import uuid4

import can

from hdbridge.axis import AxisConfig
from hdbridge.control.axiscycle import AxisCycle
from hdbridge.control.buscycle import BusCycle
from hdbridge.device.node import DriveNode
from hdbridge.drive.drive import Drive
from hdbridge.drive.link import Link
from hdbridge.drive.states import State
from hdbridge.drive.supervision import Fault, Reaction, Supervision
from hdbridge.sim.lockstep import SimulatedAxis, VirtualClock, simulated_benches
from support.spoilt import LoggingBus

PROFILE: Final = Path(__file__).resolve().parents[2] / "profiles" / "article"
STEP_COUNTS: Final = 40
"""Target step per cycle: 9 load degrees per second at 4 ms."""


def axis_of(node_id: int, name: str = "", profile: Path = PROFILE, **drive: object) -> AxisConfig:
    """Returns the article's axis with a different node id."""
    axis = AxisConfig.load(profile)
    changed = axis.drive.model_copy(update={"node_id": node_id, **drive})
    return axis.model_copy(update={"drive": changed, "name": name or f"axis {node_id}"})


@dataclass
class TwoAxes:
    """Two axes in motion, with all their parts, so that a test can disturb them."""

    bus: LoggingBus
    clock: VirtualClock
    nodes: tuple[DriveNode, ...]
    cycle: BusCycle
    axes: tuple[AxisCycle, ...]
    drives: tuple[Drive, ...]
    intruder: can.BusABC
    moving: list[bool] = field(default_factory=lambda: [False, False])
    fresh: list[list[bool]] = field(default_factory=lambda: [[], []])
    """Freshness of each axis's feedback in each cycle."""

    def enable(self, place: int) -> None:
        """Enables an axis whose drive is prepared: runs cycles until its power is on, then moves it."""
        axis = self.axes[place]
        axis.command = None
        axis.begin()
        axis.image.power.go(State.OPERATION_ENABLED)
        for _ in range(50):
            self.turn()
            if axis.image.power.state is State.OPERATION_ENABLED:
                break
        assert axis.image.power.state is State.OPERATION_ENABLED
        axis.command = axis.feedback.motor_counts
        self.moving[place] = True

    def turn(self, turns: int = 1) -> None:
        """Runs cycles, in which each moving axis has a constant speed."""
        for _ in range(turns):
            for axis, moves in zip(self.axes, self.moving, strict=True):
                if moves and isinstance(axis.command, int):
                    axis.command += STEP_COUNTS
            self.cycle.exchange()
            for axis, fresh in zip(self.axes, self.fresh, strict=True):
                fresh.append(axis.feedback.fresh)

    def interfere(self, can_id: int, data: bytes = b"", **kind: bool) -> None:
        """Sends a frame from another node, before the next cycle."""
        kind = {"is_extended_id": False, **kind}
        self.intruder.send(can.Message(arbitration_id=can_id, data=data, **kind))

    def hang(self, duration_s: float) -> None:
        """Stalls the master for ``duration_s``."""
        self.clock.sleep_until(self.clock.now() + duration_s)

    def reactions(self, place: int, fault: Fault) -> list[Reaction]:
        return [event.reaction for event in self.axes[place].supervision.events if event.fault is fault]

    def stands(self, place: int) -> bool:
        """Returns True if the true motor position stays constant over the next 20 cycles."""
        machine = self.nodes[place].firmware.motion.machine
        before = machine.motor_counts
        self.turn(20)
        return abs(machine.motor_counts - before) <= 2

    def follows(self, place: int, turns: int = 60) -> bool:
        """Returns True if the axis keeps following its target, with fresh feedback in each cycle."""
        axis, machine = self.axes[place], self.nodes[place].firmware.motion.machine
        before, seen = machine.motor_counts, len(self.fresh[place])
        self.turn(turns)
        gone = machine.motor_counts - before
        return (
            axis.supervision.stop is None
            and all(self.fresh[place][seen:])
            and abs(gone - turns * STEP_COUNTS) <= 3 * STEP_COUNTS
        )


@contextmanager
def two_axes(boot: tuple[int, ...] = (0, 1), bitrate_bps: int | None = 1_000_000) -> Iterator[TwoAxes]:
    """Provides two axes, those in ``boot`` booted and ready to be enabled; nothing moves yet."""
    configs = [axis_of(node_id) for node_id in (1, 2)]
    channel = f"two-{uuid4()}"
    simulated = [
        SimulatedAxis(PROFILE / "truth.yaml", axis.eds_path, axis.drive.node_id, seed)
        for seed, axis in enumerate(configs)
    ]
    with simulated_benches(simulated, channel) as (first, clock, nodes):
        intruder = can.Bus(interface="virtual", channel=channel, ignore_config=True)
        first.shutdown()
        with intruder, LoggingBus(channel, clock) as bus:
            drives = tuple(Drive(bus, axis, clock) for axis in configs)
            cycle = BusCycle(Link(bus, clock), clock, configs[0].drive.cycle_s, bitrate_bps=bitrate_bps)
            axes = tuple(AxisCycle(drive.image, Supervision(), monitor=drive.monitor) for drive in drives)
            for axis in axes:
                cycle.join(axis)
            cycle.exchange()  # as in the daemon, the loop already runs when the drives are booted
            for place in boot:
                drives[place].boot()
            for place in boot:
                drives[place].enable()
                drives[place].image.power.go(State.SWITCH_ON_DISABLED)
            yield TwoAxes(bus, clock, nodes, cycle, axes, drives, intruder)
