"""Commissioning interface of a CiA-402 drive: boots, enables and moves it, and never leaves it enabled.

    with open_bus(axis.bus) as bus, Drive(bus, axis) as drive:
        drive.boot()
        drive.enable(Mode.PP)
        drive.move_to(90.0)

For the control cycle, `enable()` prepares everything and hands over to ``image.power``. The cycle then walks
the states by PDO, while SYNC and set-points are already running.
"""

import logging
from contextlib import suppress
from types import TracebackType
from typing import Final, NamedTuple, Self

import can
from canopen.objectdictionary import ObjectDictionary

from hdbridge.axis import AxisConfig, Identity
from hdbridge.cia301 import NmtCommand
from hdbridge.clock import Clock, MonotonicClock
from hdbridge.drive import modes, objects
from hdbridge.drive.bootup import BootReport, BootUp
from hdbridge.drive.commander import STEP_TIMEOUT_S, Commander, MasterHeartbeat
from hdbridge.drive.dictionary import dictionary_of, find
from hdbridge.drive.image import ProcessImage
from hdbridge.drive.link import Link
from hdbridge.drive.masterdetection import refuse_other_masters
from hdbridge.drive.monitor import NetworkMonitor
from hdbridge.drive.objects import Address, IntegerType, Mode
from hdbridge.drive.sdo import DEFAULT_TIMEOUT_S, SdoAbortError, SdoClient
from hdbridge.drive.states import FAULTS, OFF, Command, State, decode, row_for
from hdbridge.drive.writes import master_heartbeat
from hdbridge.errors import DriveError, HdbridgeError, InputError, TransitionError

_log = logging.getLogger(__name__)
_CLOSING_TIMEOUT_S: Final = 0.2


class Positions(NamedTuple):
    """Positions of the axis from both encoders."""

    motor_counts: int
    load_counts: int
    motor_deg: float
    load_deg: float


