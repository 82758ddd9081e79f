"""Boot-up: takes an unknown node to a verified, configured drive in OPERATIONAL, with power off.

Nothing is assumed. Identity and scaling are compared with the axis file. Every object is read before it is
written, and read back afterwards. The first mismatch ends the boot-up with an error that names the object,
unless the object may be left to the drive.
"""

import logging
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import groupby
from typing import Final

from hdbridge.axis import AxisConfig
from hdbridge.cia301 import NmtCommand, NmtState
from hdbridge.drive import objects
from hdbridge.drive.bootplan import plan
from hdbridge.drive.dictionary import find
from hdbridge.drive.image import drive_heartbeat_ms
from hdbridge.drive.link import Link
from hdbridge.drive.masterdetection import heartbeat_of
from hdbridge.drive.monitor import NetworkMonitor
from hdbridge.drive.nameplate import (
    IDENTITY,
    device_type_complaints,
    identity_complaints,
    mode_complaints,
    scaling_addresses,
    scaling_complaints,
    torque_notes,
)
from hdbridge.drive.objects import Mode
from hdbridge.drive.sdo import SdoAbortError, SdoClient
from hdbridge.drive.states import OFF, State, decode
from hdbridge.drive.writes import PlannedWrite
from hdbridge.errors import DriveError, IdentityError, SdoError

_log = logging.getLogger(__name__)
BOOT_UP_TIMEOUT_S: Final = 2.0
"""Maximum wait for the boot-up message after a reset, s; then the node is queried directly."""
SDO_AFTER_BOOT_UP_S: Final = 3.5
"""Maximum time from the boot-up message to the first SDO answer of a node; s."""
STATE_TIMEOUT_S: Final = 1.0
_POLL_S: Final = 0.02
_WRITE_ONLY: Final = 0x0601_0001
_READ_ONLY: Final = 0x0601_0002
_MAPPINGS: Final = (0x1600, 0x1A00)
_MAPPINGS_PER_KIND: Final = 0x200


@dataclass(frozen=True, slots=True)
class BootReport:
    """Result of a boot-up: values found and written."""

    node_id: int
    identity: dict[str, int]
    names: dict[str, str]
    """Device name and versions (1008h, 1009h, 100Ah), if the drive provides them."""
    modes: tuple[Mode, ...]
    """Modes used by hdbridge that the drive supports; all of these modes if the drive does not report
    6502h."""
    state: State
    held: tuple[PlannedWrite, ...] = ()
    """Planned values that the drive now holds."""
    written: tuple[PlannedWrite, ...] = ()
    """The subset of ``held`` that had to be written."""
    left: frozenset[tuple[int, int]] = frozenset()
    """Index and sub-index of each object that the drive refused to change and was allowed to keep."""
    notes: tuple[str, ...] = field(default=())
    """Remarks for the user that do not justify refusing the drive."""


