"""Parts of a recording that one drive made, one soon after the other: what came before is known."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from hdbridge.axis import AxisConfig
from hdbridge.control.bench import Bench
from hdbridge.drive.drive import Drive
from hdbridge.procedures.stepping import Stepping
from hdbridge.records.record import Record
from hdbridge.records.recording import Recording
from hdbridge.sim.lockstep import simulated_bench
from hdbridge.sim.truth import Truth
from hdbridge.twin.misfit import prepare, residuals
from hdbridge.twin.parameters import LOAD
from hdbridge.twin.stretches import continuous

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
