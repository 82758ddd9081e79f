"""What can go wrong with a drive, on purpose: for tests of a master.

``node.faults`` is the only door. Each wish is counted down or switched off by itself or by the caller; with
no wish pending the cyclic path pays one attribute look-up.
"""

from __future__ import annotations

from dataclasses import dataclass, field

Outgoing = tuple[int, bytes]
"""CAN identifier and data of a TPDO that is about to be sent."""


@dataclass
class Faults:
    """Wishes, all off at first.

    ``drop_tpdos`` the next n TPDOs are lost. ``shorten_tpdos`` the next n come without their last byte.
    ``duplicate_tpdos`` the next n come twice. ``hold_tpdos`` the next n come one SYNC late, after the fresh
    ones.
    ``mute_heartbeat`` the heartbeat stops, the rest goes on. ``silent`` the node is as good as unplugged: it
    hears nothing and says nothing; its own watchdogs stop the axis. ``load_jump_counts`` is added to the load
    encoder from the next sample on.
    """

    drop_tpdos: int = 0
    shorten_tpdos: int = 0
    duplicate_tpdos: int = 0
    hold_tpdos: int = 0
    mute_heartbeat: bool = False
    silent: bool = False
    load_jump_counts: int = 0
    _held: list[Outgoing] = field(default_factory=list)
    _errors: list[tuple[int, bytes]] = field(default_factory=list)
    _boot_ups: int = 0

    def raise_error(self, code: int, additional: bytes = b"") -> None:
        """At the next poll: malfunction ``code`` (EMCY, fault reaction), with up to five bytes of detail."""
        self._errors.append((code, additional))

    def boot_up(self) -> None:
        """At the next poll: reset as after a brown-out, with a boot-up message, whatever the axis does."""
        self._boot_ups += 1

    def take_errors(self) -> list[tuple[int, bytes]]:
        """For the node: the errors to raise now."""
        errors, self._errors = self._errors, []
        return errors

    def take_boot_up(self) -> bool:
        """For the node: whether to reset now."""
        wanted, self._boot_ups = self._boot_ups > 0, 0
        return wanted

    @property
    def concerns_poll(self) -> bool:
        """For the node: whether something is to be done at this poll."""
        return bool(self._errors) or self._boot_ups > 0

    @property
    def concerns_tpdos(self) -> bool:
        """For the node: whether TPDOs go through ``spoil``."""
        return bool(
            self._held or self.drop_tpdos or self.shorten_tpdos or self.duplicate_tpdos or self.hold_tpdos
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
        return sent + late
