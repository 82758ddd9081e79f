"""Every fault of the reliability table on the daemon with two axes in motion."""

from collections.abc import Callable

import pytest
from support.characters import FRIENDLY, Character, PowerCount, every_character
from support.reliability import ABOUT_POWER, DAEMON, Row, cases_on, rows_of, try_out
from support.reliability_daemon import STATES, DaemonBench

from hdbridge.daemon.loop.faultlog import FAULT_INDEX
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import EventKind
from hdbridge.drive.supervision import Reaction

Benches = Callable[[Character], DaemonBench]


def in_every_run(character: Character, row: Row) -> bool:
    """Returns True for the friendly drive, and for faults that involve the firmware."""
    return character is FRIENDLY or row.fault in ABOUT_POWER


@pytest.mark.parametrize(("character", "row"), cases_on(DAEMON, in_every_run))
def test_a_fault_has_its_reaction_in_time_and_is_latched(
    benches: Benches, character: Character, row: Row
) -> None:
    if row.unseen_on(character):
        pytest.skip("nothing that this drive sends shows it")
    check(benches(character), row, character)


@pytest.mark.slow
@pytest.mark.parametrize("character", every_character(), ids=str)
def test_a_fault_has_its_reaction_on_every_drive(benches: Benches, character: Character) -> None:
    for row in rows_of(DAEMON):
        print(row.name)
        if not row.unseen_on(character):
            check(benches(character), row, character)


def check(bench: DaemonBench, row: Row, character: Character) -> None:
    bench.set_off()
    counts = [PowerCount(node) for node in bench.daemon.nodes]
    try_out(row, bench, DAEMON, bench.daemon.axes[0].image.heartbeat_timeout_s, character)
    stops = row.reaction >= Reaction.QUICK_STOP
    concerned = ((0, 1) if row.everybody else (0,)) if stops else ()
    assert all(bench.moves_on(axis) for axis in range(2) if axis not in concerned)
    if concerned:
        for axis in concerned:
            assert bench.states[axis] is STATES[bench.daemon.axes[axis].supervision.reaction]
        bench.stay_stopped(*concerned)
    for axis in concerned:
        (stopped,) = bench.daemon.reported(EventKind.STOPPED, axis)
        assert stopped.code == FAULT_INDEX[row.fault]
        assert row.fault.value in stopped.text
    bench.mend()
    assert counts[0].times <= row.resumptions_on(character), "power without a request"
    assert counts[1].times == 0
    bench.leads_back()
    assert all(state is AxisState.ENABLED for state in bench.states)