class Drive:
    """One drive on one bus. As a context manager it stops and disables the drive on every exit.

    The bus belongs to the caller and stays open. ``od`` replaces the EDS of the axis file (for a test, or a
    DCF). With ``force``, frames are sent even if another master is heard on the bus.
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
        od = dictionary_of(axis) if od is None else od
        self.image = ProcessImage(axis, od)
        self._heartbeat = MasterHeartbeat(self.link, self.image)
        self.sdo = SdoClient(
            self.link, self.monitor, axis.drive.node_id, od, sdo_timeout_s, recv=self._heartbeat.recv
        )
        self._clients = {axis.drive.node_id: self.sdo}
        encoder = axis.load_encoder.source.node
        if encoder is not None:
            self.monitor.watch(encoder)
            self._clients[encoder] = SdoClient(
                self.link, self.monitor, encoder, None, sdo_timeout_s, recv=self._heartbeat.recv
            )
        self._commander = Commander(self.link, self.monitor, self.sdo, self.image)
        self._mode: Mode | None = None
        self._touched = False
        self._may_speak = force or self.link.private
        self._heard: frozenset[int] = frozenset()
        self.report: BootReport | None = None
        """Result of the last boot-up."""

    def listen(self) -> None:
        """Listens once for another master without sending; raises `BusInUseError` if there is one.

        Takes two heartbeat periods, and at least the 0.51 s in which the slowest master sends two SYNCs.
        Called by `boot`; must be called before reading objects of a drive that is not booted.
        """
        if not self._may_speak:
            heard = refuse_other_masters(self.link, (self.axis,), self.monitor.dispatch)
            self._heard = frozenset(heard.difference(self._clients))
            self._may_speak = True

    def boot(self, *, reset: bool = True) -> BootReport:
        """Boots the drive up to OPERATIONAL with power off; docs/architecture.md describes each step.

        By default (``reset``) the node's communication is reset first, so that it starts from known settings.
        Raises `DriveError` if the drive is absent or refuses, `IdentityError` if it is a different drive or
        has a different scaling, `BusInUseError` before anything is sent if another master is heard, and
        `BusError`.
        """
        self.listen()
        self._touched = True
        self.report = None
        self._mode = None
        self._heartbeat.on = False
        if reset:  # SYNC could apply a set-point that survives the reset
            with suppress(HdbridgeError):
                self._switch_off()
        self.report = BootUp(self.link, self.monitor, self.axis, self._clients, self._heard).run(reset=reset)
        for note in self.report.notes:
            _log.warning("boot-up", {"node": self.axis.drive.node_id, "note": note})
        _log.info("booted", {"node": self.axis.drive.node_id, "bus": self.link.name, **self.report.identity})
        return self.report

    def take_over(self) -> BootReport:
        """Takes over a drive that another process on this computer has booted, whatever its state.

        Compares the drive with the axis file and raises like `boot`; writes nothing to the drive.
        """
        self.listen()
        self.report = BootUp(self.link, self.monitor, self.axis, self._clients).look()
        return self.report

    @property
    def identity(self) -> Identity:
        """Identity of the drive, as read in the boot-up, else as expected by the axis file."""
        answered = self.report.identity if self.report else {}
        return Identity.model_validate({**self.axis.drive.identity.model_dump(exclude_none=True), **answered})

    def enable(self, mode: Mode | None = None) -> None:
        """Sets the target to the actual position, sets and checks the mode, then enables.

        The default is the mode of the control cycle (``drive.mode``). In PP and HM, this method walks the
        states by SDO. A cyclic mode requires SYNC and set-points while the drive is enabled, so this method
        only sets the aim of ``image.power``, and the cycle walks the states. Raises `DriveError` for a fault
        (call `fault_reset` first) or a position outside the limits, `TransitionError`, and `InputError` for
        the other cyclic mode.
        """
        cyclic = self.image.cyclic.mode
        mode = cyclic if mode is None else mode
        if mode is not cyclic and mode in (Mode.CSP, Mode.IP):
            raise InputError(f"{self.axis.where('drive.mode')} is {self.axis.drive.mode}, not {mode.name}")
        positions = self._make_ready(mode)
        has_target = self.sdo.has(objects.TARGET_POSITION.index, objects.TARGET_POSITION.sub)
        # In interpolated position mode the target is 60C1h, which arrives by PDO before any motion is
        # possible.
        preload = has_target and mode is not Mode.IP
        motor_counts = self._commander.preload_target() if preload else positions.motor_counts
        self.image.halt = False
        self.image.seed(motor_counts, positions.load_counts, self._commander.statusword())
        _log.info("enable", {"node": self.axis.drive.node_id, "mode": mode.name})
        if mode is cyclic:
            self.image.power.go(State.OPERATION_ENABLED)
        else:
            try:
                self._commander.walk(State.OPERATION_ENABLED)
            except BaseException:
                self.power_off()
                raise

    def prepare(self) -> Positions:
        """Prepares for power in the cyclic mode while a control cycle already runs; returns the positions.

        Like `enable`, but the cycle's RPDOs keep the target at the actual position, and the cycle walks the
        states.
        """
        return self._make_ready(self.image.cyclic.mode)

    def _make_ready(self, mode: Mode) -> Positions:
        """Does all preparations for power except the target: checks, heartbeat monitoring, mode."""
        modes_of_drive = self._booted().modes
        if mode not in modes_of_drive:
            raise DriveError(
                f"{self._commander.name}: has no mode {mode.name} (6502h); it has "
                + ", ".join(each.name for each in modes_of_drive)
            )
        state = self._commander.state()
        if state in FAULTS:
            raise self._commander.fault("before it was enabled")
        if state is not State.SWITCH_ON_DISABLED:
            raise TransitionError(
                f"{self._commander.name}: is in '{state.value}', but a drive is enabled from "
                "'switch on disabled'; disable it first"
            )
        positions = self.read_positions()
        if mode is not Mode.HM:
            # Homing is the way back into the limits, so it is allowed outside them.
            self._check_within_limits(positions)
        self._expect_master(True)
        self._commander.set_mode(mode)
        self._mode = mode
        if (node_id := self.monitor.restarted) is not None:
            raise TransitionError(
                f"node {node_id} on {self.link.name}: has restarted (boot-up message) since it was "
                "verified; run the command again, which boots it (in the library: boot()), and if it recurs, "
                "check its supply"
            )
        return positions

    def disable(self) -> None:
        """Brakes, then switches power off, by SDO. Permitted in all states but an active fault reaction."""
        state = self._commander.state()
        if state is State.OPERATION_ENABLED:
            self._commander.walk(State.SWITCHED_ON)
        if state is State.QUICK_STOP_ACTIVE:
            self._commander.wait_for_standstill()
        if self._commander.state() not in OFF:
            self._commander.walk(State.SWITCH_ON_DISABLED)
        self._expect_master(False)
        self._mode = None
        _log.info("disabled", {"node": self.axis.drive.node_id, "state": state.value})

    def fault_reset(self) -> str:
        """Resets a fault by a rising edge on bit 7; returns the error code and last emergency as text.

        Raises `TransitionError` if the drive is not in fault, `DriveError` if the fault persists.
        """
        commander = self._commander
        row_for(commander.state(), Command.FAULT_RESET)
        words = commander.fault_words()
        commander.control(0x0000)
        commander.control(Command.FAULT_RESET.word)
        try:
            commander.wait_for(
                "the end of the fault",
                lambda word: decode(word) not in FAULTS,
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
        """Stops at once, as selected by object 605Ah; returns the resulting state."""
        return self._commander.quick_stop()

    def halt(self) -> bool:
        """Halts in 'operation enabled', as selected by 605Dh; returns True if the axis came to rest."""
        return modes.halt(self._commander)

    def wait(self, duration_s: float) -> None:
        """Waits while the drive is enabled outside the control cycle.

        A drive that hears no heartbeat of the master for ``drive.heartbeat_ms`` stops on its own. Unlike a
        plain sleep, this method keeps sending the heartbeat.
        """
        self._commander.pause(duration_s)

    def wait_for_standstill(self) -> bool:
        """Waits until the motor stands still, by SDO; returns False if it does not within three seconds."""
        return self._commander.wait_for_standstill()

    def move_to(
        self,
        load_deg: float,
        velocity_deg_s: float | None = None,
        acceleration_deg_s2: float | None = None,
        timeout_s: float | None = None,
    ) -> Positions:
        """Moves to a load angle in PP, enabling the drive if necessary; returns the positions on arrival.

        Speed and acceleration are at the load and default to the limits of the axis. Raises `InputError`
        before anything is sent if a value is not finite or outside the limits, `DriveError` if the drive
        fails on the way, and `TransitionError` on time-out (computed from the travel unless given).
        """
        move = modes.ProfileMove(load_deg, velocity_deg_s, acceleration_deg_s2, timeout_s)
        move.checked(self.image)
        self._need(Mode.PP)
        modes.run_move(self._commander, move)
        return self.read_positions()

    def home(
        self,
        method: int,
        switch_velocity_deg_s: float | None = None,
        zero_velocity_deg_s: float | None = None,
        acceleration_deg_s2: float | None = None,
        offset_deg: float = 0.0,
        timeout_s: float = 60.0,
    ) -> Positions:
        """Homes by a method of 6098h, enabling the drive if necessary; returns the positions afterwards.

        Speeds, acceleration and offset (607Ch) are at the load. Raises like `move_to`.
        """
        homing = modes.Homing(
            method, switch_velocity_deg_s, zero_velocity_deg_s, acceleration_deg_s2, offset_deg, timeout_s
        )
        homing.checked(self.axis)
        self._need(Mode.HM)
        modes.run_homing(self._commander, homing)
        return self.read_positions()

    def state(self) -> State:
        """Reads the power state by SDO."""
        return self._commander.state()

    def read_positions(self) -> Positions:
        """Reads both encoders by SDO."""
        source = self.axis.load_encoder.source
        client = self._clients[source.node if source.node is not None else self.axis.drive.node_id]
        motor = self.sdo.fetch(objects.POSITION_ACTUAL)
        load = client.read(source.index, source.subindex, IntegerType.named(source.type))
        return Positions(motor, load, self.image.motor_deg(motor), self.image.load_deg(load))

    def can_set(self, address: Address) -> bool:
        """Returns True if an object can be written, by the EDS and by the writes of the boot-up."""
        variable = find(self.sdo.od, address.index, address.sub)
        left = self.report.left if self.report is not None else ()
        return variable is not None and variable.writable and (address.index, address.sub) not in left

    def power_off(self) -> list[str]:
        """Stops and disables a drive that may be unable to answer; returns the problems as text."""
        self._mode = None
        self.image.power.power_off()
        try:
            self._power_off()
        except HdbridgeError as error:
            self._power_off_blindly()
            return [str(error)]
        return []

    def close(self) -> list[str]:
        """Stops and disables the drive and takes it out of OPERATIONAL; returns the problems as text.

        Tries every step and raises no errors of its own, because it also runs when the bus is broken.
        """
        if not self._touched:
            return []
        self._touched = False
        problems = self.power_off()
        with suppress(HdbridgeError):
            for node_id in self._clients:
                self.link.send(objects.COB_NMT, bytes((NmtCommand.PRE_OPERATIONAL, node_id)))
        return problems

    def __enter__(self) -> Self:
        """Returns the drive; sends nothing yet."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes the drive; a failure to disable it is raised, or added as a note to the current error."""
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
        """Makes the drive monitor the master's heartbeat only while power may be on.

        Without power nothing can move, and the master may be busy reading or writing files. The drive starts
        monitoring with the first heartbeat after object 1016h was written.
        """
        if self.can_set(objects.HEARTBEAT_CONSUMER):
            self.sdo.store(objects.HEARTBEAT_CONSUMER, master_heartbeat(self.axis) if expected else 0)
        self._heartbeat.on = expected

    def _power_off(self) -> None:
        quick = self._switch_off()
        if self.can_set(objects.HEARTBEAT_CONSUMER):
            # The master leaves on purpose; its silence from now on is not a fault.
            with suppress(SdoAbortError):  # a drive that refuses this never monitored it
                quick.store(objects.HEARTBEAT_CONSUMER, 0)

    def _switch_off(self) -> SdoClient:
        """Stops and disables the drive; returns the SDO client with short time-outs that it used."""
        quick = SdoClient(
            self.link,
            self.monitor,
            self.axis.drive.node_id,
            self.sdo.od,
            _CLOSING_TIMEOUT_S,
            2,
            self._heartbeat.recv,
        )
        commander = Commander(self.link, self.monitor, quick, self.image)
        state = commander.state()
        if state in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.UNKNOWN):
            if commander.quick_stop() is State.QUICK_STOP_ACTIVE:
                commander.wait_for_standstill()
            state = commander.state()
        if state not in OFF:
            commander.control(0x0000)
            commander.wait_for(
                "'switch on disabled'", lambda word: decode(word) in OFF, STEP_TIMEOUT_S, allow_fault=True
            )
        return quick

    def _power_off_blindly(self) -> None:
        """Powers off without waiting for answers, because a drive may be unable to send."""
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
