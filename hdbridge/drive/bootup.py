"""From an unknown node to a drive that is known, configured and OPERATIONAL (but not enabled).

Nothing is believed: the identity is compared, the scaling is compared, and every object that is written is
read back. The first thing that is not as expected ends the boot-up with an error that names the object.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from typing import TYPE_CHECKING, Final

from hdbridge.drive import objects
from hdbridge.drive.link import Link
from hdbridge.drive.monitor import NetworkMonitor
from hdbridge.drive.objects import Address, Mode, NmtCommand, NmtState
from hdbridge.drive.sdo import SdoAbortError, SdoClient
from hdbridge.drive.states import State, decode
from hdbridge.drive.writes import PlannedWrite, plan
from hdbridge.errors import DriveError, IdentityError, SdoError

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig

BOOT_UP_TIMEOUT_S: Final = 2.0
"""How long a node may take from a reset to its boot-up message before it is asked directly."""
STATE_TIMEOUT_S: Final = 1.0
_POLL_S: Final = 0.02
_RATED_TORQUE_TOLERANCE: Final = 0.01


@dataclass(frozen=True, slots=True)
class BootReport:
    """What the boot-up found and did."""

    node_id: int
    identity: dict[str, int]
    names: dict[str, str]
    """Device name and versions (1008h, 1009h, 100Ah), where the drive tells them."""
    modes: tuple[Mode, ...]
    """Modes of operation that the drive has, of those that are used here."""
    state: State
    written: tuple[PlannedWrite, ...]
    notes: tuple[str, ...] = field(default=())
    """What is worth knowing but no reason to refuse."""


class BootUp:
    """One boot-up. ``clients`` has an SDO client for the drive, and one for a separate load encoder."""

    def __init__(
        self, link: Link, monitor: NetworkMonitor, axis: AxisConfig, clients: dict[int, SdoClient]
    ) -> None:
        self._link = link
        self._monitor = monitor
        self._axis = axis
        self._clients = clients
        self._sdo = clients[axis.drive.node_id]
        self._others_heard: set[int] = set()

    def run(self, *, reset: bool) -> BootReport:
        """All of it, in order. Raises `DriveError` (or a kind of it) at the first thing that is wrong."""
        for node_id in self._clients:
            self._reach(node_id, reset=reset)
        self._check_device_type()
        identity = self._check_identity()
        modes = self._check_modes()
        self._power_off()
        notes = self._check_scaling()
        written = tuple(plan(self._axis, self._sdo.od))
        for row in written:
            self._write(row)
        for node_id in self._clients:
            self._start(node_id)
        return BootReport(
            node_id=self._axis.drive.node_id,
            identity=identity,
            names=self._names(),
            modes=modes,
            state=decode(self._sdo.fetch(objects.STATUSWORD)),
            written=written,
            notes=tuple(notes),
        )

    # -- network management -------------------------------------------------------------------------------

    def _nmt(self, command: NmtCommand, node_id: int) -> None:
        self._link.send(objects.COB_NMT, bytes((command, node_id)))

    def _receive_until(self, deadline_s: float) -> bool:
        frame = self._link.recv(deadline_s)
        if frame is None:
            return False
        self._monitor.dispatch(frame)
        node_id = frame.can_id - objects.COB_HEARTBEAT
        if 0 < node_id < 128 and node_id not in self._clients:
            self._others_heard.add(node_id)
        return frame.time_s <= deadline_s

    def _reach(self, node_id: int, *, reset: bool) -> None:
        """Get a node into PRE-OPERATIONAL, and be sure that it is there."""
        status = self._monitor.watch(node_id)
        if reset:
            before = status.boot_ups
            self._nmt(NmtCommand.RESET_COMMUNICATION, node_id)
            deadline_s = self._link.now() + BOOT_UP_TIMEOUT_S
            while status.boot_ups == before and self._receive_until(deadline_s):
                pass
        self._nmt(NmtCommand.PRE_OPERATIONAL, node_id)
        try:
            self._clients[node_id].fetch(objects.DEVICE_TYPE)
        except SdoAbortError:
            raise  # it answered: it is there
        except SdoError as error:
            heard = ", ".join(map(str, sorted(self._others_heard)))
            own = node_id == self._axis.drive.node_id
            where = "drive.node_id" if own else "load_encoder.source.node"
            raise DriveError(
                f"node {node_id} on {self._link.name} does not answer"
                + (f" (heard: node {heard})" if heard else " (no other node was heard either)")
                + f"; check power, cable, termination, bit rate and {where} in {self._axis.path}"
            ) from error

    def _start(self, node_id: int) -> None:
        status = self._monitor.watch(node_id)
        self._nmt(NmtCommand.START, node_id)
        deadline_s = self._link.now() + STATE_TIMEOUT_S + 2e-3 * self._axis.drive.heartbeat_ms
        status.nmt_state = None
        while status.nmt_state != NmtState.OPERATIONAL and self._receive_until(deadline_s):
            pass
        if status.nmt_state != NmtState.OPERATIONAL:
            said = "no heartbeat came" if status.nmt_state is None else f"it says {status.nmt_state:02X}h"
            raise DriveError(
                f"node {node_id} on {self._link.name} did not become OPERATIONAL ({said}, expected 05h); "
                "look at its error display and at drive.heartbeat_ms"
            )

    # -- what it is ---------------------------------------------------------------------------------------

    def _check_device_type(self) -> None:
        found = self._sdo.fetch(objects.DEVICE_TYPE)
        if found & 0xFFFF != objects.DEVICE_PROFILE_402:
            raise IdentityError(
                f"{self._name(objects.DEVICE_TYPE)}: is {found:08X}h, device profile {found & 0xFFFF}; "
                f"expected 402 (drives and motion control); check drive.node_id in {self._axis.path}"
            )

    def _check_identity(self) -> dict[str, int]:
        wanted = self._axis.drive.identity
        found: dict[str, int] = {}
        for address, key, expected in (
            (objects.VENDOR_ID, "vendor_id", wanted.vendor_id),
            (objects.PRODUCT_CODE, "product_code", wanted.product_code),
            (objects.REVISION, "revision", wanted.revision),
            (objects.SERIAL, "serial", wanted.serial),
        ):
            if expected is None and not self._sdo.has(address.index, address.sub):
                continue
            found[key] = self._sdo.fetch(address)
            if expected is not None and found[key] != expected:
                raise IdentityError(
                    f"{self._name(address)}: is {found[key]:X}h, but {self._axis.path} expects "
                    f"{expected:X}h in "
                    f"drive.identity.{key}; connect the right drive or correct the file"
                )
        return found

    def _check_modes(self) -> tuple[Mode, ...]:
        bits = self._sdo.fetch(objects.SUPPORTED_MODES)
        modes = tuple(mode for mode in Mode if bits & mode.supported_bit)
        if Mode.CSP not in modes:
            raise IdentityError(
                f"{self._name(objects.SUPPORTED_MODES)}: is {bits:08X}h, without cyclic synchronous "
                "position (bit 7); "
                "this drive cannot be used: choose one with that mode, or enable it in the drive"
            )
        return modes

    def _check_scaling(self) -> list[str]:
        """User units per motor turn, by every object that says something about them."""
        counts = self._axis.motor_encoder.counts_per_turn
        increments = self._ratio(objects.ENCODER_INCREMENTS, objects.ENCODER_REVOLUTIONS)
        feed = self._ratio(objects.FEED, objects.FEED_SHAFT)
        gear = self._ratio(objects.GEAR_MOTOR, objects.GEAR_SHAFT) or Fraction(1)
        if gear not in (1, Fraction(self._axis.gear.ratio)):
            raise IdentityError(
                f"{self._name(objects.GEAR_MOTOR)}: the drive knows a gear of {float(gear):g}, but "
                "gear.ratio in "
                f"{self._axis.path} is {self._axis.gear.ratio:g}; correct the one that is wrong"
            )
        for value, objects_used in (
            (increments, "608Fh:01 / 608Fh:02 (encoder resolution)"),
            (None if feed is None else feed / gear, "6092h (feed) over 6091h (gear ratio)"),
        ):
            if value is not None and value != counts:
                raise IdentityError(
                    f"node {self._sdo.node_id}, {objects_used}: the drive counts {float(value):g} per "
                    "motor turn, but "
                    f"motor_encoder.counts_per_turn in {self._axis.path} is {counts}; set the drive's "
                    "scaling to "
                    "plain encoder counts, or correct the file"
                )
        if feed is None and gear != 1:
            raise IdentityError(
                f"{self._name(objects.GEAR_MOTOR)}: the drive divides positions by a gear ratio of "
                f"{float(gear):g}; "
                f"set 6091h to 1:1, gear.ratio in {self._axis.path} is the only one"
            )
        if self._sdo.has(objects.POLARITY.index):
            polarity = self._sdo.fetch(objects.POLARITY)
            if polarity & 0x80:
                raise IdentityError(
                    f"{self._name(objects.POLARITY)}: is {polarity:02X}h, the drive reverses positions "
                    "itself; "
                    f"set it to 0 and use motor_encoder.direction in {self._axis.path}"
                )
        self._check_load_resolution()
        return self._compare_rated_torque()

    def _check_load_resolution(self) -> None:
        """60E6h and 60EBh say how an encoder at 60E4h counts, per turn of the load or of the motor."""
        source, counts = self._axis.load_encoder.source, self._axis.load_encoder.counts_per_turn
        if source.node is not None or source.index != objects.ADDITIONAL_POSITIONS:
            return
        found = self._ratio(*objects.additional_resolution(source.subindex))
        if found is not None and found not in (counts, Fraction(counts) / Fraction(self._axis.gear.ratio)):
            raise IdentityError(
                f"node {self._sdo.node_id}, 60E6h:{source.subindex:02X} / 60EBh:{source.subindex:02X} "
                "(additional "
                f"encoder resolution): the drive counts {float(found):g} per turn, but "
                f"load_encoder.counts_per_turn in {self._axis.path} is {counts}; correct the one that is "
                "wrong"
            )

    def _compare_rated_torque(self) -> list[str]:
        if not self._sdo.has(objects.RATED_TORQUE.index):
            return []
        drive_nm = self._sdo.fetch(objects.RATED_TORQUE) / 1000.0
        file_nm = self._axis.drive.rated_torque_nm
        if abs(drive_nm - file_nm) <= _RATED_TORQUE_TOLERANCE * file_nm:
            return []
        return [
            f"{self._name(objects.RATED_TORQUE)}: the drive says {drive_nm:g} Nm, drive.rated_torque_nm is "
            f"{file_nm:g}; torques are reported with the latter"
        ]

    def _ratio(self, numerator: Address, denominator: Address) -> Fraction | None:
        """A ratio of two objects, None where the drive has none; refused when one of them is 0."""
        if not self._sdo.has(numerator.index, numerator.sub):
            return None
        above = self._sdo.fetch(numerator)
        below = self._sdo.fetch(denominator) if self._sdo.has(denominator.index, denominator.sub) else 1
        if above == 0 or below == 0:
            raise IdentityError(
                f"{self._name(numerator)} is {above}, over {below}: not a ratio; set the drive's scaling "
                "first"
            )
        return Fraction(above, below)

    def _names(self) -> dict[str, str]:
        names = {}
        for index, key in ((0x1008, "device"), (0x1009, "hardware"), (0x100A, "software")):
            if self._sdo.has(index):
                try:
                    names[key] = self._sdo.read_text(index)
                except SdoError:
                    continue  # a name is only for people
        return names

    # -- what is done to it -------------------------------------------------------------------------------

    def _power_off(self) -> None:
        """A drive that an earlier master left with power on is switched off before anything is changed."""
        off = (State.SWITCH_ON_DISABLED, State.FAULT, State.NOT_READY_TO_SWITCH_ON)
        state = decode(self._sdo.fetch(objects.STATUSWORD))
        if state in off:
            return
        self._sdo.store(objects.CONTROLWORD, 0)
        deadline_s = self._link.now() + STATE_TIMEOUT_S
        while state not in off:
            if self._link.now() >= deadline_s:
                raise DriveError(
                    f"{self._name(objects.STATUSWORD)}: the drive stays in '{state.value}' after 'disable "
                    "voltage'; "
                    "switch it off by its enable input and look at its error display"
                )
            self._pause(_POLL_S)
            state = decode(self._sdo.fetch(objects.STATUSWORD))

    def _pause(self, duration_s: float) -> None:
        deadline_s = self._link.now() + duration_s
        while self._receive_until(deadline_s):
            pass

    def _write(self, row: PlannedWrite) -> None:
        """Write one object and compare what the drive then holds."""
        sdo = self._clients[row.node_id]
        at = f"; {row.field} in {self._axis.path} decides it" if row.field else ""
        value = row.value
        try:
            if row.kept:
                value |= sdo.read(row.index, row.sub, row.type) & row.kept & ~row.value
            sdo.write(row.index, row.sub, value, row.type)
            found = sdo.read(row.index, row.sub, row.type)
        except SdoError as error:
            raise SdoError(f"{error} (to write {row.value}: {row.why}){at}") from error
        if found & row.compared != value & row.compared:
            raise DriveError(
                f"{sdo.describe(row.index, row.sub)}: was written {value} ({row.why}), but reads back "
                f"{found}; "
                f"the drive does not take this value{at}"
            )

    def _name(self, address: Address) -> str:
        return self._sdo.describe(address.index, address.sub)
