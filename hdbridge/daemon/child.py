"""A process that the keeper has started: a fresh interpreter that inherits what it is handed, and no more."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress


class Child:
    """One process, from its start to its end."""

    def __init__(self, program: Sequence[str], start_fd: int, handed: Sequence[int], now_s: float) -> None:
        """Runs ``program`` in this interpreter with the number of ``start_fd`` as its argument.

        ``handed`` are further descriptors that it inherits. It has a session of its own: what the terminal
        sends is the keeper's to deal with.
        """
        self.started_s = now_s
        self._process = subprocess.Popen(
            [sys.executable, "-P", *program, str(start_fd)],
            pass_fds=(start_fd, *handed),
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
        self.pid = self._process.pid
        self.pidfd = os.pidfd_open(self.pid)
        """Becomes readable when the process has ended."""

    @property
    def ended(self) -> int | None:
        """Its exit status, negative where a signal ended it; None while it runs."""
        return self._process.poll()

    @property
    def how(self) -> str:
        """How it ended, in words."""
        status = self.ended
        if status is None:
            return "runs"
        if status >= 0:
            return f"exit status {status}"
        with suppress(ValueError):
            return f"ended by {signal.Signals(-status).name}"
        return f"ended by signal {-status}"

    def send(self, number: signal.Signals) -> None:
        """Send a signal; nothing where it has ended: nobody else has its number before `ended` was asked."""
        self._process.send_signal(number)

    def close(self) -> None:
        """End it at once where it still runs; the descriptor is closed."""
        if self.ended is None:
            self._process.kill()
            self._process.wait()
        os.close(self.pidfd)
