"""Sets up a daemon: log, interface lock, sockets and shared memory, which outlive its child processes, and
the keeper.
"""

import os
import secrets
import sys
from contextlib import ExitStack

from hdbridge.daemon.api.sockets import file_of, tcp_socket, unix_socket
from hdbridge.daemon.keeper import SIMULATED, Keeper, Notifier, Times
from hdbridge.daemon.logs import LogSettings, begin_log
from hdbridge.daemon.machine import Machine
from hdbridge.daemon.memory import Memory
from hdbridge.daemon.start import Simulation, Start, runtime_folder
from hdbridge.drive.interfacelock import InterfaceLock


def hold(
    machine: Machine,
    simulation: Simulation | None = None,
    *,
    force: bool = False,
    page: int | None = None,
    log: LogSettings | None = None,
) -> int:
    """Runs the daemon of a machine in this process until a signal ends it; returns the exit status.

    ``page`` is a loopback port for the live page (0: any free one). Its address is printed to standard error,
    with a token for this run; a machine with ``api.tcp`` has its page there instead. ``force`` starts even if
    another process controls the interface or another master is active on the bus. Raises InputError, BusError
    or DaemonError if it cannot start, before anything is sent on the bus.
    """
    log = log or LogSettings()
    begin_log(log)
    folder = runtime_folder()
    with ExitStack() as stack:
        lock = None
        if simulation is None and not force:
            lock = stack.enter_context(InterfaceLock(machine.bus.interface, machine.bus.channel))
        given = machine.api.socket
        path = machine.resolve_path(given) if given is not None else folder / f"{machine.name}.sock"
        listeners = [stack.enter_context(unix_socket(path, machine.api.group))]
        stack.callback(path.unlink, missing_ok=True)
        if (tcp := machine.api.tcp) is not None:
            listeners.append(stack.enter_context(tcp_socket(tcp.port)))
        token = None
        if page is not None and tcp is None:
            token = secrets.token_urlsafe(32)
            listeners.append(stack.enter_context(tcp_socket(page, "--port")))
        if page is not None:
            host, port = listeners[-1].getsockname()
            address = f"http://{host}:{port}/{f'#token={token}' if token else ''}"
            print(f"page: {address}", file=sys.stderr, flush=True)  # not in the log, because of the token
        memory = stack.enter_context(Memory.create(len(machine.axes), machine.cycle_s))
        start = Start(
            machine, memory.fd, os.getpid(), simulation=simulation, force=force, socket=path,
            socket_file=file_of(path), page_token=token, log=log,
        )  # fmt: skip
        times = Times() if simulation is None else SIMULATED
        return Keeper(start, memory, listeners, Notifier.of_environment(), times=times, lock=lock).run()
