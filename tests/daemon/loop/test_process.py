"""The control process itself, with simulated drives: begins, turns, and ends in order for whoever asks."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from support.patience import until

from hdbridge.daemon.machine import Machine
from hdbridge.daemon.memory import Cell, CommandKind, Event, EventKind, Memory
from hdbridge.daemon.start import Simulation, Start


class Running:
    """A control process and the memory that it was given."""

    def __init__(self, process: subprocess.Popen[bytes], memory: Memory) -> None:
        self.process, self.memory = process, memory
        self._events = memory.event_reader()
        self.events: list[Event] = []

    def until(self, done: Callable[[], bool]) -> None:
        """Wait; the events read so far are those before ``done`` is asked."""

        def still() -> bool:
            self.events += self._events.read()[0]
            assert done() or self.process.poll() is None, self.process.returncode
            return done()

        until(still, lambda: self.events)

    def ended(self) -> int:
        status = self.process.wait()
        self.events += self._events.read()[0]
        return status


@contextmanager
def running(machine: Machine, simulation: Simulation | None, **changes: object) -> Iterator[Running]:
    with Memory.create(len(machine.axes), machine.cycle_s) as memory:
        start = Start(machine, memory.fd, os.getpid(), simulation=simulation)
        fd = start.hand_over(**changes)
        process = subprocess.Popen(
            [sys.executable, "-m", "hdbridge.daemon.loop.process", str(fd)],
            pass_fds=[fd, memory.fd],
            stderr=subprocess.PIPE,
        )
        os.close(fd)
        try:
            yield Running(process, memory)
        finally:
            process.kill()
            process.wait()
            assert process.stderr is not None
            process.stderr.close()


@pytest.fixture
def simulated() -> Iterator[Running]:
    machine = Machine.of_profile("article")
    truths = tuple(axis.profile.truth for axis in machine.axes)
    with running(machine, Simulation(truths, seed=3, speed=1.0)) as made:
        yield made


def test_it_turns_tells_who_it_is_answers_and_ends_when_asked(simulated: Running) -> None:
    status = simulated.memory.status
    reader = simulated.memory.reader()
    simulated.until(lambda: status.loop_count > 50)
    assert status.loop_pid == simulated.process.pid
    assert 0 < status.get(Cell.LOOP_TIME_NS) <= time.monotonic_ns()
    samples, _ = reader.read()
    assert (samples["time_ns"][1:] > samples["time_ns"][:-1]).all()
    id_ = simulated.memory.commands.post(CommandKind.ENABLE, 0)
    simulated.until(lambda: any(each.id == id_ for each in simulated.events))
    (answer,) = [each for each in simulated.events if each.id == id_]
    assert answer.kind is EventKind.REFUSED
    status.set(Cell.STOP_ASKED, 1)
    assert simulated.ended() == 0
    assert any(each.kind is EventKind.ENDING for each in simulated.events)


def test_it_ends_in_order_when_signalled(simulated: Running) -> None:
    simulated.until(lambda: simulated.memory.status.loop_count > 2)
    simulated.process.send_signal(signal.SIGTERM)
    assert simulated.ended() == 0
    assert any(each.kind is EventKind.ENDING for each in simulated.events)


def test_a_bus_that_is_not_there_is_said_in_a_line() -> None:
    machine = Machine.of_profile("article").on_bus(interface="socketcan", channel="nosuchcan7")
    with running(machine, None) as process:
        assert process.ended() == 3
        assert process.process.stderr is not None
        said = process.process.stderr.read().decode()
        assert said.startswith("hdbridge: socketcan:nosuchcan7: ")
        assert said.count("\n") == 1


def test_by_hand_it_is_refused() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "hdbridge.daemon.loop.process"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "use 'hdbridge run'" in done.stderr


def test_it_does_not_outlive_its_keeper() -> None:
    machine = Machine.of_profile("article")
    simulation = Simulation(tuple(axis.profile.truth for axis in machine.axes))
    with running(machine, simulation, keeper=1) as process:
        assert process.ended() == 0
        assert process.memory.status.loop_count == 0
