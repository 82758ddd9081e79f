"""What the service manager is told, by the protocol of sd_notify(3): lines in a datagram."""

from __future__ import annotations

import os
import socket
from collections.abc import MutableMapping
from contextlib import suppress
from typing import Final, Self

PATIENCE_S: Final = 1.0
"""How long a manager is waited for that has ten messages to read yet, when it must not miss this one."""


class Notifier:
    """Tells the service manager; nobody, where there is none. It never fails."""

    def __init__(self, address: str | None = None, watchdog_s: float | None = None) -> None:
        """``address`` is that of the manager's socket; one that begins with @ is an abstract one."""
        self.watchdog_s = watchdog_s
        """How long the manager waits for `alive`; None where it does not watch."""
        self._address = "\0" + address[1:] if address and address.startswith("@") else address
        self._status = ""

    @classmethod
    def of_environment(cls, environment: MutableMapping[str, str] = os.environ) -> Self:
        """The one that the environment names, which is taken out of it: children are not to speak."""
        address = environment.pop("NOTIFY_SOCKET", None)
        period_us = environment.pop("WATCHDOG_USEC", "")
        meant = environment.pop("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        return cls(address, int(period_us) / 1e6 if period_us.isdigit() and meant else None)

    def ready(self) -> None:
        """All that was started works."""
        self._tell("READY=1", PATIENCE_S)

    def alive(self) -> None:
        """What is watched goes on."""
        if self.watchdog_s is not None:
            self._tell("WATCHDOG=1")

    def stopping(self) -> None:
        """It ends."""
        self._tell("STOPPING=1", PATIENCE_S)

    def status(self, words: str) -> None:
        """A line for ``systemctl status``; told when it changes."""
        if words != self._status and self._tell(f"STATUS={words}"):
            self._status = words

    def _tell(self, line: str, patience_s: float = 0.0) -> bool:
        """Whether the manager has taken it. The axis is worth more than who watches it: who does not listen
        is not waited for longer.
        """
        if self._address is None:
            return True
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.settimeout(patience_s)
            sender.sendto(line.encode(), self._address)
            return True
        return False
