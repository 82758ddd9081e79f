"""Bench of the daemon for the rows of `reliability`: two axes in motion on virtual time."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hdbridge.axis.effects import Moment
from hdbridge.control.compensation import Compensation, CompensationLimits
from hdbridge.control.switchover import Correction
from hdbridge.daemon.loop.axisloop import AxisLoop
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind, EventKind
from hdbridge.daemon.service.axis import ServiceAxis
from hdbridge.drive.supervision import Reaction
from hdbridge.errors import RefusedError
from hdbridge.units import DEG_PER_TURN
from support.characters import FRIENDLY, Character
from support.service import Service, play, stepped_service, until

FAR_DEG = 390.0
"""Absolute value of the target of the axes, degrees."""
RPDO = 0x200
ENABLE_OPERATION = 0x0F
SETTLED_S = 0.7
"""Time after which any stop is over, including one that the drive makes on its own."""
_NOWHERE = Moment()
STATES = {
    Reaction.GO: AxisState.ENABLED,
    Reaction.FREEZE: AxisState.ENABLED,
    Reaction.QUICK_STOP: AxisState.QUICK_STOPPED,
    Reaction.LATCH: AxisState.LATCHED,
}


class WrongOnce(Compensation):
    """Compensation that can return one chosen target instead of its own."""

    wrong_deg: float | None = None

    def command(self, load_deg: float, moment: Moment = _NOWHERE) -> float:
        right = super().command(load_deg, moment)
        wrong, self.wrong_deg = self.wrong_deg, None
        return right if wrong is None else wrong


class DaemonBench:
    """Two axes in motion; faults affect the first."""

    def __init__(self, service: Service) -> None:
        self.service = service
        daemon = self.daemon = service.daemon
        self.node = daemon.nodes[0]
        self.supervision = daemon.axes[0].supervision
        self.period_s = daemon.period_s
        self._counts_per_turn = daemon.axes[0].config.motor_encoder.counts_per_turn

    def set_off(self) -> None:
        """Moves both axes at constant speed, and enables them if necessary."""
        daemon = self.daemon
        for axis, state in enumerate(daemon.states):
            if state is not AxisState.ENABLED:
                daemon.verify(axis)
                daemon.enable(axis)
        for axis in range(2):
            daemon.move(-FAR_DEG if daemon.axes[axis].set_point.position_deg > 0.0 else FAR_DEG, axis)
        daemon.run(0.3)
        daemon.events.clear()

    # ---------------------------------------------------------------- interface of `reliability.Bench`

    def move(self) -> None:
        self.daemon.turn()

    def interfere(self, can_id: int, data: bytes = b"", **kind: bool) -> None:
        self.daemon.interfere(can_id, data, **kind)

    def hang(self, duration_s: float) -> None:
        self.daemon.hang(duration_s)

    def interface_down(self) -> None:
        self.daemon.bus.down = errno.ENETDOWN

    def interface_deleted(self) -> None:
        self.daemon.bus.down = errno.ENODEV

    def transmit_queue_full(self) -> None:
        self.daemon.bus.no_room_for = RPDO + 1

    def bad_target(self, counts: float) -> None:
        wrong = self.daemon.axes[0].follower.correction.command
        assert isinstance(wrong.__self__, WrongOnce)  # type: ignore[attr-defined]
        wrong.__self__.wrong_deg = counts * DEG_PER_TURN / self._counts_per_turn  # type: ignore[attr-defined]

    # ---------------------------------------------------------------- checks after a fault

    @property
    def states(self) -> list[AxisState]:
        return self.daemon.states

    def moves_on(self, axis: int) -> bool:
        """Returns True if an axis is still enabled and in motion."""
        before = self.daemon.motor_counts(axis)
        self.daemon.run(0.1)
        return self.states[axis] is AxisState.ENABLED and abs(self.daemon.motor_counts(axis) - before) > 500

    def stay_stopped(self, *axes: int) -> None:
        """Checks that axes come to rest, then stay at rest without power, whatever the commands."""
        daemon, states = self.daemon, [*self.states]
        sent = daemon.sent()
        daemon.run(SETTLED_S)
        places = [self.daemon.motor_counts(axis) for axis in range(2)]
        for axis in axes:
            for kind in (CommandKind.MOVE, CommandKind.JOG, CommandKind.ENABLE, CommandKind.VERIFIED):
                assert daemon.order(kind, axis).kind is EventKind.REFUSED
        daemon.run(0.3)
        daemon.bus.spy = None
        for axis in axes:
            words = [data[0] for _, can_id, data in sent if can_id == RPDO + 1 + axis]
            assert abs(daemon.motor_counts(axis) - places[axis]) <= 2
            assert daemon.states[axis] is states[axis]
            assert ENABLE_OPERATION not in words
            assert words == [] or states[axis] is not AxisState.LATCHED

    def mend(self) -> None:
        """Removes the faults."""
        self.daemon.bus.down = None
        faults = self.node.faults
        faults.silent = faults.mute_heartbeat = False
        faults.load_jump_counts = faults.drop_tpdos = faults.shorten_tpdos = 0
        faults.load_reading = None
        self.daemon.run(0.6)

    def leads_back(self) -> None:
        """Checks that each stopped axis is disabled after a reset, without motion, and moves once enabled."""
        stopped = [axis for axis, state in enumerate(self.states) if state is not AxisState.ENABLED]
        places = [self.daemon.motor_counts(axis) for axis in range(2)]

        async def story() -> None:
            async with self.service.bridge() as bridge:
                token = bridge.lease.take("test")
                for place in stopped:
                    axis = bridge.axes[f"axis{place + 1}"]
                    if self.states[place] is AxisState.QUICK_STOPPED:
                        await until(bridge, lambda axis=axis: free(axis))
                        await axis.reset(token)
                    await until(bridge, lambda axis=axis: free(axis) and axis.state().state == "disabled")
                    await bridge.core.timing.sleep(0.2)
                    assert axis.state().state == "disabled"
                    await axis.enable(token)
                    assert abs(self.daemon.motor_counts(place) - places[place]) <= 2
                    await axis.motion.move(token, axis.state().load_target_deg + 1.0)

        play(story())


def free(axis: ServiceAxis) -> bool:
    """Returns True if no client has exclusive use of the drive."""
    try:
        axis.check_free()
    except RefusedError:
        return False
    return True


def _wrong_once(axis: AxisLoop) -> None:
    caps, model = axis.config.compensation, axis.follower.correction.model
    limits = CompensationLimits(caps.maximum_arcsec, caps.slew_arcsec_s, caps.ramp_s)
    axis.follower.correction = Correction(WrongOnce(model, limits, axis.config.drive.cycle_s))


@contextmanager
def daemon_bench(folder: Path, character: Character = FRIENDLY) -> Iterator[DaemonBench]:
    """Provides two axes, at rest and not verified."""
    with stepped_service(folder, axes=2, setup=_wrong_once, character=character) as service:
        yield DaemonBench(service)
