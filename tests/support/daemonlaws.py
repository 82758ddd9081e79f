"""Invariants of the daemon's control loop, checked for each frame by a spy on the bus."""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING

from hdbridge.daemon.loop.states import MAY_MOVE, AxisState
from hdbridge.daemon.memory import CommandKind, Event, EventKind
from hdbridge.drive.image import position_limits_counts
from hdbridge.motion import MotionMode
from hdbridge.units import ARCSEC_PER_DEG

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig
    from support.daemon import SteppedDaemon

POWERLESS = frozenset({0x00, 0x02, 0x80})
"""Controlwords that remove power or leave it off: disable voltage, quick stop, fault reset."""
ENABLE_OPERATION = 0x0F
PRE_OPERATIONAL = (0x000, 0x80)
"""NMT command that the loop itself sends to each node when the bus has been opened again."""
SILENT = frozenset({AxisState.UNVERIFIED, AxisState.LENT, AxisState.LATCHED})
MOTION = frozenset({CommandKind.MOVE, CommandKind.JOG, CommandKind.STREAM_BEGIN, CommandKind.FOLLOW})
"""Commands that lead to motion."""
DRIVEN = frozenset({AxisState.ENABLED, AxisState.STOPPING})
LATCHES = frozenset({AxisState.QUICK_STOPPED, AxisState.LATCHED})
STANDING_DEG = 0.01
"""Maximum motion of an axis at rest since its last TPDO, degrees at the load."""
INTERPOLATED = 0x10
"""Bit of the controlword that enables interpolation in interpolated position mode."""


class AxisLaws:
    """Invariants that the RPDOs of one axis must satisfy."""

    def __init__(self, daemon: SteppedDaemon, index: int) -> None:
        self.axis = daemon.axes[index]
        self.machine = daemon.nodes[index].firmware.motion.machine
        config = self.axis.config
        self.least, self.greatest = position_limits_counts(config)
        self.most = most_counts(config)
        self.deg_per_count = config.motor_encoder.degrees(1) / config.gear.ratio
        self.allowed = False
        """True if an ENABLE command was given since power was last removed."""
        self.begun = False
        """True if power has been requested since that ENABLE command."""
        self.latched = False
        """True if the loop has reported a stop, and no reset since."""
        self.word = 0
        self.target = 0
        self.enabled = 0
        self.place_deg: float | None = None
        """Set-point at the last RPDO (target without correction), degrees at the load; None if not driven."""
        self.velocity = self.acceleration = 0.0
        self.asked = False
        """True from a command for motion until the set-point rests again without another one."""
        self.rest_deg = 0.0
        """Set-point that may not change without a command, degrees at the load."""
        self.waiting = 0
        """Number of commands for motion that are not answered yet."""
        self.streamed = False
        """True from the begin of a stream until rest; near a position limit, its stop has no jerk limit."""

    def take(self, data: bytes) -> None:
        word, target = struct.unpack("<Hi", data)
        word &= ~INTERPOLATED
        name = self.axis.config.name
        assert self.axis.state not in SILENT, f"{name}: an RPDO while it is {self.axis.state.name}"
        if word in POWERLESS:
            if self.begun:
                self.allowed = self.begun = False
        else:
            assert self.allowed, f"{name}: controlword {word:04X}h without an ENABLE command"
            assert not self.latched, f"{name}: controlword {word:04X}h without a reset"
            self.begun = True
        if word == ENABLE_OPERATION:
            assert self.axis.state in MAY_MOVE, f"{name}: driven while it is {self.axis.state.name}"
            assert self.least <= target <= self.greatest, f"{name}: target {target} is outside the limits"
            if self.word == ENABLE_OPERATION:
                step = abs(target - self.target)
                assert step <= self.most, f"{name}: target jumps by {step} counts, at most {self.most} may be"
            else:
                away_deg = abs(target - self.machine.motor_counts) * self.deg_per_count
                assert away_deg <= STANDING_DEG, f"{name}: enabled {away_deg} deg from where it stands"
            self.enabled += 1
        self._follow(target, driven=word == ENABLE_OPERATION and self.axis.state in DRIVEN)
        self.word, self.target = word, target

    def _follow(self, target: int, *, driven: bool) -> None:
        """Checks that the set-point moves only on command, and within the limits of the axis."""
        limits, period_s = self.axis.config.limits, self.axis.config.drive.cycle_s
        rounding = self.deg_per_count / period_s
        correction_deg = self.axis.follower.correction.correction_arcsec / ARCSEC_PER_DEG
        mode, place_deg = self.axis.set_point.mode, target * self.deg_per_count + correction_deg
        before_deg, self.place_deg = self.place_deg, place_deg if driven else None
        if self.asked or before_deg is None:
            self.rest_deg = place_deg
        elif driven:
            moved_deg = abs(place_deg - self.rest_deg)
            assert moved_deg <= 2 * self.deg_per_count, f"the target moved {moved_deg} deg without a command"
        self.asked = self.asked and (self.waiting > 0 or mode is not MotionMode.HOLD)
        if before_deg is None or not driven:
            self.velocity = self.acceleration = 0.0
            return
        velocity = (place_deg - before_deg) / period_s
        acceleration = (velocity - self.velocity) / period_s
        assert abs(velocity) <= limits.velocity_deg_s + 2 * rounding
        assert abs(acceleration) <= limits.acceleration_deg_s2 * 1.001 + 4 * rounding / period_s, mode
        self.streamed = mode is MotionMode.STREAM or (self.streamed and mode is MotionMode.STOP)
        if not self.streamed:
            jerk = (acceleration - self.acceleration) / period_s
            assert abs(jerk) <= limits.jerk_deg_s3 * 1.001 + 8 * rounding / period_s**2, mode
        self.velocity, self.acceleration = velocity, acceleration


