"""A CiA-402 drive from the commissioning side: boot it, enable it, move it, and never leave it enabled.

    with open_bus(axis.bus) as bus, Drive(bus, axis) as drive:
        drive.boot()
        drive.enable(Mode.PP)
        drive.move_to(90.0)

For the control cycle, `enable()` prepares everything and hands over to ``image.power``: the cycle then walks
the states by PDO, while SYNC and set-points are already running.
"""

from __future__ import annotations

import logging
from contextlib import suppress
from types import TracebackType
from typing import TYPE_CHECKING, Final, NamedTuple, Self

from hdbridge.axis import Identity
from hdbridge.clock import Clock, MonotonicClock
from hdbridge.drive import modes, objects
from hdbridge.drive.bootup import BootReport, BootUp
from hdbridge.drive.commander import STEP_TIMEOUT_S, Commander
from hdbridge.drive.dictionary import find, is_writable
from hdbridge.drive.image import ProcessImage
from hdbridge.drive.link import Link
from hdbridge.drive.manners import USUAL_MASTER, Ear, listening_s
from hdbridge.drive.monitor import NetworkMonitor
from hdbridge.drive.objects import Address, IntegerType, Mode, NmtCommand
from hdbridge.drive.sdo import DEFAULT_TIMEOUT_S, SdoAbortError, SdoClient
from hdbridge.drive.states import Command, State, decode, row_for
from hdbridge.drive.writes import master_heartbeat
from hdbridge.errors import DriveError, HdbridgeError, InputError, TransitionError
from hdbridge.files.edsfile import shared_eds

if TYPE_CHECKING:
    import can
    from canopen.objectdictionary import ObjectDictionary

    from hdbridge.axis import AxisConfig

_log = logging.getLogger(__name__)
_CLOSING_TIMEOUT_S: Final = 0.2
_OFF: Final = (State.SWITCH_ON_DISABLED, State.FAULT, State.NOT_READY_TO_SWITCH_ON)


class Positions(NamedTuple):
    """Where the axis is, by both encoders."""

    motor_counts: int
    load_counts: int
    motor_deg: float
    load_deg: float


