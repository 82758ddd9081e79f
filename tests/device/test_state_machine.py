"""The power state machine, exhaustively: states x controlwords x events, against the table of CiA 402.

The table is the standard's own, by its numbers, with the bit patterns of its commands. Controlwords go out as
RPDOs, and the state comes back in the statusword of a TPDO.
"""

import struct
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from support.ideal_motor import IdealMotor
from support.slave_events import TimedStage

from hdbridge.device.behaviour import Behaviour
from hdbridge.sim.lockstep import lockstep_bench

from .conftest import EDS, RawMaster

DISABLED, READY, ON, ENABLED, STOPPED, REACTION, FAULT = (
    "switch on disabled", "ready to switch on", "switched on", "operation enabled", "quick stop active",
    "fault reaction active", "fault",
)  # fmt: skip
STATES = (DISABLED, READY, ON, ENABLED, STOPPED, REACTION, FAULT)
POWERED = (ENABLED, STOPPED, REACTION)
STATUS = {
    "x0xx0000": "not ready to switch on",
    "x1xx0000": DISABLED,
    "x01x0001": READY,
    "x01x0011": ON,
    "x01x0111": ENABLED,
    "x00x0111": STOPPED,
    "x0xx1111": REACTION,
    "x0xx1000": FAULT,
}
"""The statusword of each state: bits 7 to 0."""
COMMANDS = {
    "shutdown": "0xxxx110",
    "switch on": "0xxx0111",  # as a transition from operation enabled: disable operation
    "enable operation": "0xxx1111",
    "disable voltage": "0xxxxx0x",
    "quick stop": "0xxxx01x",
}
"""The controlword of each command: bits 7 to 0."""
TRANSITIONS = {
    2: (DISABLED, "shutdown", READY),
    3: (READY, "switch on", ON),
    4: (ON, "enable operation", ENABLED),
    5: (ENABLED, "switch on", ON),
    6: (ON, "shutdown", READY),
    7: (READY, "disable voltage", DISABLED),
    8: (ENABLED, "shutdown", READY),
    9: (ENABLED, "disable voltage", DISABLED),
    10: (ON, "disable voltage", DISABLED),
    11: (ENABLED, "quick stop", STOPPED),
    12: (STOPPED, "disable voltage", DISABLED),
    16: (STOPPED, "enable operation", ENABLED),
}
ALSO = {
    "3 and 4 in one": (READY, "enable operation", ENABLED),
    "7 by quick stop": (READY, "quick stop", DISABLED),
    "10 by quick stop": (ON, "quick stop", DISABLED),
}
"""Further transitions, which CiA 402 describes in its text under the same numbers."""


def matches(pattern: str, word: int) -> bool:
    bits = f"{word & 0xFF:08b}"
    return all(want in ("x", bit) for want, bit in zip(pattern, bits, strict=True))


def state_of(statusword: int) -> str:
    (found,) = [state for pattern, state in STATUS.items() if matches(pattern, statusword)]
    return found


def expected(state: str, word: int, before: int) -> str:
    """Returns the state that the standard requires after ``word`` in ``state``, and after ``before``."""
    if state == FAULT:
        return DISABLED if word & 0x80 and not before & 0x80 else FAULT  # 15
    found = {
        after
        for start, command, after in (*TRANSITIONS.values(), *ALSO.values())
        if start == state and matches(COMMANDS[command], word)
    }
    assert len(found) <= 1
    return found.pop() if found else state


