"""The process of one job: ``python -m hdbridge.daemon.service.jobprocess FD``, started by the service.

It runs at low priority, holds one end of a pipe to the service and has no access to the bus. It ends when
the service dies.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from socket import socketpair
from typing import Final

from hdbridge.daemon.service.jobpipe import Begin, PipedRig, Result, telling_failure, told_over
from hdbridge.errors import InputError

NICENESS: Final = 10
END_S: Final = 5.0
"""Time in which a process that has finished must exit; then it is killed."""
_PR_SET_PDEATHSIG: Final = 1


class JobProcess:
    """A running job's process, as the service sees it."""

    def __init__(self, process: subprocess.Popen[bytes], connection: Connection) -> None:
        self._process = process
        self.connection = connection

    def ended(self) -> str:
        """Returns the exit status or signal in words; empty while the process runs."""
        with suppress(subprocess.TimeoutExpired):
            status = self._process.wait(END_S)
            return f" (signal {-status})" if status < 0 else f" (exit status {status})"
        return ""

    def interrupt(self) -> None:
        """Interrupts the process, as Ctrl-C does."""
        self._process.send_signal(signal.SIGINT)


@contextmanager
def job_process(begin: Begin) -> Iterator[JobProcess]:
    """Starts a job's process and ends it with the block."""
    here, there = socketpair()
    with there:
        process = subprocess.Popen(
            [sys.executable, "-m", __spec__.name if __spec__ else __name__, str(there.fileno())],
            pass_fds=[there.fileno()],
            stdin=subprocess.DEVNULL,
        )
    connection = Connection(here.detach())
    try:
        connection.send(begin)
        yield JobProcess(process, connection)
    finally:
        connection.close()
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def main(arguments: list[str]) -> int:
    """Runs the job's process; returns the exit status."""
    from hdbridge.daemon.service.jobwork import run  # noqa: PLC0415 - the service, which starts it, does no job

    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.nice(NICENESS)
    try:
        connection = Connection(int(arguments[0]))
        begin = connection.recv()
    except (IndexError, ValueError, OSError, EOFError):
        raise InputError(
            "this is a process of the daemon and not started by hand: use 'hdbridge run'"
        ) from None
    with connection, telling_failure(connection):
        rig = PipedRig(connection, begin.work.axis, begin.identity)
        connection.send(Result(run(begin.work, rig, told_over(connection, lambda: False))))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
