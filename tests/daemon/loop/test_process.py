"""The control process: start and orderly end."""

import os
import subprocess
import sys

from hdbridge.daemon.machine import Machine
from hdbridge.daemon.memory import Cell, Memory
from hdbridge.daemon.start import Simulation, Start

CONTROL = [sys.executable, "-m", "hdbridge.daemon.loop.process"]


def ended(machine: Machine, simulation: Simulation | None, **changes: object) -> tuple[int, str, int]:
    """Runs a control process to its end; returns its exit status, its output, and its number of cycles."""
    with Memory.create(len(machine.axes), machine.cycle_s) as memory:
        start = Start(machine, memory.fd, os.getpid(), simulation=simulation)
        fd = start.hand_over(**changes)
        done = subprocess.run(
            [*CONTROL, str(fd)], pass_fds=[fd, memory.fd], stderr=subprocess.PIPE, text=True, check=False
        )
        os.close(fd)
        return done.returncode, done.stderr, memory.status[Cell.LOOP_COUNT]


def test_a_missing_bus_is_reported_in_one_line() -> None:
    status, said, _ = ended(
        Machine.of_profile("article").on_bus(interface="socketcan", channel="nosuchcan7"), None
    )
    assert status == 3
    assert said.startswith("hdbridge: socketcan:nosuchcan7: ")
    assert said.count("\n") == 1


def test_the_control_process_ends_with_its_keeper() -> None:
    machine = Machine.of_profile("article")
    simulation = Simulation(tuple(axis.profile.truth for axis in machine.axes))
    status, _, turns = ended(machine, simulation, keeper=1)
    assert (status, turns) == (0, 0)
