"""What the service manager is told, by the protocol of sd_notify(3): lines in a datagram."""

from __future__ import annotations

import os
import socket
from collections.abc import MutableMapping
from contextlib import suppress
from typing import Self


class Notifier:
    """Tells the service manager; nobody, where there is none. It never fails and never waits."""

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
        self._tell("READY=1")

    def alive(self) -> None:
        """What is watched goes on."""
        if self.watchdog_s is not None:
            self._tell("WATCHDOG=1")

    def stopping(self) -> None:
        """It ends."""
        self._tell("STOPPING=1")

    def status(self, words: str) -> None:
        """A line for ``systemctl status``; told when it changes."""
        if words != self._status:
            self._status = words
            self._tell(f"STATUS={words}")

    def _tell(self, line: str) -> None:
        if self._address is None:
            return
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            # The axis is worth more than who watches it: a manager that does not listen is not waited for.
            sender.sendto(line.encode(), socket.MSG_DONTWAIT, self._address)
