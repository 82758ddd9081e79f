"""A child process of the keeper: a fresh interpreter that inherits only the given descriptors."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress


class Child:
    """A child process, from its start to its end."""

    def __init__(self, program: Sequence[str], start_fd: int, handed: Sequence[int], now_s: float) -> None:
        """Runs ``program`` in this interpreter, with the number of ``start_fd`` as its argument.

        It also inherits the descriptors in ``handed``. It has its own session, so that signals of the
        terminal reach only the keeper.
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
        """Descriptor that becomes readable when the process has ended."""

    @property
    def ended(self) -> int | None:
        """Exit status, negative after a signal; None while it runs."""
        return self._process.poll()

    @property
    def how(self) -> str:
        """Exit status or signal in words."""
        status = self.ended
        if status is None:
            return "runs"
        if status >= 0:
            return f"exit status {status}"
        with suppress(ValueError):
            return f"ended by {signal.Signals(-status).name}"
        return f"ended by signal {-status}"

    def send(self, number: signal.Signals) -> None:
        """Sends a signal, unless the process has ended; its id cannot be reused before `ended` is called."""
        self._process.send_signal(number)

    def close(self) -> None:
        """Kills the process if it still runs, and closes the descriptor."""
        if self.ended is None:
            self._process.kill()
            self._process.wait()
        os.close(self.pidfd)
