"""Parts of a recording that one drive made, one soon after the other: what came before is known."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from hdbridge.axis import AxisConfig
from hdbridge.control.bench import Bench
from hdbridge.drive.drive import Drive
from hdbridge.motion.procedures.stepping import Stepping
from hdbridge.records.record import Record
from hdbridge.records.recording import Recording
from hdbridge.sim.lockstep import simulated_bench
from hdbridge.sim.truth import Truth
from hdbridge.twin.misfit import prepare, residuals
from hdbridge.twin.parameters import LOAD
from hdbridge.twin.replay import commands_of, continuous, replay

DEMO = Path(__file__).parents[2] / "profiles" / "demo"
AXIS = AxisConfig.load(DEMO)
TRUTH = Truth.load(DEMO)


@cache
def recorded() -> Recording:
    """Two tasks of one drive; the second begins where the first has ended."""
    with (
        simulated_bench(TRUTH, AXIS.eds_path, AXIS.drive.node_id) as (bus, clock, _),
        Drive(bus, AXIS, clock) as drive,
    ):
        drive.boot()
        bench = Bench(drive)
        return Recording.joined([bench.run(Stepping(2, start_deg=0.0)) for _ in range(2)])


def without_noise() -> Truth:
    """The load encoder's noise is another draw."""
    encoder = TRUTH.load_.encoder.model_copy(update={"noise_arcsec": 0.0})
    return TRUTH.model_copy(update={"load_": TRUTH.load_.model_copy(update={"encoder": encoder})})


def moved(recording: Recording, later_s: float) -> Recording:
    """The second part later, as it would be in another recording."""
    record = recording.record
    time_s = record.time_s + later_s * (np.arange(len(record)) >= record.starts[1])
    return Recording(
        Record({**record.columns, "time_s": time_s}, record.source, record.starts), axis="demo", ratio=50.0
    )


def test_parts_soon_after_each_other_follow_and_later_ones_do_not() -> None:
    assert len(recorded().record.starts) == 2
    assert len(continuous(recorded().record)) == 1
    assert len(continuous(moved(recorded(), 5.0).record)) == 2


def test_a_replay_switches_the_drive_off_between_parts_as_the_bench_does() -> None:
    """Otherwise a load that rings or a spring that is wound up would start again from rest."""
    recording = recorded()
    again = replay(recording, AXIS, without_noise())
    for name in ("motor_target_deg", "motor_position_deg", "motor_torque_nm"):
        assert np.array_equal(again.columns[name], recording.record.columns[name]), name


def test_a_part_that_ends_in_motion_slows_down_as_before_and_is_switched_off() -> None:
    record = recorded().record
    target, second = record.motor_target_deg, record.starts[1]
    assert target is not None
    moves = np.flatnonzero(np.diff(target[:second]) != 0.0)
    cut = int(moves[-1]) - 3  # the command of the first rows that are left out still moves
    kept = np.r_[0:cut, second : len(record)]
    columns = {name: column[kept] for name, column in record.columns.items()}
    commands = commands_of(Record(columns, starts=(0, cut)), AXIS, TRUTH)
    counts = np.array(commands.counts[commands.lead :])
    assert AXIS.motor_encoder.counts(1.0) * target[cut : cut + 2] == pytest.approx(
        counts[cut : cut + 2], abs=6
    )
    approach, off = commands.off
    assert approach.stop < commands.lead
    assert off.start == commands.lead + cut + 2
    assert off.stop == commands.lead + len(counts) - (len(record) - second) - 1


def test_the_second_part_counts_from_its_first_row_where_it_is_known_what_came_before() -> None:
    first, second = prepare(recorded(), AXIS, TRUTH).pieces
    judged = second.counts["following error"] > 0.0
    assert judged.sum() == len(recorded().record) - recorded().record.starts[1]
    assert not judged[: -int(judged.sum())].any(), "what leads up to it does not count"
    alone = prepare(moved(recorded(), 5.0), AXIS, TRUTH).pieces[1]
    assert second.counts[LOAD].sum() > alone.counts[LOAD].sum() + 50
    assert first.counts[LOAD].any()


def test_the_elastic_state_is_that_of_the_part_before() -> None:
    """Alone, the second part would begin with the elastic state of a drive that has just been switched on."""
    data = prepare(recorded(), AXIS, TRUTH)
    left = residuals(data, TRUTH)[LOAD]
    assert np.std(left[left != 0.0]) < 1.0, "arcsec: the noise and the rounding"