class Slave(RawMaster):
    """Master of the slave: it sends the controlword in an RPDO, and the statusword comes in a TPDO."""

    def __init__(self, bus, clock, node, motor, stage) -> None:
        super().__init__(bus, clock, node, motor)
        self.stage, self.word, self._statusword = stage, 0, 0

    def take(self) -> list[tuple[int, bytes]]:
        frames = super().take()
        for can_id, data in frames:
            if can_id == 0x181:
                self._statusword = int.from_bytes(data[:2], "little")
        return frames

    @property
    def state(self) -> str:
        self.take()
        return state_of(self._statusword)

    def configure(self) -> None:
        """Controlword and statusword, each in an event-driven PDO."""
        self.map(0x1400, 1, 0x201, 0x60400010, kind=255)
        self.map(0x1800, 1, 0x181, 0x60410010, kind=255)
        self.put(0x605A, 0, 6, 2)
        self.put(0x6060, 0, 1, 1)
        self.nmt(1)

    def control(self, word: int) -> None:
        self.word = word
        self.send(0x201, struct.pack("<H", word))

    def bring(self, state: str) -> None:
        """Leads the drive from any state to this one, at rest."""
        if self.state in (REACTION, FAULT):
            self.wait(0.1)
            self.control(0x00)
            self.control(0x80)
        self.control(0x00)
        self.wait(0.004)
        assert self.state == DISABLED, self.state
        words = {
            DISABLED: (), READY: (0x06,), ON: (0x06, 0x07), STOPPED: (0x06, 0x07, 0x0F, 0x02),
        }.get(state, (0x06, 0x07, 0x0F))  # fmt: skip
        for word in words:
            self.control(word)
            if word == 0x0F and self.stage.takes:
                self.wait(0.004 * (self.stage.takes + 2))
        if state in (FAULT, REACTION):
            if state == REACTION:  # in the middle of a move, which then ends on a ramp
                self.put(0x607A, 0, round(self.motor.position) + 1_000_000, 4)
                self.control(0x1F)
                self.wait(0.06)
            self.node.faults.raise_error(0x2310)
            self.node.poll(self.clock.now())
            if state == FAULT:
                self.wait(0.02)
        assert self.state == state, (self.state, state)


@contextmanager
def slave(behaviour: str, takes: int = 0) -> Iterator[Slave]:
    motor, stage = IdealMotor(1000), TimedStage(takes)
    chosen = Behaviour.model_validate({"controlword": behaviour})
    with lockstep_bench(motor, EDS, behaviour=chosen, stage=stage) as (bus, clock, node):
        under_test = Slave(bus, clock, node, motor, stage)
        under_test.configure()
        yield under_test


def test_the_tables_are_those_of_the_standard():
    """Every statusword belongs to one state or none, and every controlword to one command or none."""
    for word in range(0x100):
        assert sum(matches(pattern, word) for pattern in STATUS.values()) <= 1
        commands = {name for name, pattern in COMMANDS.items() if matches(pattern, word)}
        assert len(commands) == (0 if word & 0x80 else 1)


@pytest.mark.parametrize("behaviour", ["edge", "level"])
@pytest.mark.parametrize("state", STATES)
def test_every_controlword_in_every_state(state, behaviour):
    """Tries all 512 words of bits 0 to 8; the axis does not move."""
    with slave(behaviour) as node:
        node.bring(state)
        for word in range(0x200):
            place, before = node.motor.position, node.word
            node.control(word)
            wanted = expected(state, word, before)
            assert node.state == wanted, f"{word:03X}h after {before:03X}h in {state}"
            assert node.motor.position == place
            if node.state != state or word & 0x0F == 0x0F:
                node.bring(state)


@pytest.mark.parametrize("behaviour", ["edge", "level"])
def test_a_fault_reset_is_an_edge_after_any_word(behaviour):
    with slave(behaviour) as node:
        for before in range(0x200):
            node.bring(FAULT)
            node.control(before)
            state = node.state
            assert state == expected(FAULT, before, 0x0F)
            if state != FAULT:
                continue
            for word in (before | 0x80, before & ~0x80, before | 0x80):
                was = node.word
                node.control(word)
                assert node.state == expected(state, word, was), f"{word:03X}h after {was:03X}h"
                state = node.state
                if state != FAULT:
                    break


