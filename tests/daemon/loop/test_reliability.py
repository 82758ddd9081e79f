"""Every fault of the reliability table on the daemon, two axes in motion: who stops, how soon, for good."""

from __future__ import annotations

import pytest
from support.reliability import DAEMON, Row, rows_of, try_out
from support.reliability_daemon import STATES, DaemonBench

from hdbridge.daemon.loop.faultlog import FAULT_INDEX
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import EventKind
from hdbridge.drive.supervision import Fault, Reaction


@pytest.mark.parametrize("row", rows_of(DAEMON), ids=lambda row: row.name)
def test_a_fault_has_its_reaction_in_time_and_is_latched(moving: DaemonBench, row: Row) -> None:
    bench = moving
    try_out(row, bench, DAEMON, bench.daemon.axes[0].image.heartbeat_timeout_s)
    stops = row.reaction >= Reaction.QUICK_STOP or row.fault is Fault.HANG
    concerned = ((0, 1) if row.everybody else (0,)) if stops else ()
    for axis in range(2):
        if axis not in concerned:
            assert bench.moves_on(axis)
            continue
        assert bench.states[axis] is STATES[bench.daemon.axes[axis].supervision.reaction]
        bench.stays_stopped(axis)
        (told,) = bench.daemon.told(EventKind.STOPPED, axis)
        assert told.code == FAULT_INDEX[row.fault]
        assert row.fault.value in told.text
    bench.mend()
    bench.leads_back()
    assert all(state is AxisState.ENABLED for state in bench.states)
