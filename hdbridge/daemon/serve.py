"""Service process: ``python -m hdbridge.daemon.serve FD``, started by the keeper.

This process assembles bridge, API, recorder, watch, adaptation and log, and closes them in order. It has one
event loop; blocking work runs in threads. If it dies, the axes complete their current commands.
"""

import asyncio
import os
import signal
import socket
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack, suppress
from typing import Final

from hdbridge.daemon.api.guard import Policy
from hdbridge.daemon.api.metrics import Metrics
from hdbridge.daemon.api.server import ApiServer, Listener
from hdbridge.daemon.api.sockets import file_of, unix_socket
from hdbridge.daemon.logs import begin_log
from hdbridge.daemon.machine import Machine
from hdbridge.daemon.machinefile import read_token
from hdbridge.daemon.memory import Cell, Memory
from hdbridge.daemon.recorder.autodiagnosis import AutoDiagnosis
from hdbridge.daemon.recorder.flightfile import About, AxisAbout
from hdbridge.daemon.recorder.recorder import FlightRecorder
from hdbridge.daemon.service.bridge import ServiceBridge
from hdbridge.daemon.service.following import Following
from hdbridge.daemon.service.timing import SimulatedClock, Timing
from hdbridge.daemon.start import Start, run_child, runtime_folder
from hdbridge.errors import HdbridgeError

THREADS_PER_AXIS: Final = 2
"""Threads per axis: one can verify the drive while another request of the same axis blocks."""
SPARE_THREADS: Final = 4
LOOK_S: Final = 1.0
"""Interval between checks for the socket file."""
LAST_WORDS_S: Final = 35.0
"""Maximum wait for the control process to bring its axes to rest, so that the stop is recorded."""


def run(start: Start) -> None:
    """Runs the service process until SIGTERM."""
    begin_log(start.log)
    with Memory.attach(start.memory_fd) as memory:
        asyncio.run(serve(start, memory))


async def serve(start: Start, memory: Memory) -> None:
    """Runs the service until SIGTERM, then until the control process has ended (at most `LAST_WORDS_S`)."""
    machine = start.machine
    terminated = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, terminated.set)
    async with AsyncExitStack() as stack:
        simulated = start.simulation is not None
        clock = SimulatedClock(lambda: memory.status[Cell.LOOP_COUNT], machine.cycle_s) if simulated else None
        timing = Timing(THREADS_PER_AXIS * len(machine.axes) + SPARE_THREADS, clock)
        stack.callback(timing.close)
        bridge = ServiceBridge(machine, memory, timing, simulated=simulated, forced=start.force)
        metrics = Metrics(bridge)
        recorder = FlightRecorder(
            machine.recorder_folder(),
            About(machine.name, machine.cycle_s, tuple(AxisAbout.of(each.config) for each in machine.axes)),
            machine.recorder,
            notify=bridge.core.log.note,
            in_use=lambda: {name: axis.models.in_use for name, axis in bridge.axes.items()},
        )
        bridge.recorder, bridge.core.log.record = recorder, recorder.note
        stack.callback(recorder.close)
        bridge.core.add_sink(metrics)
        bridge.core.add_sink(recorder)
        follow(bridge, stack)
        await stack.enter_async_context(bridge)
        server = ApiServer(bridge, listeners(machine, start.api_fds, start.page_token), metrics)
        async with asyncio.TaskGroup() as group:
            group.create_task(server.run())
            group.create_task(_say_when_served(server, memory))
            keeping = group.create_task(_keep_socket(start, server, bridge.core.log.note))
            await terminated.wait()
            await _last_words(bridge, memory)
            keeping.cancel()
            server.stop()


def follow(bridge: ServiceBridge, stack: AsyncExitStack) -> None:
    """Starts a `Following` for each axis, with its own thread each.

    If flights are recorded, the watch's verdicts are diagnosed automatically.
    """
    machine, recorder, diagnosis = bridge.machine, bridge.recorder, None
    if recorder is not None and recorder.flight is not None:
        diagnosis = AutoDiagnosis(recorder.folder)
        stack.callback(diagnosis.close)
    for port in bridge.axes.values():
        axis = port.axis
        given = axis.adaptation.folder
        folder = machine.resolve_path(given) if given is not None else machine.axis_folder(axis, "adaptation")
        worker = stack.enter_context(ThreadPoolExecutor(1, thread_name_prefix=f"following-{axis.name}"))
        port.following = Following(port, axis.adaptation, folder, worker, diagnosis)
        bridge.core.add_sink(port.following)
        stack.callback(port.following.close)


def listeners(machine: Machine, descriptors: Sequence[int], page_token: str | None = None) -> list[Listener]:
    """Returns listeners for the keeper's sockets: the Unix socket, and a TCP port for clients or the page."""
    unix, *others = [socket.socket(fileno=each) for each in descriptors]
    made = [Listener(unix, Policy())]
    tcp = machine.api.tcp
    if page_token is not None:
        made.append(Listener(others[0], Policy(page_token)))
    elif tcp is not None:
        token = read_token(machine.resolve_path(tcp.token_file))
        made.append(Listener(others[0], Policy(token, frozenset(each.lower() for each in tcp.names))))
    return made


async def _keep_socket(start: Start, server: ApiServer, note: Callable[[str], None]) -> None:
    """Binds the Unix socket again whenever its file has disappeared; open connections are kept."""
    path, bound, noted = start.socket, start.socket_file, ""
    while True:
        found = (0, 0)
        with suppress(OSError):
            found = file_of(path)
        if found == bound:
            await asyncio.sleep(LOOK_S)
            continue
        try:
            if start.machine.api.socket is None:
                runtime_folder()
            listener = unix_socket(path, start.machine.api.group)
            bound, noted = file_of(path), ""
        except (HdbridgeError, OSError) as problem:
            if str(problem) != noted:
                noted = str(problem)
                note(f"clients cannot connect: the socket file is gone and cannot be bound again: {problem}")
            await asyncio.sleep(LOOK_S)
            continue
        server.add(Listener(listener, Policy()))
        note(f"{path}: the socket file was gone; it is bound again")


async def _say_when_served(server: ApiServer, memory: Memory) -> None:
    """Writes this process's id to the shared memory once the server has started; the keeper waits for it."""
    while not server.started:
        await asyncio.sleep(0.01)
    memory.status[Cell.SERVICE_PID] = os.getpid()


async def _last_words(bridge: ServiceBridge, memory: Memory) -> None:
    """Keeps serving while the axes are brought to rest, so that clients see the stop and it is recorded."""
    end_s = asyncio.get_running_loop().time() + LAST_WORDS_S
    status = memory.status
    while bridge.core.alive and status[Cell.LOOP_PID] and asyncio.get_running_loop().time() < end_s:
        await asyncio.sleep(0.05)
    bridge.core.poll()


if __name__ == "__main__":
    sys.exit(run_child(sys.argv[1:], "hdbridge-serve", run))