@pytest.mark.parametrize("behaviour", ["edge", "level"])
def test_every_controlword_while_power_is_being_switched_on(behaviour):
    """The state remains switched on until power is available."""
    with slave(behaviour, takes=4) as node:
        for word in range(0x100):
            node.bring(ON)
            node.control(0x0F)
            assert node.state == ON
            node.control(word)
            wanted = expected(ON, word, 0x0F)
            assert node.state == (ON if wanted == ENABLED else wanted), f"{word:02X}h"
            node.wait(0.004 * 8)
            pending = word & 0x80  # no command, so the earlier request remains valid
            assert node.state in ({ON, ENABLED} if pending else {wanted}), f"{word:02X}h"


@pytest.mark.parametrize("behaviour", ["edge", "level"])
@pytest.mark.parametrize(
    ("option", "state"),
    [(0, ENABLED), (1, FAULT), (2, DISABLED), (3, DISABLED)],
    ids=str,
)
def test_a_master_that_is_lost_while_power_is_being_switched_on(option, state, behaviour):
    """A lost master's request ends, and its repeated controlword after it returns is not a new request."""
    with slave(behaviour, takes=4) as node:
        node.bring(ON)
        node.control(0x0F)
        lose(node, option)
        node.wait(0.004)
        for _ in range(20):
            node.control(0x0F)
            node.wait(0.004)
        assert node.state == state


EVENTS = {
    "malfunction": lambda node: node.node.faults.raise_error(0x4310),
    "failure of the power stage": lambda node: setattr(node.stage, "error_code", 0x3210),
    "enable input": lambda node: node.node.faults.open_enable_input(),
    "lost master, 6007h = 0": lambda node: lose(node, 0),
    "lost master, 6007h = 1": lambda node: lose(node, 1),
    "lost master, 6007h = 2": lambda node: lose(node, 2),
    "lost master, 6007h = 3": lambda node: lose(node, 3),
    "NMT stop": lambda node: node.nmt(2),
    "reset communication": lambda node: node.nmt(130),
    "reset node": lambda node: node.nmt(129),
}


def lose(node: Slave, option: int) -> None:
    node.put(0x6007, 0, option, 2)
    node.node.faults.lose_master(0x8130)


def after(event: str, state: str) -> tuple[str, ...]:
    """Returns the state that CiA 402 and the option codes require after an event, once the axis is at
    rest.
    """
    powered = state in POWERED
    if event == "reset node":
        return (DISABLED,)
    if event in ("malfunction", "failure of the power stage"):
        return (FAULT,)  # 13 and 14
    if state in (FAULT, REACTION):
        return (FAULT,)
    if event == "enable input":
        return (DISABLED,)
    option = int(event[-1]) if event[-1].isdigit() else 1
    if not powered or option == 0:
        return (state,)
    if option == 3:
        return (STOPPED,)
    return (FAULT if option == 1 else DISABLED,)


@pytest.mark.parametrize("behaviour", ["edge", "level"])
@pytest.mark.parametrize("event", EVENTS)
@pytest.mark.parametrize("state", STATES)
def test_every_event_in_every_state_and_then_every_command(state, event, behaviour):
    """Events lead to the states of the standard; each command then follows the table in that state."""
    commands = (0x00, 0x02, 0x06, 0x07, 0x0F, 0x8F)
    with slave(behaviour) as node:
        for word in commands:
            node.put(0x6007, 0, 1, 2)
            node.put(0x605A, 0, 6, 2)
            node.bring(state)
            before = node.word
            EVENTS[event](node)
            node.wait(0.6 if state == REACTION else 0.1)  # without power the motor coasts
            node.stage.error_code = 0
            if event in ("NMT stop", "reset node", "reset communication"):
                if event != "NMT stop":
                    node.configure()
                    before = node.word = 0 if event == "reset node" else before
                else:
                    node.nmt(1)
                node.wait(0.01)
            assert node.state in after(event, state), f"{event} in {state}"
            reached, place = node.state, node.motor.position
            node.control(word)
            wanted = expected(reached, word, before)
            if word == before and wanted != reached and behaviour == "edge":
                wanted = reached  # a repeated word is not a new command
            assert node.state == wanted, f"{word:02X}h after {event} in {state}"
            node.wait(0.05)
            assert node.motor.position == place