def most_counts(config: AxisConfig) -> int:
    """Returns the maximum change of a target in one cycle, in counts, from the axis file alone."""
    slew_deg_s = config.compensation.slew_arcsec_s / ARCSEC_PER_DEG
    motor_deg = (config.limits.velocity_deg_s + slew_deg_s) * config.drive.cycle_s * config.gear.ratio
    return math.ceil(abs(config.motor_encoder.counts(motor_deg))) + 2


class Laws:
    """Invariants of all frames, events and samples of one bus."""

    def __init__(self, daemon: SteppedDaemon) -> None:
        self.daemon = daemon
        self.axes = {axis.config.drive.node_id: AxisLaws(daemon, axis.index) for axis in daemon.axes}
        self.relayed = 0
        self.frames = 0
        self.asked: dict[int, CommandKind | int] = {}
        """Commands not answered yet, by id."""
        self._last_sequence = 0
        daemon.bus.spy = self.spy

    def post(self, kind: CommandKind | int, axis: int, id_: int) -> None:
        """Records a command that was put into the mailbox."""
        self.asked[id_] = kind
        if kind in MOTION:
            for laws in self.axes.values():  # a stream is of several axes
                laws.asked, laws.waiting = True, laws.waiting + 1
        if kind == CommandKind.ENABLE and 0 <= axis < len(self.daemon.axes):
            self.axes[self.daemon.axes[axis].config.drive.node_id].allowed = True

    def spy(self, can_id: int, data: bytes) -> None:
        """Checks a frame of the master."""
        self.frames += 1
        node, function = can_id & 0x7F, can_id & 0x780
        if function == 0x200:
            self.axes[node].take(data)
        elif can_id == 0x000 or function == 0x600:
            self.relayed += (can_id, *data[:1]) != PRE_OPERATIONAL
            nodes = {data[1]} if can_id == 0x000 else {node}
            assert nodes <= set(self.axes)
        else:
            assert can_id in (0x080, 0x77F), f"{can_id:03X}h was sent"

    def begin_again(self) -> None:
        """Restarts the control process, which discards the commands not taken yet."""
        self.daemon.begin_again()
        self.asked.clear()
        for axis in self.daemon.axes:
            laws = self.axes[axis.config.drive.node_id]
            laws.axis, laws.latched, laws.allowed = axis, False, False
            laws.asked, laws.waiting = False, 0

    def turn(self) -> None:
        """Runs one cycle and checks that it relays at most one frame."""
        self.relayed = 0
        self.daemon.turn()
        assert self.relayed <= 1

    def take(self, events: list[Event]) -> None:
        """Checks that each command is answered only once, and that refusals and stops have a text."""
        for event in events:
            if event.kind in (EventKind.DONE, EventKind.REFUSED) and event.id:
                assert event.id in self.asked, f"answered twice, or not asked: {event}"
                kind = self.asked.pop(event.id)
                if kind in MOTION:
                    for laws in self.axes.values():
                        laws.waiting -= 1
                if kind == CommandKind.RESET and event.kind is EventKind.DONE:
                    self._laws_of(event.axis).latched = False
            elif event.kind is EventKind.STATE and event.code in LATCHES:
                self._laws_of(event.axis).latched = True
            if event.kind in (EventKind.REFUSED, EventKind.STOPPED, EventKind.STREAM_REFUSED):
                assert event.text, event

    def _laws_of(self, axis: int) -> AxisLaws:
        return self.axes[self.daemon.axes[axis].config.drive.node_id]

    def samples(self) -> None:
        """Checks that the samples are consecutive, finite and, while enabled, within the position limits."""
        samples, lost = self.daemon.samples.read()
        assert lost == 0
        for sample in samples:
            assert sample["sequence"] > self._last_sequence
            self._last_sequence = int(sample["sequence"])
            for axis, laws in zip(sample["axes"], self.axes.values(), strict=True):
                AxisState(axis["state"])
                names = axis.dtype.names
                known = names[names.index("load_target_deg") : names.index("reading0")]
                values = [axis[name] for name in known]
                assert all(map(math.isfinite, values)), axis
                if axis["state"] == AxisState.ENABLED:
                    limits = laws.axis.config.limits
                    assert limits.position_min_deg - 0.1 <= axis["load_target_deg"]
                    assert axis["load_target_deg"] <= limits.position_max_deg + 0.1
