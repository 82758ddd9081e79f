"""What outlives the processes of a daemon: log, lock, sockets, shared memory; and the keeper within."""

from __future__ import annotations

import os
from contextlib import ExitStack

from hdbridge.daemon.api.sockets import check_exposure, tcp_socket, unix_socket
from hdbridge.daemon.keeper import Keeper
from hdbridge.daemon.logs import LogSettings, begin_log
from hdbridge.daemon.machine import Machine
from hdbridge.daemon.memory import Memory
from hdbridge.daemon.notify import Notifier
from hdbridge.daemon.runtime import runtime_folder, socket_path
from hdbridge.daemon.start import Simulation, Start
from hdbridge.drive.interfacelock import interface_lock


def hold(
    machine: Machine,
    simulation: Simulation | None = None,
    *,
    force: bool = False,
    log: LogSettings | None = None,
) -> int:
    """Run the daemon of a machine in this process until a signal ends it; the exit status.

    ``force`` goes on where another process of this machine masters the interface, or another master is heard.
    InputError, BusError and DaemonError where it cannot begin; then nothing was sent.
    """
    log = log or LogSettings()
    begin_log(log)
    folder = runtime_folder()
    with ExitStack() as stack:
        if simulation is None and not force:
            stack.enter_context(interface_lock(machine.bus.interface, machine.bus.channel))
        given = machine.api.socket
        path = socket_path(machine.name, folder, machine.beside(given) if given is not None else None)
        listeners = [stack.enter_context(unix_socket(path, machine.api.group))]
        stack.callback(path.unlink, missing_ok=True)
        if (tcp := machine.api.tcp) is not None:
            check_exposure(tcp.host, tls=tcp.certificate is not None, unencrypted=tcp.unencrypted)
            listeners.append(stack.enter_context(tcp_socket(tcp.host, tcp.port)))
        memory = stack.enter_context(Memory.create(len(machine.axes), machine.cycle_s))
        start = Start(
            machine, memory.fd, os.getpid(), simulation=simulation, force=force, runtime=folder, log=log
        )
        return Keeper(start, memory, listeners, Notifier.of_environment()).run()
