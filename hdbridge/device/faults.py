"""Fault injection in the simulated drive, for tests of a master.

``node.faults`` is the only access. Counted faults end automatically; the caller switches the others off.
Without a pending fault, the cost to the cyclic path is one attribute look-up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hdbridge.device.node import DriveNode

Outgoing = tuple[int, bytes]
"""CAN identifier and data of a TPDO that is about to be sent."""


@dataclass
class Faults:
    """Faults to inject, all off initially."""

    drop_tpdos: int = 0
    """The next n TPDOs are lost."""
    shorten_tpdos: int = 0
    """The next n TPDOs lose their last byte."""
    duplicate_tpdos: int = 0
    """The next n TPDOs are sent twice."""
    hold_tpdos: int = 0
    """The next n TPDOs are delayed by one SYNC and sent after the TPDOs of that SYNC."""
    reverse_tpdos: int = 0
    """The TPDOs of the next n SYNCs are sent in reverse order."""
    mute_heartbeat: bool = False
    """The heartbeat stops; everything else continues."""
    silent: bool = False
    """The drive neither receives nor sends, as if unplugged; its own watchdogs stop the axis."""
    deaf: bool = False
    """The drive receives nothing but continues to send, as if its master hung."""
    muted_ids: frozenset[int] = frozenset()
    """Identifiers of frames that are not sent, for example those of one TPDO or of the SDO answers."""
    load_jump_counts: int = 0
    """Counts added to the load encoder from the next sample on."""
    motor_jump_counts: int = 0
    """Counts added to the motor encoder from the next sample on; the servo loops act on them."""
    load_reading: Callable[[int], int] | None = None
    """Maps the counts of the load encoder to its reading from the next sample on: drift, freeze, noise."""
    ignore_lost_heartbeat: bool = False
    """The drive does not notice that the master's heartbeat is missing."""
    only_report_lost_heartbeat: bool = False
    """The drive sends the EMCY of a lost heartbeat and continues."""
    stay_operational: bool = False
    """A lost heartbeat does not take the node out of OPERATIONAL, regardless of 1029h."""
    ignore_missing_set_points: bool = False
    """The drive does not notice that RPDOs are missing."""
    deceleration_counts_s2: float | None = None
    """Deceleration of every ramp, overriding the objects; counts/s2."""
    pending: list[Callable[[DriveNode], None]] = field(default_factory=list)
    """Events that the node runs at the next poll."""
    _held: list[Outgoing] = field(default_factory=list)

    def raise_error(self, code: int, additional: bytes = b"") -> None:
        """Raises error ``code`` at the next poll (EMCY, fault reaction), with up to five bytes of detail."""
        self.pending.append(lambda node: node.firmware.fault(code, additional))

    def lose_master(self, code: int) -> None:
        """Makes the drive lose its master at the next poll, without an EMCY, with the reaction of 6007h."""
        self.pending.append(lambda node: node.firmware.connection_lost(code))

    def miss_master(self, code: int) -> None:
        """Makes the drive lose its master at the next poll, with the EMCY ``code`` (8130h or 8250h)."""
        self.pending.append(lambda node: node.emergency.occur(code))
        self.lose_master(code)

    def boot_up(self) -> None:
        """Resets the node at the next poll, with a boot-up message, as after a brown-out in any state."""
        self.pending.append(lambda node: node.reset())

    def leave_operational(self) -> None:
        """Takes the node to PRE-OPERATIONAL at the next poll, with a heartbeat, in any state of the axis."""
        self.pending.append(lambda node: node.drop_out())

    def open_enable_input(self) -> None:
        """Switches the power stage off at the next poll, without an EMCY, as a hardware enable input does."""
        self.pending.append(lambda node: node.firmware.power_cut())

    @property
    def concerns_tpdos(self) -> bool:
        """True if the node must pass its TPDOs through ``spoil``."""
        counted = self.drop_tpdos + self.shorten_tpdos + self.duplicate_tpdos + self.hold_tpdos
        return bool(counted or self.reverse_tpdos or self._held)

    def spoil(self, tpdos: list[Outgoing]) -> list[Outgoing]:
        """Applies the faults to ``tpdos``, the TPDOs of one SYNC, and returns the frames to send."""
        late, self._held = self._held, []
        sent: list[Outgoing] = []
        for can_id, data in tpdos:
            if self.drop_tpdos > 0:
                self.drop_tpdos -= 1
            elif self.hold_tpdos > 0:
                self.hold_tpdos -= 1
                self._held.append((can_id, data))
            elif self.shorten_tpdos > 0:
                self.shorten_tpdos -= 1
                sent.append((can_id, data[:-1]))
            elif self.duplicate_tpdos > 0:
                self.duplicate_tpdos -= 1
                sent += [(can_id, data), (can_id, data)]
            else:
                sent.append((can_id, data))
        if self.reverse_tpdos > 0:
            self.reverse_tpdos -= 1
            sent.reverse()
        return sent + late
