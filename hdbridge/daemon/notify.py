"""Notifications to the service manager by the protocol of sd_notify(3): lines in a datagram."""

from __future__ import annotations

import os
import socket
from collections.abc import MutableMapping
from contextlib import suppress
from typing import Final, Self

PATIENCE_S: Final = 1.0
"""Maximum wait for a manager whose queue is full, for messages that it must not miss."""


class Notifier:
    """Notifies the service manager, if there is one. It never fails."""

    def __init__(self, address: str | None = None, watchdog_s: float | None = None) -> None:
        """``address`` is the manager's socket; one that begins with @ is abstract."""
        self.watchdog_s = watchdog_s
        """Watchdog time-out of the manager; None without a watchdog."""
        self._address = "\0" + address[1:] if address and address.startswith("@") else address
        self._status = ""

    @classmethod
    def of_environment(cls, environment: MutableMapping[str, str] = os.environ) -> Self:
        """Returns the notifier of the environment, and removes it there so that children do not notify."""
        address = environment.pop("NOTIFY_SOCKET", None)
        period_us = environment.pop("WATCHDOG_USEC", "")
        meant = environment.pop("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        return cls(address, int(period_us) / 1e6 if period_us.isdigit() and meant else None)

    def ready(self) -> None:
        """Reports that the daemon is ready."""
        self._tell("READY=1", PATIENCE_S)

    def alive(self) -> None:
        """Reports a sign of life to the watchdog."""
        if self.watchdog_s is not None:
            self._tell("WATCHDOG=1")

    def stopping(self) -> None:
        """Reports that the daemon is stopping."""
        self._tell("STOPPING=1", PATIENCE_S)

    def status(self, words: str) -> None:
        """Sets the line in ``systemctl status``, if it has changed."""
        if words != self._status and self._tell(f"STATUS={words}"):
            self._status = words

    def _tell(self, line: str, patience_s: float = 0.0) -> bool:
        """Returns True if the manager took the message; waits at most ``patience_s`` for it."""
        if self._address is None:
            return True
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.settimeout(patience_s)
            sender.sendto(line.encode(), self._address)
            return True
        return False