class Drive:
    """One drive on one bus. A context manager: on every way out the drive is stopped and disabled.

    The bus stays the caller's and open. ``od`` replaces the EDS of the axis file (for a test, or a DCF).
    ``force`` speaks even where another master is heard on the bus.
    """

    def __init__(
        self,
        bus: can.BusABC,
        axis: AxisConfig,
        clock: Clock | None = None,
        od: ObjectDictionary | None = None,
        sdo_timeout_s: float = DEFAULT_TIMEOUT_S,
        *,
        force: bool = False,
    ) -> None:
        self.axis = axis
        self.link = Link(bus, clock if clock is not None else MonotonicClock())
        self.monitor = NetworkMonitor(axis.drive.node_id)
        if od is None:
            od = shared_eds(axis.eds_path, axis.drive.node_id).dictionary
        self.image = ProcessImage(axis, od)
        self.sdo = SdoClient(self.link, self.monitor, axis.drive.node_id, od, sdo_timeout_s)
        self._clients = {axis.drive.node_id: self.sdo}
        encoder = axis.load_encoder.source.node
        if encoder is not None:
            self.monitor.watch(encoder)
            self._clients[encoder] = SdoClient(self.link, self.monitor, encoder, None, sdo_timeout_s)
        self._commander = Commander(self.link, self.monitor, self.sdo, self.image)
        self._mode: Mode | None = None
        self._touched = False
        self._may_speak = force or self.link.private
        self._heard: frozenset[int] = frozenset()
        self.report: BootReport | None = None
        """What the last boot-up found and did."""

    def listen(self) -> None:
        """Hear, once, whether somebody else masters the bus; `BusInUseError` then, and nothing is sent.

        It takes two heartbeats, and at least the 0.51 s in which the slowest other master sends two SYNCs.
        `boot` does it; call it before reading objects of a drive that is not booted.
        """
        if self._may_speak:
            return
        drive = self.axis.drive
        ear = Ear({drive.node_id}, {drive.master_node_id, USUAL_MASTER}, self._clients)
        duration_s = listening_s(drive.heartbeat_ms)
        ear.listen(self.link, duration_s, self.monitor.dispatch)
        ear.refuse(self.link.name, duration_s)
        self._heard = frozenset(ear.nodes.difference(self._clients))
        self._may_speak = True

    def boot(self, *, reset: bool = True) -> BootReport:
        """Boot the drive up to OPERATIONAL, power off: see docs/master.md for each step.

        ``reset`` resets the node's communication first, so that it starts from known settings. Raises
        `DriveError` when it is absent or refuses, `IdentityError` when it is another drive or scales
        differently, `BusInUseError` before anything is sent when another master is heard, `BusError`.
        """
        self.listen()
        self._touched = True
        self.report = None
        self._mode = None
        self.report = BootUp(self.link, self.monitor, self.axis, self._clients, self._heard).run(reset=reset)
        for note in self.report.notes:
            _log.warning("boot-up", {"node": self.axis.drive.node_id, "note": note})
        _log.info("booted", {"node": self.axis.drive.node_id, "bus": self.link.name, **self.report.identity})
        return self.report

    def take_over(self) -> BootReport:
        """Take over a drive that another process of this machine has booted, in whatever state it is.

        Compares it with the axis file as `boot` does, and raises as that; writes nothing.
        """
        self.listen()
        self.report = BootUp(self.link, self.monitor, self.axis, self._clients).look()
        return self.report

    @property
    def identity(self) -> Identity:
        """Which drive it is: what the booted one has answered, else what the axis file expects."""
        answered = self.report.identity if self.report else {}
        return Identity.model_validate({**self.axis.drive.identity.model_dump(exclude_none=True), **answered})

    def enable(self, mode: Mode | None = None) -> None:
        """Make ready for power in ``mode``: target = actual position, mode set and seen in 6061h, then power.

        By default the mode is that of the control cycle (``drive.mode``). In PP and HM the states are walked
        here, by SDO. In a cyclic mode they are not: the drive wants SYNC and set-points while it is enabled,
        so ``image.power`` is aimed and the cycle walks. Raises `DriveError` for a fault (`fault_reset`
        first), for a position outside the limits, `TransitionError`, `InputError` for another cyclic mode.
        """
        cyclic = self.image.cyclic.mode
        mode = cyclic if mode is None else mode
        if mode is not cyclic and mode in (Mode.CSP, Mode.IP):
            raise InputError(f"{self.axis.where('drive.mode')} is {self.axis.drive.mode}, not {mode.name}")
        positions = self._make_ready(mode)
        has_target = self.sdo.has(objects.TARGET_POSITION.index, objects.TARGET_POSITION.sub)
        # In interpolated position mode the target is 60C1h, and comes by PDO before anything may move.
        preload = has_target and mode is not Mode.IP
        motor_counts = self._commander.preload_target() if preload else positions.motor_counts
        self.image.halt = False
        self.image.seed(motor_counts, positions.load_counts, self._commander.statusword())
        _log.info("enable", {"node": self.axis.drive.node_id, "mode": mode.name})
        if mode is cyclic:
            self.image.power.go(State.OPERATION_ENABLED)
        else:
            self._commander.walk(State.OPERATION_ENABLED)

    def prepare(self) -> Positions:
        """Make ready for power in the cyclic mode while a control cycle runs already; where the axis stands.

        As `enable`, but the cycle's RPDOs keep the target at the actual position, and it walks the states.
        """
        return self._make_ready(self.image.cyclic.mode)

    def _make_ready(self, mode: Mode) -> Positions:
        """All that precedes power but the target: checks, the watch for the master, the mode."""
        modes_of_drive = self._booted().modes
        if mode not in modes_of_drive:
            raise DriveError(
                f"{self._commander.name}: has no mode {mode.name} (6502h); it has "
                + ", ".join(each.name for each in modes_of_drive)
            )
        state = self._commander.state()
        if state in (State.FAULT, State.FAULT_REACTION_ACTIVE):
            raise self._commander.fault("before it was enabled")
        if state is not State.SWITCH_ON_DISABLED:
            raise TransitionError(
                f"{self._commander.name}: is in '{state.value}', but a drive is enabled from "
                "'switch on disabled'; disable it first"
            )
        positions = self.read_positions()
        if mode is not Mode.HM:
            # Homing is the way back from there, so it is not refused.
            self._check_within_limits(positions)
        self._expect_master(True)
        self._commander.set_mode(mode)
        self._mode = mode
        return positions

    def disable(self) -> None:
        """Brake, then switch power off, by SDO. Allowed in every state but a running fault reaction."""
        state = self._commander.state()
        if state is State.OPERATION_ENABLED:
            self._commander.walk(State.SWITCHED_ON)
        if state is State.QUICK_STOP_ACTIVE:
            self._commander.wait_for_standstill()
        if self._commander.state() not in _OFF:
            self._commander.walk(State.SWITCH_ON_DISABLED)
        self._expect_master(False)
        self._mode = None
        _log.info("disabled", {"node": self.axis.drive.node_id, "state": state.value})

    def fault_reset(self) -> str:
        """Resets a fault by a rising edge on bit 7; returns its error code and last emergency in words.

        Raises `TransitionError` if the drive is not in fault, `DriveError` if the fault stays.
        """
        commander = self._commander
        row_for(commander.state(), Command.FAULT_RESET)
        words = commander.fault_words()
        commander.control(0x0000)
        commander.control(Command.FAULT_RESET.word)
        try:
            commander.wait_for(
                "the end of the fault",
                lambda word: decode(word) not in (State.FAULT, State.FAULT_REACTION_ACTIVE),
                STEP_TIMEOUT_S,
                allow_fault=True,
            )
        except TransitionError:
            raise commander.fault("that a reset does not clear") from None
        finally:
            commander.control(0x0000)
        commander.state()
        return words

    def quick_stop(self) -> State:
        """Stop at once. What follows is 605Ah's choice; the state in which the drive then is."""
        return self._commander.quick_stop()

    def halt(self) -> bool:
        """Halt without leaving 'operation enabled' (605Dh says how); whether the axis came to rest."""
        return modes.halt(self._commander)

    def wait(self, duration_s: float) -> None:
        """Let time pass while the drive is enabled, outside the control cycle.

        A drive that hears no heartbeat of the master for ``drive.heartbeat_ms`` stops by itself; this keeps
        it going, a plain sleep does not.
        """
        self._commander.pause(duration_s)

    def move_to(
        self,
        load_deg: float,
        velocity_deg_s: float | None = None,
        acceleration_deg_s2: float | None = None,
        timeout_s: float | None = None,
    ) -> Positions:
        """Move to a load angle in PP, enabling the drive for it where it is not; where the axis then is.

        Speed and acceleration are at the load; the limits of the axis are their defaults. Raises `InputError`
        before anything is sent when a value is not finite or outside the limits, `DriveError` when the drive
        fails on the way, `TransitionError` when it takes too long (computed from the travel unless given).
        """
        move = modes.ProfileMove.checked(self.image, load_deg, velocity_deg_s, acceleration_deg_s2, timeout_s)
        self._need(Mode.PP)
        modes.run_move(self._commander, move)
        return self.read_positions()

    def home(
        self,
        method: int,
        switch_velocity_deg_s: float,
        zero_velocity_deg_s: float,
        acceleration_deg_s2: float | None = None,
        offset_deg: float = 0.0,
        timeout_s: float = 60.0,
    ) -> Positions:
        """Home by a method of 6098h, enabling the drive for it where it is not; where the axis then is.

        Speeds, acceleration and offset (607Ch) are at the load. Raises as `move_to` does.
        """
        homing = modes.Homing.checked(
            self.axis,
            method,
            switch_velocity_deg_s,
            zero_velocity_deg_s,
            acceleration_deg_s2,
            offset_deg,
            timeout_s,
        )
        self._need(Mode.HM)
        modes.run_homing(self._commander, homing)
        return self.read_positions()

    def state(self) -> State:
        """The power state, read by SDO."""
        return self._commander.state()

    def read_positions(self) -> Positions:
        """Both encoders by SDO, as they read now."""
        source = self.axis.load_encoder.source
        client = self._clients[source.node if source.node is not None else self.axis.drive.node_id]
        motor = self.sdo.fetch(objects.POSITION_ACTUAL)
        load = client.read(source.index, source.subindex, IntegerType.named(source.type))
        return Positions(motor, load, self.image.motor_deg(motor), self.image.load_deg(load))

    def can_set(self, address: Address) -> bool:
        """The drive has an object that can be written, by its EDS and by what it took in the boot-up."""
        variable = find(self.sdo.od, address.index, address.sub)
        left = self.report.left if self.report is not None else ()
        return variable is not None and is_writable(variable) and (address.index, address.sub) not in left

    def close(self) -> list[str]:
        """Stop and disable the drive, take it out of OPERATIONAL; what did not work, in words.

        Tries everything, raises nothing of its own: it runs when the bus is broken, too.
        """
        if not self._touched:
            return []
        self._touched = False
        self._mode = None
        problems = []
        try:
            self._power_off()
        except HdbridgeError as error:
            problems.append(str(error))
            self._power_off_blindly()
        with suppress(HdbridgeError):
            for node_id in self._clients:
                self.link.send(objects.COB_NMT, bytes((NmtCommand.PRE_OPERATIONAL, node_id)))
        return problems

    def __enter__(self) -> Self:
        """The drive itself; nothing is sent yet."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """`close`; a failure to disable the drive is raised, or added to the error that is on its way."""
        problems = self.close()
        if not problems:
            return
        warning = (
            f"{self._commander.name}: it is not certain that power is off ({'; '.join(problems)}); "
            "switch the drive off by its enable input or STO"
        )
        if error is None:
            raise DriveError(warning)
        error.add_note(warning)

    def _expect_master(self, expected: bool) -> None:
        """Have the drive watch the master's heartbeat while power may be on, and only then.

        Without power nothing can move, and the master may be busy with files. A drive begins to watch with
        the first heartbeat that it hears after this object was written.
        """
        if self.can_set(objects.HEARTBEAT_CONSUMER):
            self.sdo.store(objects.HEARTBEAT_CONSUMER, master_heartbeat(self.axis) if expected else 0)

    def _power_off(self) -> None:
        quick = SdoClient(
            self.link, self.monitor, self.axis.drive.node_id, self.sdo.od, _CLOSING_TIMEOUT_S, attempts=2
        )
        commander = Commander(self.link, self.monitor, quick, self.image)
        state = commander.state()
        if state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.UNKNOWN):
            if commander.quick_stop() is State.QUICK_STOP_ACTIVE:
                commander.wait_for_standstill()
            state = commander.state()
        if state not in _OFF:
            commander.control(0x0000)
            commander.wait_for(
                "'switch on disabled'", lambda word: decode(word) in _OFF, STEP_TIMEOUT_S, allow_fault=True
            )
        if self.can_set(objects.HEARTBEAT_CONSUMER):
            # The master leaves on purpose; its silence from now on is no fault.
            with suppress(SdoAbortError):  # a drive that refuses this has never watched
                quick.store(objects.HEARTBEAT_CONSUMER, 0)

    def _power_off_blindly(self) -> None:
        """The same without an answer: as frames that a drive which only listens can still obey."""
        request = objects.COB_SDO_REQUEST + self.axis.drive.node_id
        with suppress(HdbridgeError):
            for word in (Command.QUICK_STOP.word, Command.DISABLE_VOLTAGE.word):
                self.link.send(request, bytes((0x2B, 0x40, 0x60, 0x00, word, 0, 0, 0)))
                self.link.clock.sleep_until(self.link.now() + _CLOSING_TIMEOUT_S)

    def _booted(self) -> BootReport:
        if self.report is None:
            raise TransitionError(f"{self._commander.name}: has not been booted; call boot() first")
        return self.report

    def _need(self, mode: Mode) -> None:
        if self._mode is mode and self._commander.state() is State.OPERATION_ENABLED:
            return
        self._booted()
        if self._commander.state() is State.OPERATION_ENABLED:
            self.disable()
        self.enable(mode)

    def _check_within_limits(self, positions: Positions) -> None:
        least, greatest = self.image.limits_counts
        if not least <= positions.motor_counts <= greatest:
            at_deg = positions.motor_deg / self.axis.gear.ratio
            raise DriveError(
                f"{self._commander.name}: the axis stands at {at_deg:g} deg by the motor encoder, outside "
                f"{self.axis.limits.position_min_deg:g} .. {self.axis.limits.position_max_deg:g} deg "
                f"({self.axis.where('limits.position_min_deg')}, position_max_deg); home it, or "
                "turn it back by hand"
            )


__all__ = ["BootReport", "Drive", "Positions", "ProcessImage"]