class BootUp:
    """Boots one drive.

    ``clients`` maps node ids to SDO clients: the drive's, and that of a separate load encoder.
    ``others_heard`` are the ids of other nodes that have already been heard on the bus.
    """

    def __init__(
        self,
        link: Link,
        monitor: NetworkMonitor,
        axis: AxisConfig,
        clients: dict[int, SdoClient],
        others_heard: Iterable[int] = (),
    ) -> None:
        self._link = link
        self._monitor = monitor
        self._axis = axis
        self._clients = clients
        self._sdo = clients[axis.drive.node_id]
        self._others_heard = set(others_heard)
        self._held: list[PlannedWrite] = []
        self._written: list[PlannedWrite] = []
        self._left: set[tuple[int, int]] = set()
        self._notes: list[str] = []

    def run(self, *, reset: bool) -> BootReport:
        """Runs all steps in order.

        Raises `DriveError` or a subclass at the first mismatch, and `InputError` before anything is sent if
        the EDS lacks an indispensable object.
        """
        planned = plan(self._axis, self._sdo.od)
        for node_id in self._clients:
            self._reach(node_id, reset=reset)
        self._check_device_type()
        identity = self._check_identity()
        modes = self._check_modes()
        self._power_off()
        self._check_scaling()
        for pdo, rows in groupby(planned, lambda row: (row.node_id, row.pdo)):
            if pdo[1]:
                self._configure(list(rows))
            else:
                for row in rows:
                    self._settle(row)
        for node_id in self._clients:
            self._start(node_id)
        return self._report(identity, modes)

    def look(self) -> BootReport:
        """Compares a running drive with its axis file, without writing or changing a state.

        Raises like `run`.
        """
        self._check_device_type()
        identity = self._check_identity()
        modes = self._check_modes()
        self._check_scaling()
        return self._report(identity, modes)

    def _report(self, identity: dict[str, int], modes: tuple[Mode, ...]) -> BootReport:
        return BootReport(
            node_id=self._axis.drive.node_id,
            identity=identity,
            names=read_names(self._sdo),
            modes=modes,
            state=decode(self._sdo.fetch(objects.STATUSWORD)),
            held=tuple(self._held),
            written=tuple(self._written),
            left=frozenset(self._left),
            notes=tuple(self._notes),
        )

    # -- network management -------------------------------------------------------------------------------

    def _nmt(self, command: NmtCommand, node_id: int) -> None:
        _log.info("nmt", {"command": command.name, "node": node_id})
        self._link.send(objects.COB_NMT, bytes((command, node_id)))

    def _receive_until(self, deadline_s: float) -> bool:
        frame = self._link.recv(deadline_s)
        if frame is None:
            return False
        self._monitor.dispatch(frame)
        if (node_id := heartbeat_of(frame)) is not None and node_id not in self._clients:
            self._others_heard.add(node_id)
        return frame.time_s <= deadline_s

    def _reach(self, node_id: int, *, reset: bool) -> None:
        """Brings a node into PRE-OPERATIONAL and verifies that it answers."""
        status = self._monitor.watch(node_id)
        since = status.counts
        if reset:
            before = status.boot_ups
            self._nmt(NmtCommand.RESET_COMMUNICATION, node_id)
            deadline_s = self._link.now() + BOOT_UP_TIMEOUT_S
            while status.boot_ups == before and self._receive_until(deadline_s):
                pass
        self._nmt(NmtCommand.PRE_OPERATIONAL, node_id)
        own = node_id == self._axis.drive.node_id
        where = self._axis.where("drive.node_id" if own else "load_encoder.source.node")
        await_sdo(self._link, self._monitor, self._clients[node_id], where, since, self._others_heard)

    def _start(self, node_id: int) -> None:
        status = self._monitor.watch(node_id)
        self._monitor.started(node_id)
        self._nmt(NmtCommand.START, node_id)
        if node_id == self._axis.drive.node_id and not drive_heartbeat_ms(self._axis, self._sdo.od):
            return  # Without a heartbeat, only the TPDOs that follow show that it has started.
        deadline_s = self._link.now() + STATE_TIMEOUT_S + 2e-3 * self._axis.drive.heartbeat_ms
        while status.nmt_state != NmtState.OPERATIONAL and self._receive_until(deadline_s):
            pass
        if status.nmt_state != NmtState.OPERATIONAL:
            said = "no heartbeat came" if status.nmt_state is None else f"it says {status.nmt_state:02X}h"
            raise DriveError(
                f"node {node_id} on {self._link.name} did not become OPERATIONAL ({said}, expected 05h); "
                f"look at its error display and at {self._axis.where('drive.heartbeat_ms')}"
            )

    # -- verification -------------------------------------------------------------------------------------

    def _refuse(self, complaints: Iterable[str]) -> None:
        if first := next(iter(complaints), ""):
            raise IdentityError(first)

    def _check_device_type(self) -> None:
        self._refuse(device_type_complaints(self._axis, self._sdo.fetch(objects.DEVICE_TYPE)))

    def _check_identity(self) -> dict[str, int]:
        found = read_identity(self._axis, self._sdo)
        self._refuse(identity_complaints(self._axis, found))
        return found

    def _check_modes(self) -> tuple[Mode, ...]:
        if not self._sdo.has(objects.SUPPORTED_MODES.index, objects.SUPPORTED_MODES.sub):
            return tuple(Mode)
        bits = self._sdo.fetch(objects.SUPPORTED_MODES)
        self._refuse(mode_complaints(self._axis, bits))
        return tuple(mode for mode in Mode if not bits or bits & mode.supported_bit)

    def _check_scaling(self) -> None:
        """Compares counts per motor turn, from every object that defines them, with the axis file."""
        self._refuse(scaling_complaints(self._axis, self._sdo.fetch_listed(scaling_addresses(self._axis))))
        rated = self._sdo.fetch_listed((objects.RATED_TORQUE,))
        self._notes += torque_notes(self._axis, rated.get(objects.RATED_TORQUE))

    # -- configuration ------------------------------------------------------------------------------------

    def _power_off(self) -> None:
        """Switches off a drive that an earlier master left powered, before any change."""
        state = decode(self._sdo.fetch(objects.STATUSWORD))
        if state in OFF:
            return
        self._sdo.store(objects.CONTROLWORD, 0)
        deadline_s = self._link.now() + STATE_TIMEOUT_S
        while state not in OFF:
            if self._link.now() >= deadline_s:
                raise DriveError(
                    f"{self._sdo.describe(0x6041, 0)}: the drive stays in '{state.value}' after 'disable "
                    "voltage'; switch it off by its enable input and look at its error display"
                )
            again_s = self._link.now() + _POLL_S
            while self._receive_until(again_s):
                pass
            state = decode(self._sdo.fetch(objects.STATUSWORD))

    def _configure(self, rows: list[PlannedWrite]) -> None:
        """Configures a PDO unless it is as planned, because a correct configuration may be read-only."""
        lasting = [row for row in rows if not row.passing]
        wrong = [row for row in lasting if not self._is_held(row)]
        if not wrong:
            self._held += lasting
            return
        remap = any(map(_maps, wrong))
        off = rows[0]
        cob_id = find(self._sdo.od, off.index, off.sub) if off.node_id == self._sdo.node_id else None
        for row in rows:
            fixed = row is off and cob_id is not None and not cob_id.writable
            if fixed or (row.passing and _maps(row) and not remap):
                continue
            self._settle(row)

    def _is_held(self, row: PlannedWrite) -> bool:
        """Returns True if the drive already holds the value; False for a write-only object."""
        try:
            found = self._read(row)
        except SdoError as error:
            raise self._refused(row, error) from error
        return found is not None and row.holds(found)

    def _read(self, row: PlannedWrite) -> int | None:
        """Returns the object's current value; None for a write-only object."""
        sdo = self._clients[row.node_id]
        variable = find(sdo.od, row.index, row.sub)
        if variable is not None and not variable.readable:
            return None
        try:
            return sdo.read(row.index, row.sub, row.type)
        except SdoAbortError as error:
            if error.code == _WRITE_ONLY:
                return None
            raise

    def _settle(self, row: PlannedWrite) -> None:
        """Makes an object hold its value: reads it, writes it if different, reads it back."""
        if not self._is_held(row):
            try:
                self._write(row)
            except DriveError as error:
                if not self._may_keep(row, error):
                    raise
                self._left.add((row.index, row.sub))
                self._notes.append(f"left to the drive ({row.without}): {error}")
                return
            if not row.passing:
                self._written.append(row)
        if not row.passing:
            self._held.append(row)

    def _may_keep(self, row: PlannedWrite, error: DriveError) -> bool:
        """Returns True if the drive may keep its value: the user stated no other, or it is read-only."""
        if not row.without or row.exact:
            return False
        cause = error.__cause__
        if isinstance(cause, SdoError) and not isinstance(cause, SdoAbortError):
            return False  # no answer
        read_only = isinstance(cause, SdoAbortError) and cause.code == _READ_ONLY
        return read_only or not self._axis.states(row.field)

    def _write(self, row: PlannedWrite) -> None:
        """Writes one object, reads it back and compares the two values."""
        sdo = self._clients[row.node_id]
        value = row.value
        try:
            if row.kept:
                value |= (self._read(row) or 0) & row.kept & ~row.value
            sdo.write(row.index, row.sub, value, row.type)
            found = self._read(row)
        except SdoError as error:
            raise self._refused(row, error) from error
        if found is not None and not row.holds(found):
            raise DriveError(
                f"{sdo.describe(row.index, row.sub)}: was written {value} ({row.why}), but reads back "
                f"{found}; the drive does not accept this value{self._decides(row)}"
            )

    def _refused(self, row: PlannedWrite, error: SdoError) -> SdoError:
        return SdoError(f"{error} (to write {row.value}: {row.why}){self._decides(row)}")

    def _decides(self, row: PlannedWrite) -> str:
        return f"; {self._axis.where(row.field)} decides it" if row.field else ""


