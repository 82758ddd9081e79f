"""The sample ring: samples are read once, whole and in order; lost ones are counted."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.daemon.memory import AXIS_SAMPLE, NO_FAULT, SAMPLES_KEPT, Memory, SampleFlag, sample_dtype
from hdbridge.daemon.memory.layout import Axis


def axis(value: float) -> Axis:
    flags = SampleFlag.FRESH | SampleFlag.AT_REST
    return Axis(3, 1, 4, NO_FAULT, 0x1237, flags, *(value + place for place in range(15)), 1, 2, 3, 4, 5)


def write(memory: Memory, cycle: int) -> None:
    values = [number for place in range(memory.axes) for number in axis(cycle + 100.0 * place)]
    memory.samples.append((cycle, 4_000_000 * cycle, 1.5, 250.0, 0.25, 7, *values))


def test_a_sample_arrives_as_it_was_written(memory: Memory) -> None:
    reader = memory.reader()
    write(memory, 42)
    samples, lost = reader.read()
    assert lost == 0
    (sample,) = samples
    assert (sample["sequence"], sample["cycle"], sample["time_ns"]) == (1, 42, 168_000_000)
    assert [sample[name] for name in ("late_us", "busy_us", "bus_load", "skipped")] == [1.5, 250.0, 0.25, 7]
    assert sample["axes"].dtype == AXIS_SAMPLE
    for place, found in enumerate(sample["axes"]):
        assert tuple(found) == tuple(axis(42.0 + 100.0 * place))
    assert reader.read()[0].size == 0


def test_readers_are_independent_and_start_at_creation(memory: Memory) -> None:
    write(memory, 0)
    first = memory.reader()
    write(memory, 1)
    second = memory.reader()
    write(memory, 2)
    assert first.read()[0]["cycle"].tolist() == [1, 2]
    assert second.read()[0]["cycle"].tolist() == [2]


def test_samples_read_are_copies(memory: Memory) -> None:
    reader = memory.reader()
    write(memory, 1)
    samples, _ = reader.read()
    for cycle in range(SAMPLES_KEPT + 2):
        write(memory, 1000 + cycle)
    assert samples["cycle"].tolist() == [1]


@given(st.lists(st.integers(0, 3 * SAMPLES_KEPT // 2), min_size=1, max_size=4))
def test_every_sample_is_read_once_or_counted_as_lost(bursts: list[int]) -> None:
    with Memory.create(1, 0.001) as memory:
        reader = memory.reader()
        values = axis(0.0)
        written, seen, lost = 0, [], 0
        for burst in bursts:
            for _ in range(burst):
                memory.samples.append((written, written, 0.0, 0.0, 0.0, 0, *values))
                written += 1
            samples, missed = reader.read()
            lost += missed
            seen.append(samples["cycle"].copy())
            assert missed == max(burst - (SAMPLES_KEPT - 1), 0)
        cycles = np.concatenate(seen)
        assert len(cycles) + lost == written
        assert (np.diff(cycles) > 0).all()


@pytest.mark.parametrize("field", ["sequence", "last"])
def test_a_slot_being_written_is_not_read(memory: Memory, field: str) -> None:
    reader = memory.reader()
    for cycle in range(3):
        write(memory, cycle)
    # The state that a writer leaves if it is killed in the middle of a store.
    reader._rows[2].view(sample_dtype(memory.axes))[field] = 77
    samples, lost = reader.read()
    assert samples["cycle"].tolist() == [0, 2]
    assert lost == 1


def test_a_checksum_detects_reordered_writes() -> None:
    with Memory.create(1, 0.001, checked=True) as memory:
        reader = memory.reader()
        memory.samples.append((5, 0, 0.0, 0.0, 0.0, 0, *axis(0.0)))
        reader._rows[1].view(sample_dtype(1))["cycle"] = 6
        assert reader.read()[1] == 1
