"""The memory between processes: attaching, heavy traffic, kills."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from hdbridge.daemon.memory import Cell, CommandKind, Event, EventKind, Memory
from hdbridge.daemon.memory.layout import HEADER, Layout
from hdbridge.errors import InputError

HAMMER = """
import sys
from hdbridge.daemon.memory import Event, EventKind, Memory, OuterView
memory = Memory.attach(int(sys.argv[1]))
cycle = 0
while True:
    cycle += 1
    memory.outer[0].show(OuterView(*(1 + cycle % 2,) * 6))
    # Every number of a sample is the same: a torn one shows.
    memory.samples.append((cycle, cycle, 0.0, 0.0, 0.0, 0, *(0,) * 6, *(float(cycle),) * 15, *(0,) * 5))
    if cycle % 16 == 0:
        memory.events.append(Event(0, cycle, cycle, 0, EventKind.DONE, cycle, 0, str(cycle)))
"""
OTHER_END = """
import os, signal, sys
from hdbridge.daemon.memory import Cell, CommandKind, Knot, Memory
memory = Memory.attach(int(sys.argv[1]))
memory.status[Cell.SERVICE_PID] = os.getpid()
ids = [memory.commands.post(CommandKind.MOVE, 0, a=float(each)) for each in range(100)]
memory.knots[0].put(Knot(1, float(each), 0.0, 0.0) for each in range(50))
os.kill(os.getpid(), signal.SIGKILL)
"""


def start(script: str, memory: Memory) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", script, str(memory.fd)], pass_fds=[memory.fd])


@pytest.mark.parametrize("checked", [False, True])
def test_samples_are_never_torn(checked: bool) -> None:
    with Memory.create(1, 0.001, checked=checked) as memory:
        samples_of, events_of = memory.reader(), memory.event_reader()
        process = start(HAMMER, memory)
        try:
            seen = lost = event_count = 0
            last = last_event = 0
            while seen < 50_000 or event_count < 500:
                assert process.poll() is None
                samples, missed = samples_of.read()
                lost += missed
                if len(samples):
                    cycles = samples["cycle"]
                    axis = samples["axes"][:, 0]
                    assert (cycles == samples["sequence"]).all()
                    for name in ("load_target_deg", "weight", "issued_deg"):
                        assert (axis[name] == cycles).all()
                    assert cycles[0] == seen + lost + 1
                    assert (np.diff(cycles) == 1).all()
                    last = int(cycles[-1])
                seen += len(samples)
                if seen:
                    assert {each for _ in range(200) for each in memory.outer[0].values()} <= {1, 2}
                events, missed = events_of.read()
                event_count += len(events)
                for event in events:
                    assert event.text == str(event.cycle) == str(event.id)
                    assert event.sequence > last_event
                    last_event = event.sequence
            assert seen + lost == last
        finally:
            process.kill()
            process.wait()


def test_commands_of_a_killed_service_are_whole_and_a_new_one_continues() -> None:
    with Memory.create(1, 0.001) as memory:
        process = start(OTHER_END, memory)
        assert process.wait() == -signal.SIGKILL
        assert memory.status[Cell.SERVICE_PID] == process.pid
        taken = [memory.commands.take() for _ in range(101)]
        assert [each.a for each in taken[:100] if each] == list(map(float, range(100)))
        assert taken[100] is None
        assert len(memory.knots[0]) == 50
        with Memory.attach(os.dup(memory.fd)) as successor:
            first = taken[0]
            assert first is not None
            assert successor.commands.post(CommandKind.STOP, 0) == first.id + 100
        command = memory.commands.take()
        assert command is not None
        assert command.kind == CommandKind.STOP


def test_a_replacement_loop_continues_the_numbering() -> None:
    with Memory.create(1, 0.001) as memory:
        reader, events = memory.reader(), memory.event_reader()
        process = start(HAMMER, memory)
        while not len(reader.read()[0]):
            time.sleep(0.01)
        process.kill()
        process.wait()
        samples, lost = reader.read()
        events.read()
        with Memory.attach(os.dup(memory.fd)) as successor:
            successor.samples.append((-1, *(0,) * 11, *(0.0,) * 15, *(0,) * 5))
            successor.events.append(Event(0, 0, 0, -1, EventKind.BUS_UP))
        after, lost = reader.read()
        assert lost == 0
        assert after["cycle"].tolist() == [-1]
        if len(samples):
            assert after["sequence"][0] == samples["sequence"][-1] + 1
        (event,), lost = events.read()
        assert (event.kind, lost) == (EventKind.BUS_UP, 0)


def test_status_cells_are_shared(memory: Memory) -> None:
    with Memory.attach(os.dup(memory.fd)) as other:
        assert other.axes == 2
        assert other.period_s == 0.004
        for value, cell in enumerate(Cell, 1 << 40):
            memory.status[cell] = value
        status = other.status
        assert [
            status[Cell.LOOP_COUNT],
            status[Cell.SERVICE_TIME_NS],
            status[Cell.LOOP_PID],
            status[Cell.SERVICE_PID],
        ] == [(1 << 40) + place for place in range(4)]
        assert status[Cell.STOP_REQUESTED]


def foreign(data: bytes, size: int) -> int:
    fd = os.memfd_create("foreign", os.MFD_CLOEXEC)
    os.write(fd, data)
    os.ftruncate(fd, size)
    return fd


def header(mark: int, axes: int = 1) -> bytes:
    return HEADER.pack(mark, axes, 1_000_000, False)


@pytest.mark.parametrize(
    ("data", "size"),
    [
        (b"", 0),
        (b"something else altogether" * 10, 8192),
        (header(Layout.of(1).mark + 1), Layout.of(1).total),
        (header(Layout.of(1).mark, axes=0), Layout.of(1).total),
        (header(Layout.of(1).mark, axes=2), Layout.of(2).total),
        (header(Layout.of(1).mark), 8192),
    ],
)
def test_foreign_memory_is_refused(data: bytes, size: int) -> None:
    fd = foreign(data, size)
    with pytest.raises(InputError, match=r"not the shared memory of this release .*restart"):
        Memory.attach(fd)
    os.close(fd)


def test_a_closed_descriptor_is_refused() -> None:
    fd = foreign(b"", 0)
    os.close(fd)
    with pytest.raises(InputError, match="not the shared memory"):
        Memory.attach(fd)


def test_the_memory_cannot_be_shrunk(memory: Memory) -> None:
    with pytest.raises(PermissionError):
        os.ftruncate(memory.fd, 0)


@pytest.mark.parametrize(("axes", "period_s"), [(0, 0.004), (65, 0.004), (1, 0.0)])
def test_invalid_sizes_are_refused(axes: int, period_s: float) -> None:
    with pytest.raises(InputError, match="expected 1 to 64 axes"):
        Memory.create(axes, period_s)
