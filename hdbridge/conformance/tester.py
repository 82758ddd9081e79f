"""Tester: frames, SDO, PDO configuration and power states for the checks.

The tester works at the level of frames, because a check must also send what a correct master never sends.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Final, NoReturn, TypeVar

import can
from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes

from hdbridge.cia301 import NmtCommand
from hdbridge.drive.link import Frame, Link
from hdbridge.drive.states import State, decode
from hdbridge.errors import DriveError, HdbridgeError
from hdbridge.files.edsfile import variables

STATES: Final = {0x00: "boot-up", 0x04: "STOPPED", 0x05: "OPERATIONAL", 0x7F: "PRE-OPERATIONAL"}
"""NMT states by the byte of a heartbeat."""
ENTERED: Final = {
    NmtCommand.START: "OPERATIONAL",
    NmtCommand.STOP: "STOPPED",
    NmtCommand.PRE_OPERATIONAL: "PRE-OPERATIONAL",
}
"""NMT states by the command that leads there."""

ABSENT: Final = (0x06020000, 0x06090011)
READ_ONLY: Final = (0x06010002, 0x06010000)
WRITE_ONLY: Final = (0x06010001, 0x06010000)
RANGE: Final = (0x06090030, 0x06090031, 0x06090032, 0x06090036)
LENGTH: Final = (0x06070010, 0x06070012, 0x06070013)
COMMAND: Final = (0x05040001,)

MASTER: Final = 126
"""Node id of the tester's heartbeat."""
PDO_INVALID: Final = 1 << 31
ENABLING: Final = (
    (State.READY_TO_SWITCH_ON, 0x06),
    (State.SWITCHED_ON, 0x07),
    (State.OPERATION_ENABLED, 0x0F),
)
"""Power states on the way to OPERATION ENABLED, each with the controlword that leads to the state."""
_SIGNED: Final = frozenset(datatypes.SIGNED_TYPES)
_HEARTBEAT_MS: Final = 40
_Found = TypeVar("_Found")
_EXCLUDED_FROM_RPDO: Final = (0x6040, 0x6060)


class Verdict(Enum):
    """Outcome of a check."""

    PASS = "pass"
    FAIL = "fail"
    NOT_APPLICABLE = "not applicable"


class FailedError(Exception):
    """The node deviates from the standard."""

    def __init__(self, found: str, expected: str) -> None:
        super().__init__(f"found {found}, expected {expected}")
        self.found, self.expected = found, expected


class NotApplicableError(Exception):
    """The node lacks an optional object or service required by the check."""


class AbortedError(FailedError):
    """The node refused an SDO transfer that it should have carried out."""

    def __init__(self, what: str, code: int) -> None:
        super().__init__(f"{what}: abort {code:08X}h", "the transfer is carried out")
        self.code = code


class StoppedError(HdbridgeError):
    """The user requested the end of the run."""

    exit_status = 130


@dataclass(frozen=True)
class Check:
    """One check: the requirement of the standard, its clause, and the function that tests it."""

    id: str
    text: str
    clause: str
    function: Callable[[NodeTester], None]
    moves: bool = False
    """True if the check may switch power on."""
    stores: bool = False
    """True if the check writes to non-volatile memory."""


@dataclass(frozen=True)
class Result:
    """Outcome of one check."""

    check: Check
    verdict: Verdict
    found: str
    expected: str
    duration_s: float


Object = int | tuple[int, int]
"""Index of an object, or index and sub-index."""
Step = Callable[["NodeTester"], object]
Decorator = Callable[[Step], Step]


