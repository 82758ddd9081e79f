"""Clients receive the newest events, however many legs of streams have ended meanwhile."""

import numpy as np
from support.service import Service

from hdbridge.client import messages
from hdbridge.daemon.memory import Event, EventKind, sample_dtype
from hdbridge.daemon.service.bridge import EVENTS_RETURNED
from hdbridge.daemon.service.eventlog import ENTRIES_KEPT, EventLog
from hdbridge.motion import MotionMode

NO_SAMPLES = np.zeros(0, sample_dtype(1))


def event(kind: EventKind, code: int = 0, text: str = "") -> Event:
    return Event(sequence=1, cycle=1, time_ns=1, axis=0, kind=kind, id=7, code=code, text=text)


def test_routine_events_do_not_displace_stops() -> None:
    log = EventLog(["axis1"])
    leg = [event(EventKind.DONE), event(EventKind.MOTION_ENDED, MotionMode.STREAM)]
    log.take(NO_SAMPLES, [event(EventKind.STOPPED, text="cycle 1: lost"), *leg * ENTRIES_KEPT], 0)
    log.take(NO_SAMPLES, [event(EventKind.MOTION_ENDED, MotionMode.GOTO)], 0)
    assert [(each.sequence, each.text) for each in log.since(0)] == [(1, "cycle 1: lost"), (2, "goto")]
    assert log.newest == 2
    (ended,) = log.since(1)
    assert (ended.kind, ended.axis) == (messages.EventKind.MOTION_ENDED, "axis1")
    assert log.since(2) == log.since(99) == []


def test_a_note_with_a_kind_is_recorded_with_the_name_of_its_axis() -> None:
    log = EventLog(["axis1"])
    recorded: list[tuple[str, str]] = []
    log.record = lambda kind, text: recorded.append((kind, text))
    log.note("plain", 0)
    log.note("it squeaks", 0, "MARK")
    log.note("all squeak", kind="MARK")
    assert recorded == [("MARK", "axis1: it squeaks"), ("MARK", "all squeak")]
    assert [(each.axis, each.text) for each in log.since(0)] == [
        ("axis1", "plain"), ("axis1", "it squeaks"), (None, "all squeak"),
    ]  # fmt: skip


async def test_the_newest_events_are_returned_and_the_others_counted(service: Service) -> None:
    async with service.ready() as bridge:
        before = bridge.events(0).newest
        for number in range(EVENTS_RETURNED + 5):
            bridge.mark(f"remark {number}")
        found = bridge.events(before)
        assert found.events[-1].text.endswith(f"remark {EVENTS_RETURNED + 4}")
        assert len(found.events) == EVENTS_RETURNED
        assert found.lost == 5
        assert bridge.events(found.newest).events == []
        bridge.mark("one more")
        assert [each.text.endswith("one more") for each in bridge.events(found.newest).events] == [True]
