"""What can go wrong with a drive, on purpose: for tests of a master.

``node.faults`` is the only door. Each wish is counted down or switched off by itself or by the caller; with
no wish pending the cyclic path pays one attribute look-up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

Outgoing = tuple[int, bytes]
"""CAN identifier and data of a TPDO that is about to be sent."""


@dataclass
class Faults:
    """Wishes, all off at first."""

    drop_tpdos: int = 0
    """The next n TPDOs are lost."""
    shorten_tpdos: int = 0
    """The next n come without their last byte."""
    duplicate_tpdos: int = 0
    """The next n come twice."""
    hold_tpdos: int = 0
    """The next n come delayed by one SYNC, after the fresh ones."""
    reverse_tpdos: int = 0
    """Those of the next n SYNCs come in reverse order."""
    mute_heartbeat: bool = False
    """The heartbeat stops, the rest goes on."""
    silent: bool = False
    """As good as unplugged: it hears nothing and says nothing; its own watchdogs stop the axis."""
    deaf: bool = False
    """It hears nothing and goes on speaking: as if its master hung."""
    muted_ids: frozenset[int] = frozenset()
    """Frames with these identifiers are not sent: one TPDO, the answers to SDO requests."""
    load_jump_counts: int = 0
    """Added to the load encoder from the next sample on."""
    motor_jump_counts: int = 0
    """Added to the motor encoder from the next sample on; the servo loops act on it."""
    load_reading: Callable[[int], int] | None = None
    """What the load encoder makes of its counts from the next sample on: a drift, a freeze, noise."""
    ignore_lost_heartbeat: bool = False
    """It does not notice that the master's heartbeat stays away."""
    only_report_lost_heartbeat: bool = False
    """It sends its EMCY for that and goes on."""
    stay_operational: bool = False
    """A lost heartbeat does not take it out of OPERATIONAL, whatever 1029h says."""
    ignore_missing_set_points: bool = False
    """It does not notice that RPDOs stay away."""
    deceleration_counts_s2: float | None = None
    """How it brakes, whatever its objects say."""
    concerns_poll: bool = False
    """For the node: whether something is to be done at this poll."""
    _held: list[Outgoing] = field(default_factory=list)
    _errors: list[tuple[int, bytes]] = field(default_factory=list)
    _lost_masters: list[int] = field(default_factory=list)
    _missed_masters: list[int] = field(default_factory=list)
    _boot_ups: int = 0
    _departures: int = 0
    _openings: int = 0

    def raise_error(self, code: int, additional: bytes = b"") -> None:
        """At the next poll: malfunction ``code`` (EMCY, fault reaction), with up to five bytes of detail."""
        self._errors.append((code, additional))
        self.concerns_poll = True

    def lose_master(self, code: int) -> None:
        """At the next poll: react as 6007h says to the loss of the master, without a word of it."""
        self._lost_masters.append(code)
        self.concerns_poll = True

    def miss_master(self, code: int) -> None:
        """At the next poll: the same, with the EMCY ``code`` (8130h or 8250h)."""
        self._missed_masters.append(code)
        self.concerns_poll = True

    def boot_up(self) -> None:
        """At the next poll: reset as after a brown-out, with a boot-up message, whatever the axis does."""
        self._boot_ups += 1
        self.concerns_poll = True

    def leave_operational(self) -> None:
        """At the next poll: into PRE-OPERATIONAL, whatever the axis does, with a heartbeat that says so."""
        self._departures += 1
        self.concerns_poll = True

    def open_enable_input(self) -> None:
        """At the next poll: the power stage goes off without a word, as by a hardware enable input."""
        self._openings += 1
        self.concerns_poll = True

    def take_errors(self) -> list[tuple[int, bytes]]:
        """For the node: the errors to raise now."""
        errors, self._errors = self._errors, []
        return errors

    def take_lost_masters(self) -> list[int]:
        """For the node: with which codes to lose its master now."""
        codes, self._lost_masters = self._lost_masters, []
        return codes

    def take_missed_masters(self) -> list[int]:
        """For the node: with which codes to miss its master now."""
        codes, self._missed_masters = self._missed_masters, []
        return codes

    def take_boot_up(self) -> bool:
        """For the node: whether to reset now."""
        wanted, self._boot_ups = self._boot_ups > 0, 0
        return wanted

    def take_departure(self) -> bool:
        """For the node: whether to leave OPERATIONAL now."""
        wanted, self._departures = self._departures > 0, 0
        return wanted

    def take_opening(self) -> bool:
        """For the node: whether the enable input opens now."""
        wanted, self._openings = self._openings > 0, 0
        return wanted

    @property
    def concerns_tpdos(self) -> bool:
        """For the node: whether TPDOs go through ``spoil``."""
        return bool(
            self._held
            or self.drop_tpdos
            or self.shorten_tpdos
            or self.duplicate_tpdos
            or self.hold_tpdos
            or self.reverse_tpdos
        )

    def spoil(self, tpdos: list[Outgoing]) -> list[Outgoing]:
        """What really goes out in place of ``tpdos``, the TPDOs of one SYNC."""
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