class Table(list[Check]):
    """Checks of one subject. A check is a sequence of steps; a step that fails raises an exception.

    An object in place of a step limits the check to nodes with this object.
    """

    def __init__(self, *, drives: bool = False, moves: bool = False) -> None:
        """``drives``: the checks are for drives of CiA 402; ``moves``: each check may switch power on."""
        super().__init__()
        self._drives, self._moves = drives, moves

    def add(self, name: str, text: str, clause: str, *steps: Object | Step, stores: bool = False) -> None:
        """Adds a check."""

        def run(t: NodeTester) -> None:
            if self._drives:
                t.need_402()
            for step in steps:
                if callable(step):
                    step(t)
                else:
                    t.require(*((step,) if isinstance(step, int) else step))

        self.append(Check(name, text, clause, run, self._moves, stores))

    def rows(self, clause: str, *rows: tuple[str, str, *tuple[Object | Step, ...]]) -> None:
        """Adds checks of one clause: name, text and steps of each."""
        for name, text, *steps in rows:
            self.add(name, text, clause, *steps)

    def check(
        self, name: str, text: str, clause: str, *steps: Object | Step, stores: bool = False
    ) -> Decorator:
        """Decorates the last step of a check."""

        def decorate(function: Step) -> Step:
            self.add(name, text, clause, *steps, function, stores=stores)
            return function

        return decorate


@dataclass(frozen=True)
class Timing:
    """Time-outs and tolerances of the tests; s."""

    answer_s: float = 0.5
    """Maximum time to an SDO answer or any other immediate reaction."""
    boot_s: float = 10.0
    """Maximum time to the boot-up message, and from there to the first SDO answer."""
    power_s: float = 10.0
    """Maximum time to a transition of the power state machine, including brakes and ramps."""
    jitter_s: float = 0.02
    """Tolerance of a period, in addition to a tenth of the period."""


def _idle() -> None:
    """Does nothing."""


