"""From an unknown node to a drive that is known, configured and OPERATIONAL (but not enabled).

Nothing is believed: the identity is compared, the scaling is compared, and every object that is written is
read back. The first thing that is not as expected ends the boot-up with an error that names the object.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from hdbridge.drive import objects
from hdbridge.drive.link import Link
from hdbridge.drive.manners import heartbeat_of
from hdbridge.drive.monitor import NetworkMonitor
from hdbridge.drive.nameplate import (
    IDENTITY,
    Complaint,
    device_type_complaints,
    identity_complaints,
    mode_complaints,
    scaling_addresses,
    scaling_complaints,
    torque_notes,
)
from hdbridge.drive.objects import Address, Mode, NmtCommand, NmtState
from hdbridge.drive.sdo import SdoAbortError, SdoClient
from hdbridge.drive.states import State, decode
from hdbridge.drive.writes import PlannedWrite, plan
from hdbridge.errors import DriveError, IdentityError, SdoError

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig

_log = logging.getLogger(__name__)
BOOT_UP_TIMEOUT_S: Final = 2.0
"""How long a node may take from a reset to its boot-up message before it is asked directly."""
STATE_TIMEOUT_S: Final = 1.0
_POLL_S: Final = 0.02


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
    """One boot-up. ``clients`` has an SDO client for the drive, and one for a separate load encoder.

    ``others_heard`` are other nodes that have shown themselves before.
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

    def run(self, *, reset: bool) -> BootReport:
        """All of it, in order. Raises `DriveError` (or a kind of it) at the first thing that is wrong.

        `InputError` before anything is sent where the EDS lacks what there is no doing without.
        """
        written = tuple(plan(self._axis, self._sdo.od))
        for node_id in self._clients:
            self._reach(node_id, reset=reset)
        self._check_device_type()
        identity = self._check_identity()
        modes = self._check_modes()
        self._power_off()
        notes = self._check_scaling()
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

    def look(self) -> BootReport:
        """Compare a drive that runs already with its axis file; writes nothing and changes no state.

        Raises as `run` does.
        """
        self._check_device_type()
        identity = self._check_identity()
        modes = self._check_modes()
        notes = self._check_scaling()
        return BootReport(
            node_id=self._axis.drive.node_id,
            identity=identity,
            names=self._names(),
            modes=modes,
            state=decode(self._sdo.fetch(objects.STATUSWORD)),
            written=(),
            notes=tuple(notes),
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
            where = self._axis.where("drive.node_id" if own else "load_encoder.source.node")
            raise DriveError(
                f"node {node_id} on {self._link.name} does not answer"
                + (f" (heard: node {heard})" if heard else " (no other node was heard either)")
                + f"; check power, cable, termination, bit rate and {where}"
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
                f"look at its error display and at {self._axis.where('drive.heartbeat_ms')}"
            )

    # -- what it is ---------------------------------------------------------------------------------------

    def _refuse(self, complaints: list[Complaint]) -> None:
        if complaints:
            raise IdentityError(complaints[0].text)

    def _readings(self, addresses: Iterable[Address]) -> dict[Address, int]:
        """The objects that the EDS lists."""
        return {each: self._sdo.fetch(each) for each in addresses if self._sdo.has(each.index, each.sub)}

    def _check_device_type(self) -> None:
        self._refuse(device_type_complaints(self._axis, self._sdo.fetch(objects.DEVICE_TYPE)))

    def _check_identity(self) -> dict[str, int]:
        found: dict[str, int] = {}
        for address, name in IDENTITY:
            wanted = getattr(self._axis.drive.identity, name)
            if wanted is not None or self._sdo.has(address.index, address.sub):
                found[name] = self._sdo.fetch(address)
        self._refuse(identity_complaints(self._axis, found))
        return found

    def _check_modes(self) -> tuple[Mode, ...]:
        bits = self._sdo.fetch(objects.SUPPORTED_MODES)
        self._refuse(mode_complaints(self._axis, bits))
        return tuple(mode for mode in Mode if bits & mode.supported_bit)

    def _check_scaling(self) -> list[str]:
        """User units per motor turn, by every object that says something about them."""
        self._refuse(scaling_complaints(self._axis, self._readings(scaling_addresses(self._axis))))
        rated = self._readings((objects.RATED_TORQUE,))
        return torque_notes(self._axis, rated.get(objects.RATED_TORQUE))

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
        at = f"; {self._axis.where(row.field)} decides it" if row.field else ""
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
