"""Mailbox, events, knots, frames and settings: bounded, in order, nothing twice."""

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from hdbridge.daemon.memory import CommandKind, Event, EventKind, Knot, MailboxFullError, Memory, RelayedFrame
from hdbridge.daemon.memory.layout import (
    COMMAND_SLOTS,
    EVENTS_KEPT,
    INCOMING_KEPT,
    KNOT_SLOTS,
    OUTGOING_SLOTS,
)
from hdbridge.errors import InputError


def test_a_command_arrives_with_its_id_and_its_numbers(memory: Memory) -> None:
    id_ = memory.commands.post(CommandKind.MOVE, 1, a=12.5, b=float("nan"), c=3.0, i=-(1 << 62), j=5, k=6)
    command = memory.commands.take()
    assert command is not None
    assert (command.id, command.kind, command.axis, command.a) == (id_, CommandKind.MOVE, 1, 12.5)
    assert command.b != command.b
    assert (command.i, command.j, command.k) == (-(1 << 62), 5, 6)
    assert memory.commands.take() is None


def test_an_event_arrives_with_its_text(memory: Memory) -> None:
    reader = memory.event_reader()
    memory.events.append(Event(0, 7, 28_000_000, 1, EventKind.REFUSED, 99, 3, "outside -400 .. 400°"))
    (event,), lost = reader.read()
    assert lost == 0
    assert event == (1, 7, 28_000_000, 1, EventKind.REFUSED, 99, 3, "outside -400 .. 400°")
    assert event.kind is EventKind.REFUSED


@pytest.mark.parametrize("before", ["", "x"])
def test_a_long_text_is_cut_between_two_characters(memory: Memory, before: str) -> None:
    reader = memory.event_reader()
    memory.events.append(Event(0, 0, 0, -1, EventKind.FAULT, text=before + "°" * 400))
    (event,), _ = reader.read()
    assert event.text == before + "°" * ((400 - len(before)) // 2)


def test_unread_events_are_counted(memory: Memory) -> None:
    reader = memory.event_reader()
    for cycle in range(EVENTS_KEPT + 10):
        memory.events.append(Event(0, cycle, 0, -1, EventKind.DONE))
    events, lost = reader.read()
    assert lost == 11  # plus the slot that may be in the middle of a write
    assert [each.cycle for each in events] == list(range(11, EVENTS_KEPT + 10))


def test_frames_in_and_out(memory: Memory) -> None:
    one, other = memory.incoming_reader(), memory.incoming_reader()
    memory.incoming.append(RelayedFrame(5, 0x581, bytes(range(8))))
    memory.incoming.append(RelayedFrame(6, 0x701, b"\x05"))
    for reader in (one, other):
        frames, lost = reader.read()
        assert lost == 0
        assert frames == [(5, 0x581, bytes(range(8))), (6, 0x701, b"\x05")]
    for _ in range(INCOMING_KEPT + 1):
        memory.incoming.append(RelayedFrame(7, 0x701, b""))
    assert one.read()[1] == 2

    for count in range(OUTGOING_SLOTS):
        assert memory.outgoing.add(RelayedFrame(count, 0x601, b"\x40"))
    assert not memory.outgoing.add(RelayedFrame(0, 0x601, b"\x40"))
    assert memory.outgoing.take() == (0, 0x601, b"\x40")
    assert memory.outgoing.add(RelayedFrame(0, 0x602, b""))
    memory.outgoing.clear()
    assert memory.outgoing.take() is None


def test_knots_of_two_axes_do_not_mix_and_are_bounded(memory: Memory) -> None:
    first, second = memory.knots
    wanted = [Knot(1, 0.004 * place, float(place), 0.5) for place in range(KNOT_SLOTS + 5)]
    assert first.put(wanted) == KNOT_SLOTS
    assert len(first) == KNOT_SLOTS
    assert second.put(wanted[:1]) == 1
    for each in (first, second):
        assert each.peek() == each.peek() == wanted[0]
        each.drop()
    assert first.peek() == wanted[1]
    assert second.peek() is None
    assert len(first) == KNOT_SLOTS - 1
    first.clear()
    assert first.peek() is None


def test_a_slot_returns_only_the_setting_of_its_number(memory: Memory) -> None:
    slot, other = memory.settings[:2]
    with pytest.raises(InputError, match="not in the slot"):
        slot.get(slot.number)
    first = slot.put(b"one" * 1000)
    assert slot.get(first) == b"one" * 1000
    second = slot.put(b"two")
    other.put(b"another axis's")
    assert slot.get(second) == b"two"
    for number in (first, 0, second + 1, -second):
        with pytest.raises(InputError, match="not in the slot"):
            slot.get(number)
    with pytest.raises(InputError, match="has 2000000 bytes"):
        slot.put(bytes(2_000_000))
    assert slot.get(second) == b"two"
    slot.use(second)
    assert (slot.in_use, other.in_use) == (second, 0)


class MailboxMachine(RuleBasedStateMachine):
    """The mailbox compared with a list."""

    def __init__(self) -> None:
        super().__init__()
        self.memory = Memory.create(1, 0.001)
        self.waiting: list[tuple[int, float]] = []
        self.last = 0

    @rule(burst=st.integers(1, COMMAND_SLOTS + 20))
    def post(self, burst: int) -> None:
        for value in range(burst):
            if len(self.waiting) == COMMAND_SLOTS:
                with pytest.raises(MailboxFullError, match="has not taken the 256 commands"):
                    self.memory.commands.post(CommandKind.MOVE, 0, a=float(value))
                return
            id_ = self.memory.commands.post(CommandKind.MOVE, 0, a=float(value))
            assert id_ > self.last
            self.last = id_
            self.waiting.append((id_, float(value)))

    @rule(burst=st.integers(1, COMMAND_SLOTS + 20))
    def take(self, burst: int) -> None:
        for _ in range(burst):
            command = self.memory.commands.take()
            if not self.waiting:
                assert command is None
                return
            assert command is not None
            assert (command.id, command.a) == self.waiting.pop(0)

    @rule()
    def clear(self) -> None:
        self.memory.commands.clear()
        self.waiting.clear()

    @invariant()
    def counts(self) -> None:
        assert len(self.memory.commands) == len(self.waiting)

    def teardown(self) -> None:
        self.memory.close()


MailboxMachine.TestCase.settings = settings(max_examples=30, deadline=None)
test_the_mailbox_behaves_as_a_bounded_list = MailboxMachine.TestCase