def read_identity(axis: AxisConfig, sdo: SdoClient) -> dict[str, int]:
    """Reads the identity objects that the EDS lists or the axis file states, by key of ``drive.identity``."""
    return {
        name: sdo.fetch(address)
        for address, name in IDENTITY
        if sdo.has(address.index, address.sub) or getattr(axis.drive.identity, name) is not None
    }


def read_names(sdo: SdoClient) -> dict[str, str]:
    """Reads device name and versions, for display; omits those that the EDS or the node lacks."""
    names = {}
    for index, key in ((0x1008, "device"), (0x1009, "hardware"), (0x100A, "software")):
        if sdo.has(index) or not sdo.od:
            with suppress(SdoError):
                names[key] = sdo.read_text(index)
    return names


def _maps(row: PlannedWrite) -> bool:
    """Returns True for a mapping parameter of a PDO."""
    return any(base <= row.index < base + _MAPPINGS_PER_KIND for base in _MAPPINGS)


def await_sdo(
    link: Link,
    monitor: NetworkMonitor,
    client: SdoClient,
    where: str,
    since: tuple[int, int, int] = (0, 0, 0),
    others_heard: Iterable[int] = (),
) -> int:
    """Waits for the first SDO answer of a node and returns its device type (1000h).

    A node may answer only seconds after its boot-up message. Raises `DriveError` if it does not answer; the
    error text lists the messages received from the node since its status had the counts ``since``. ``where``
    is the key of the axis file that defines the node. An abort counts as an answer (`SdoAbortError`).
    """
    status = monitor.watch(client.node_id)
    while True:
        try:
            return client.fetch(objects.DEVICE_TYPE)
        except SdoAbortError:
            raise  # an abort is an answer, so the node is there
        except SdoError as error:
            booted_s = status.boot_up_s
            booted = status.boot_ups > since[0]
            if booted and booted_s is not None and link.now() < booted_s + SDO_AFTER_BOOT_UP_S:
                continue
            others = ", ".join(map(str, sorted(set(others_heard) - {client.node_id})))
            if said := status.heard_since(since):
                heard = f"heard of it: {said}"
                todo = "its SDO server is not up: switch it off and on, and look at its error display"
            else:
                heard = f"heard: node {others}" if others else "no other node was heard either"
                todo = f"check power, cable, termination, bit rate and {where}"
            raise DriveError(
                f"node {client.node_id} on {link.name} does not answer ({heard}); {todo}"
            ) from error