class NodeTester:
    """Master's side of the checks on one node.

    ``travel`` is the distance of test moves in user units; None for 0.02 motor turns (608Fh), at least 20.
    ``stopped`` is called while the tester waits; if it returns True, `StoppedError` ends the run.
    """

    def __init__(
        self,
        link: Link,
        node_id: int,
        *,
        od: ObjectDictionary | None = None,
        travel: int | None = None,
        timing: Timing | None = None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        self.link, self.node_id, self.od = link, node_id, od
        self.timing = timing or Timing()
        self.log: list[Frame] = []
        """Every frame received since the start of the current check."""
        self._travel, self._stopped = travel, stopped
        self._undo: list[tuple[int, int, bytes]] = []
        self._existing: dict[tuple[int, int], bool] = {}
        self._state_watched = False
        self.start_position: int | None = None
        """6064h before the first check."""
        self.powered = False
        """True if a controlword that may switch power on has been sent, and power has not been switched off
        since."""
        self.may_power = False
        """True during a check with permission to move."""

    # ---------------------------------------------------------------- frames and time

    @property
    def now(self) -> float:
        """Time on the link's clock; s."""
        return self.link.now()

    def send(self, can_id: int, data: bytes = b"") -> None:
        self.link.send(can_id, data)

    def send_special(self, can_id: int, data: bytes = b"", *, remote: bool = False) -> None:
        """Sends a remote frame, or a data frame with a 29-bit identifier."""
        message = can.Message(
            arbitration_id=can_id, data=None if remote else data, dlc=1 if remote else len(data),
            is_remote_frame=remote, is_extended_id=not remote, channel=self.link.mark,
        )  # fmt: skip
        self.link.bus.send(message)

    def mark(self) -> int:
        """Returns the index of the end of the log, after adding the frames that have already arrived."""
        self.wait(0.0)
        return len(self.log)

    def wait(self, duration_s: float) -> None:
        """Receives frames for this duration."""
        end_s = self.now + duration_s
        while self._received(end_s):
            pass

    def _received(self, end_s: float) -> bool:
        """Receives a frame, or waits a little; returns False once ``end_s`` has passed without a frame."""
        if self._stopped():
            raise StoppedError("the run was ended before its last check")
        frame = self.link.recv(min(end_s, self.now + 0.25))
        if frame is not None:
            self.log.append(frame)
        return frame is not None or self.now < end_s

    def heard(self, can_id: int, since: int = 0) -> list[Frame]:
        """Returns the frames with this identifier from index ``since`` of the log on."""
        return [frame for frame in self.log[since:] if frame.can_id == can_id]

    def hears(self, can_id: int, timeout_s: float | None = None, since: int | None = None) -> Frame | None:
        """Returns the first frame with this identifier from index ``since`` of the log on, by default from
        now on.

        Waits for the frame if necessary; returns None on time-out.
        """
        place = len(self.log) if since is None else since
        end_s = self.now + (self.timing.answer_s if timeout_s is None else timeout_s)
        while True:
            for frame in self.log[place:]:
                if frame.can_id == can_id:
                    return frame
            place = len(self.log)
            if not self._received(end_s):
                return None

    def heard_after(self, can_id: int, duration_s: float, act: Callable[[], object] = _idle) -> list[Frame]:
        """Calls ``act``; returns the frames with this identifier from then on, for a duration."""
        since = self.mark()
        act()
        self.wait(duration_s)
        return self.heard(can_id, since)

    def reply(
        self, can_id: int, act: Callable[[], object] = _idle, timeout_s: float | None = None
    ) -> bytes | None:
        """Calls ``act``; returns the data of the first frame with this identifier, or None on time-out."""
        since = self.mark()
        act()
        frame = self.hears(can_id, timeout_s, since)
        return None if frame is None else frame.data

    # ---------------------------------------------------------------- verdicts

    @staticmethod
    def fail(found: object, expected: object) -> NoReturn:
        """Ends the check as failed."""
        raise FailedError(str(found), str(expected))

    @staticmethod
    def equal(found: object, expected: object, what: str = "") -> None:
        """Fails unless both are equal; ``what`` names the value."""
        if found != expected:
            prefix = f"{what} " if what else ""
            raise FailedError(f"{prefix}{_text(found)}", f"{prefix}{_text(expected)}")

    @staticmethod
    def true(condition: _Found | None, found: object, expected: object) -> _Found:
        """Fails unless the condition is true; returns its value."""
        if not condition:
            raise FailedError(str(found), str(expected))
        return condition

    @staticmethod
    def need(condition: _Found | None, reason: str) -> _Found:
        """Ends the check as not applicable unless the condition is true; returns its value."""
        if not condition:
            raise NotApplicableError(reason)
        return condition

    @property
    def eds(self) -> ObjectDictionary:
        """The EDS; ends the check as not applicable if none is given."""
        return self.need(self.od, "no EDS is given")

    def near(self, found_s: float, expected_s: float, what: str) -> None:
        """Fails unless a measured period or delay is within the tolerance."""
        if abs(found_s - expected_s) > 0.1 * expected_s + self.timing.jitter_s:
            self.fail(f"{what} {1000 * found_s:.1f} ms", f"{1000 * expected_s:.1f} ms")

    # ---------------------------------------------------------------- NMT

    def nmt(self, command: int, node_id: int | None = None) -> None:
        """Sends an NMT command, to the node under test by default."""
        self.send(0x000, bytes((command, self.node_id if node_id is None else node_id)))

    def reset(self, command: int = NmtCommand.RESET_COMMUNICATION) -> Frame:
        """Resets the node and waits until it has booted and answers SDO; returns the boot-up message."""
        since = self.mark()
        self.nmt(command)
        boot = self.boot_up(since)
        self._state_watched = False
        if not self.answers(self.timing.boot_s):
            self.fail("no SDO answer after the boot-up message", f"one within {self.timing.boot_s:g} s")
        return boot

    def answers(self, duration_s: float) -> bool:
        """Returns True once the node answers an SDO request, False on time-out."""
        deadline_s = self.now + duration_s
        while self.ask(upload_request(0x1000)) is None:
            if self.now >= deadline_s:
                return False
        return True

    def boot_up(self, since: int) -> Frame:
        """Returns the boot-up message, waiting for it if necessary; fails on time-out."""
        deadline_s = self.now + self.timing.boot_s
        frame, place = None, since
        while frame is None or frame.data[:1] != b"\0":
            frame = self.hears(0x700 + self.node_id, deadline_s - self.now, place)
            if frame is None:
                self.fail("no boot-up message", f"one within {self.timing.boot_s:g} s of the reset")
            place = self.log.index(frame) + 1
        return frame

    def watch_state(self) -> None:
        """Switches the node's heartbeat on, if it has one; `state` uses node guarding otherwise."""
        if not self._state_watched and self.has(0x1017):
            self.write(0x1017, 0, _HEARTBEAT_MS, 2)
            self._state_watched = True

    def state(self) -> str:
        """Returns the NMT state in the next heartbeat, or in the answer to node guarding."""
        can_id = 0x700 + self.node_id
        request = _idle if self._state_watched else lambda: self.send_special(can_id, remote=True)
        data = self.reply(can_id, request, 4e-3 * _HEARTBEAT_MS + self.timing.answer_s)
        if data is None:
            raise NotApplicableError("the node has neither a heartbeat (1017h) nor node guarding")
        value = data[0] & 0x7F if data else -1
        return STATES.get(value, f"{value:02X}h")

    def enter(self, command: NmtCommand) -> None:
        """Sends an NMT command and checks the state that the node then reports."""
        self.watch_state()
        self.nmt(command)
        self.equal(self.state(), ENTERED[command], "NMT state")

    def be_supervised(self, time_ms: int = 100) -> None:
        """Makes the node supervise the tester's heartbeat with this time-out."""
        self.require(0x1016, 1)
        self.write(0x1016, 1, MASTER << 16 | time_ms, 4)

    def beat(self, node_id: int = MASTER) -> None:
        """Sends a heartbeat."""
        self.send(0x700 + node_id, b"\x05")

    def sync(self, counter: int | None = None) -> None:
        self.send(0x080, b"" if counter is None else bytes((counter,)))

    def emergencies(self) -> list[int]:
        """Returns the codes of all EMCY messages since the start of the check."""
        return _codes(self.heard(0x080 + self.node_id))

    def emergencies_after(self, duration_s: float, act: Callable[[], object] = _idle) -> list[int]:
        """Calls ``act``; returns the codes of the EMCY messages from then on, for a duration."""
        return _codes(self.heard_after(0x080 + self.node_id, duration_s, act))

    # ---------------------------------------------------------------- SDO

    def ask(self, request: bytes, timeout_s: float | None = None) -> bytes | None:
        """Sends an SDO request; returns the answer, or None on time-out."""
        return self.reply(0x580 + self.node_id, lambda: self.send(0x600 + self.node_id, request), timeout_s)

    def answer(self, request: bytes) -> bytes:
        """Sends an SDO request like `ask`; fails the check without an answer of eight bytes."""
        answer = self.ask(request)
        if answer is None:
            self.fail(
                f"no answer to the SDO request {request.hex(' ')}", f"one within {self.timing.answer_s:g} s"
            )
        self.equal(len(answer), 8, "length of the SDO answer")
        return answer

    def aborts(self, request: bytes, codes: tuple[int, ...], what: str = "request") -> None:
        """Fails unless the request is refused with one of the abort codes."""
        answer = self.answer(request)
        expected = abort_codes(codes)
        if answer[0] != 0x80:
            self.fail(f"{what}: answer {answer.hex(' ')}", expected)
        code = abort_code(answer)
        self.true(code in codes, f"{what}: abort {code:08X}h", expected)

    def refuses_value(self, index: int, sub: int, data: bytes, codes: tuple[int, ...]) -> None:
        """Fails unless a download is refused with one of the abort codes and the object keeps its value."""
        before = self.upload(index, sub)
        what = f"{index:04X}h:{sub:02X} = {int.from_bytes(data, 'little')}"
        try:
            self.aborts(expedited(index, sub, data), codes, what)
            self.equal(self.upload(index, sub), before, f"{index:04X}h:{sub:02X} after the refusal")
        finally:
            self._undo.append((index, sub, before))

    def refuses(self, request: bytes, what: str) -> None:
        """Fails unless the request is refused with any abort code."""
        answer = self.answer(request)
        self.true(answer[0] == 0x80, f"{what}: accepted", "an abort")

    def upload(self, index: int, sub: int = 0) -> bytes:
        """Uploads an object, expedited or segmented; raises `AbortedError` if the node refuses."""
        answer = self.answer(upload_request(index, sub))
        self._raise_abort(answer, f"upload of {index:04X}h:{sub:02X}")
        self.equal(answer[0] >> 5, 2, "command of the upload response")
        self.equal(answer[1:4], struct.pack("<HB", index, sub), "multiplexer")
        if answer[0] & 2:
            return answer[4 : 8 - (answer[0] >> 2 & 3 if answer[0] & 1 else 0)]
        data, toggle = b"", 0
        while True:
            answer = self.answer(bytes((0x60 | toggle,)) + bytes(7))
            self._raise_abort(answer, f"segment of {index:04X}h:{sub:02X}")
            self.equal(answer[0] & 0xF0, toggle, "command and toggle bit of the segment")
            data += answer[1 : 8 - (answer[0] >> 1 & 7)]
            toggle ^= 0x10
            if answer[0] & 1:
                return data

    def download(self, index: int, sub: int, data: bytes) -> None:
        """Downloads up to four bytes expedited, more in segments; raises `AbortedError` if refused."""
        what = f"download to {index:04X}h:{sub:02X}"
        if len(data) <= 4:
            self._raise_abort(self.answer(expedited(index, sub, data)), what)
            return
        self._raise_abort(self.answer(segmented(index, sub, len(data))), what)
        for place in range(0, len(data), 7):
            part = data[place : place + 7]
            command = (place // 7 & 1) << 4 | (7 - len(part)) << 1 | (place + 7 >= len(data))
            self._raise_abort(self.answer(bytes((command,)) + part.ljust(7, b"\0")), what)

    @staticmethod
    def _raise_abort(answer: bytes, what: str) -> None:
        if answer[0] == 0x80:
            raise AbortedError(what, abort_code(answer))

    def has(self, index: int, sub: int = 0) -> bool:
        """Returns True if the node has the object."""
        if (index, sub) not in self._existing:
            answer = self.answer(upload_request(index, sub))
            self._existing[index, sub] = abort_code(answer) not in ABSENT
            if answer[0] == 0x41:
                self.ask(abort(index, sub), 0.0)
        return self._existing[index, sub]

    def require(self, index: int, sub: int = 0) -> None:
        """Ends the check as not applicable if the node lacks the object."""
        self.need(self.has(index, sub), f"no object {index:04X}h:{sub:02X}")

    def read(self, index: int, sub: int = 0, *, signed: bool = False) -> int:
        """Uploads an object and returns it as an integer."""
        return int.from_bytes(self.upload(index, sub), "little", signed=signed)

    def put(self, index: int, sub: int, value: int, size: int) -> None:
        """Downloads an integer of ``size`` bytes; the change is not undone at the end of the check."""
        self.download(index, sub, pack(value, size))

    def write(self, index: int, sub: int, value: int, size: int) -> None:
        """Downloads an integer; the previous value is restored at the end of the check."""
        before = self.upload(index, sub)
        self.put(index, sub, value, size)
        self._undo.append((index, sub, before))

    # ---------------------------------------------------------------- PDO

    def has_pdo(self, first: int) -> bool:
        """Returns True if a PDO exists; ``first`` is the index of its communication parameter."""
        return self.has(first, 1) and self.has(first + 0x200, 0)

    def need_pdo(self, first: int) -> None:
        """Ends the check as not applicable if the node lacks the PDO."""
        self.need(self.has_pdo(first), f"no PDO at {first:04X}h")

    def switch_pdo_off(self, first: int) -> None:
        """Sets bit 31 of the identifier of a PDO; the bit is restored at the end of the check."""
        self.write(first, 1, self.read(first, 1) | PDO_INVALID, 4)

    def map_pdo(
        self,
        first: int,
        objects: tuple[tuple[int, int, int], ...],
        transmission: int,
        can_id: int | None = None,
        timers: dict[int, int] | None = None,
    ) -> int:
        """Configures a PDO by the procedure of CiA 301; returns its identifier.

        ``objects`` are (index, sub-index, bits); ``timers`` are values of sub-indices 3, 5 or 6.
        """
        self.need_pdo(first)
        before = self.read(first, 1)
        own = before & 0x7FF if can_id is None else can_id
        self.write(first, 1, before | PDO_INVALID, 4)
        self.write(first + 0x200, 0, 0, 1)
        for place, (index, sub, bits) in enumerate(objects, start=1):
            self.write(first + 0x200, place, index << 16 | sub << 8 | bits, 4)
        self.write(first + 0x200, 0, len(objects), 1)
        self.write(first, 2, transmission, 1)
        for sub, value in (timers or {}).items():
            self.write(first, sub, value, 1 if sub == 6 else 2)
        self.write(first, 1, before & 0x40000000 | own, 4)
        return own

    def variables(self) -> Iterator[ODVariable]:
        """Yields the entries of the EDS, if any."""
        return iter(()) if self.od is None else variables(self.od)

    def scratch(self) -> tuple[int, int, int]:
        """Returns (index, sub-index, bits) of a writable, mappable object without side effects."""
        for index in (0x6081, 0x6083, 0x607A):
            if self.od is None and self.has(index):
                return index, 0, 32
            variable = self.od[index] if self.od is not None and index in self.od else None
            if isinstance(variable, ODVariable) and variable.pdo_mappable and self.has(index):
                return index, 0, 32
        for each in self.variables():
            if (
                each.pdo_mappable
                and each.access_type in ("rw", "rww", "rwr")
                and each.data_type in datatypes.INTEGER_TYPES
                and len(each) in (8, 16, 32)
                and each.index not in _EXCLUDED_FROM_RPDO
            ):
                return each.index, each.subindex, len(each)
        raise NotApplicableError("no object is known that can be written, read and mapped without effect")

    def other_value(self, index: int, sub: int) -> int:
        """Returns a value that differs by 1 from the object's current value."""
        now = self.read(index, sub)
        return now - 1 if now > 1 else now + 1

    def change(self, index: int, sub: int, bits: int) -> int:
        """Writes a value that differs by 1, and returns it; it is undone at the end of the check."""
        value = self.other_value(index, sub)
        self.write(index, sub, value, bits // 8)
        return value

    # ---------------------------------------------------------------- CiA 402

    def need_402(self) -> None:
        """Ends the check as not applicable unless the node is a drive of CiA 402."""
        self.need(self.read(0x1000) & 0xFFFF == 402, "the device profile (1000h) is not CiA 402")

    def control(self, word: int) -> None:
        """Writes the controlword by SDO; refuses to switch power on without permission to move."""
        if word & 0x07 == 0x07 and not word & 0x80:
            if not self.may_power:
                raise AssertionError("a check without permission to move must not switch power on")
            self.powered = True
        self.put(0x6040, 0, word, 2)

    def power_state(self) -> State:
        """Returns the power state."""
        return decode(self.read(0x6041))

    def reaches(self, *states: State) -> None:
        """Waits for one of these power states; fails on time-out."""
        deadline_s = self.now + self.timing.power_s
        while decode(word := self.read(0x6041)) not in states:
            if self.now > deadline_s:
                self.fail(state_name(word), " or ".join(each.value for each in states))
            self.wait(0.005)

    def walk(self) -> None:
        """Brings the drive from SWITCH ON DISABLED to OPERATION ENABLED."""
        for state, word in ENABLING:
            self.control(word)
            self.reaches(state)

    def stays(self, state: State, duration_s: float = 0.05) -> None:
        """Fails if the power state is not ``state`` throughout this duration."""
        end_s = self.now + duration_s
        while True:
            self.equal(state_name(self.read(0x6041)), state.value, "power state")
            if self.now >= end_s:
                return
            self.wait(0.01)

    def disable(self) -> None:
        """Brings the drive to SWITCH ON DISABLED, resetting a fault if necessary."""
        self.control(0x00)
        deadline_s = self.now + self.timing.power_s
        while (state := decode(word := self.read(0x6041))) is not State.SWITCH_ON_DISABLED:
            if state is State.FAULT:
                self.control(0x80)
                self.wait(0.02)
                self.control(0x00)
            if self.now > deadline_s:
                self.fail(state_name(word), State.SWITCH_ON_DISABLED.value)
            self.wait(0.01)
        self.powered = False

    @property
    def travel(self) -> int:
        """Distance of a test move; user units."""
        if self._travel is None:
            turn = self.read(0x608F, 1) // max(self.read(0x608F, 2), 1) if self.has(0x608F, 1) else 5000
            self._travel = max(turn // 50, 20)
        return self._travel

    # ---------------------------------------------------------------- around a check

    def prepare(self, *, moves: bool) -> None:
        """Brings the node to PRE-OPERATIONAL for the next check."""
        self.log.clear()
        self.may_power = moves
        self.nmt(NmtCommand.PRE_OPERATIONAL)

    def tidy(self) -> None:
        """Undoes the changes of the check; resets the node if that fails."""
        self.send(0x600 + self.node_id, abort())  # ends a transfer that the check has left open
        self.nmt(NmtCommand.PRE_OPERATIONAL)
        try:
            if self.powered:
                self.disable()
            while self._undo:
                index, sub, data = self._undo[-1]
                self.download(index, sub, data)
                self._undo.pop()
        except FailedError:
            self._recover()
        self._undo.clear()
        self._state_watched = False

    def _recover(self) -> None:
        for command in (NmtCommand.RESET_COMMUNICATION, NmtCommand.RESET_NODE):
            self.nmt(command)
            self.wait(self.timing.jitter_s)
            self.nmt(NmtCommand.PRE_OPERATIONAL)
            if self.answers(self.timing.boot_s):
                return
        raise DriveError(
            f"node {self.node_id}: does not answer any more; expected an SDO answer after NMT reset; "
            "switch the node off and on, and look at the last check"
        )

    def abandon(self) -> None:
        """Ends an interrupted check: quick stop, power off, and reversal of the check's changes."""
        self._stopped = lambda: False
        if self.powered:
            self.send(0x600 + self.node_id, abort())
            self.send(0x600 + self.node_id, expedited(0x6040, 0, pack(0x02, 2)))
            self.link.clock.sleep_until(self.now + 0.5)
        self.tidy()


def state_name(statusword: int) -> str:
    """Returns the name of the power state in a statusword; the bits of an undefined state as hexadecimal."""
    state = decode(statusword)
    return f"{statusword & 0x6F:02X}h" if state is State.UNKNOWN else state.value


def pack(value: int, size: int) -> bytes:
    """Returns the bytes of an integer, signed if negative."""
    return value.to_bytes(size, "little", signed=value < 0)


def is_signed(variable: ODVariable) -> bool:
    """Returns True for a signed integer type."""
    return variable.data_type in _SIGNED


def expedited(index: int, sub: int, data: bytes) -> bytes:
    """Returns the request of an expedited download."""
    return struct.pack("<BHB", 0x23 | (4 - len(data)) << 2, index, sub) + data.ljust(4, b"\0")


def abort(index: int = 0, sub: int = 0) -> bytes:
    """Returns the abort message of a client."""
    return struct.pack("<BHBI", 0x80, index, sub, 0x08000000)


def upload_request(index: int, sub: int = 0) -> bytes:
    """Returns the request of an upload."""
    return struct.pack("<BHB4x", 0x40, index, sub)


def segmented(index: int, sub: int, size: int) -> bytes:
    """Returns the request that begins a segmented download of ``size`` bytes."""
    return struct.pack("<BHBI", 0x21, index, sub, size)


def abort_code(answer: bytes) -> int:
    """Returns the abort code in an SDO answer; 0 for any other answer."""
    return int.from_bytes(answer[4:], "little") if answer[0] == 0x80 else 0


def abort_codes(codes: tuple[int, ...]) -> str:
    """Returns the abort codes as text, for example "abort 06010002h or 06010000h"."""
    return f"abort {' or '.join(f'{code:08X}h' for code in codes)}"


def _codes(emergencies: list[Frame]) -> list[int]:
    return [struct.unpack_from("<H", each.data)[0] for each in emergencies if len(each.data) == 8]


def _text(value: object) -> str:
    return value.hex(" ") if isinstance(value, bytes) else str(value)
