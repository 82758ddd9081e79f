"""Commands the drive by SDO, outside the control cycle: walks through its power states and waits for the
statusword.

While waiting, it fulfils the master's duties: it processes heartbeats and emergencies, and `MasterHeartbeat`
sends the master's own heartbeat, because the drive stops without it.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Final

from hdbridge.cia301 import NmtState, wrap_int32
from hdbridge.drive import objects
from hdbridge.drive.emergencies import error_name
from hdbridge.drive.image import ProcessImage
from hdbridge.drive.link import Frame, Link
from hdbridge.drive.monitor import NetworkMonitor
from hdbridge.drive.objects import Mode
from hdbridge.drive.sdo import SdoClient
from hdbridge.drive.standstill import STANDSTILL_S, Standstill
from hdbridge.drive.states import FAULTS, Command, State, controlword_for, decode, states_on_the_way
from hdbridge.errors import RESET, DriveError, TransitionError

STEP_TIMEOUT_S: Final = 1.0
"""Maximum duration of one state transition or change of mode; s."""
BRAKE_TIMEOUT_S: Final = 3.0
POLL_S: Final = 0.005
_MAY_BE_ENABLED: Final = (State.SWITCHED_ON, State.OPERATION_ENABLED)


class MasterHeartbeat:
    """Heartbeat of the master outside the control cycle, sent while its user waits for frames."""

    def __init__(self, link: Link, image: ProcessImage) -> None:
        self._link, self._image = link, image
        self._due_s = 0.0
        self.on = False
        """True while the drive monitors the master, which must then not pause the heartbeat."""

    def recv(self, deadline_s: float) -> Frame | None:
        """Receives like `Link.recv`, and sends the heartbeat whenever it is due."""
        link = self._link
        if not self.on:
            return link.recv(deadline_s)
        while True:
            if link.now() >= self._due_s:
                link.send(self._image.heartbeat_id, bytes((NmtState.OPERATIONAL,)))
                self._due_s = link.now() + self._image.heartbeat_period_s
            frame = link.recv(min(deadline_s, self._due_s))
            if frame is not None or link.now() >= deadline_s:
                return frame


class Commander:
    """SDO access to the statusword and the controlword of one drive."""

    def __init__(self, link: Link, monitor: NetworkMonitor, sdo: SdoClient, image: ProcessImage) -> None:
        self.link = link
        self.monitor = monitor
        self.sdo = sdo
        self.image = image
        self.axis = image.axis

    @property
    def name(self) -> str:
        """Name of the drive, for messages."""
        return f"node {self.sdo.node_id} on {self.link.name}"

    def statusword(self) -> int:
        return self.sdo.fetch(objects.STATUSWORD)

    def state(self) -> State:
        """Reads the state and updates the image's power walk with it."""
        statusword = self.statusword()
        self.image.statusword = statusword
        return self.image.power.observe(statusword)

    def control(self, controlword: int) -> None:
        """Writes the controlword.

        *Enable operation* could restart the motion of a drive that has stopped on its own. It is therefore
        sent only to a drive that is switched on or enabled, and is not repeated without an answer. Raises
        `DriveError` otherwise.
        """
        enables = controlword & Command.ENABLE_OPERATION.mask == Command.ENABLE_OPERATION.word
        if enables and (state := decode(self.statusword())) not in _MAY_BE_ENABLED:
            if state in FAULTS:
                raise self.fault("before 'enable operation'")
            raise DriveError(
                f"{self.name}: is in '{state.value}' before 'enable operation'; look at its error display"
            )
        self.sdo.store(objects.CONTROLWORD, controlword, attempts=1 if enables else None)

    def pause(self, duration_s: float) -> None:
        """Waits, and receives frames meanwhile."""
        end_s = self.link.now() + duration_s
        while self.link.now() < end_s:
            if (frame := self.sdo.recv(end_s)) is not None:
                self.monitor.dispatch(frame)

    def wait_for(
        self, what: str, done: Callable[[int], bool], timeout_s: float, *, allow_fault: bool = False
    ) -> int:
        """Polls the statusword until ``done(statusword)`` is true, and returns it.

        Raises `DriveError` on a fault unless ``allow_fault``, and `TransitionError` on time-out.
        """
        deadline_s = self.link.now() + timeout_s
        while True:
            statusword = self.statusword()
            if done(statusword):
                return statusword
            if not allow_fault and decode(statusword) in FAULTS:
                raise self.fault(f"while waiting for {what}")
            if self.link.now() >= deadline_s:
                raise TransitionError(
                    f"{self.name}: {what} did not occur within {timeout_s:g} s; the drive is in "
                    f"'{decode(statusword).value}' (statusword {statusword:04X}h); check its enable input, "
                    "supply and error display"
                )
            self.pause(POLL_S)

    def fault_words(self) -> str:
        """Returns error code and last emergency of a drive in fault, as text."""
        code = self.sdo.fetch(objects.ERROR_CODE) if self.sdo.has(objects.ERROR_CODE.index) else None
        last = self.monitor.watch(self.sdo.node_id).last_error
        details = [
            f"error code {code:04X}h, {error_name(code)}" if code is not None else "",
            str(last) if last else "",
        ]
        return ", ".join(filter(None, details)) or "no error code is known"

    def fault(self, when: str) -> DriveError:
        """Returns the error for a drive in fault."""
        return DriveError(
            f"{self.name}: fault {when} ({self.fault_words()}); remove the cause (the drive's manual "
            f"explains the code), then reset the fault: {RESET}"
        )

    def walk(self, target: State) -> None:
        """Walks to a state, one controlword at a time; the statusword must confirm each step."""
        state = self.state()
        self.image.power.go(target)
        if state is State.NOT_READY_TO_SWITCH_ON:
            self._await_state(State.SWITCH_ON_DISABLED)
            state = State.SWITCH_ON_DISABLED
        path = list(states_on_the_way(state, target))
        for here, there in pairwise(path):
            self.control(controlword_for(here, target))
            self._await_state(there)
        self.state()

    def _await_state(self, state: State) -> None:
        self.wait_for(f"state '{state.value}'", lambda word: decode(word) is state, STEP_TIMEOUT_S)

    def set_mode(self, mode: Mode) -> None:
        """Sets the mode of operation and waits until 6061h reports this mode."""
        self.sdo.store(objects.MODE, mode)
        deadline_s = self.link.now() + STEP_TIMEOUT_S
        while (shown := self.sdo.fetch(objects.MODE_DISPLAY)) != mode:
            if self.link.now() >= deadline_s:
                raise DriveError(
                    f"{self.sdo.describe(0x6061, 0)}: shows {shown} after mode {mode.value} ({mode.name}) "
                    "was set; the drive does not take the mode now"
                )
            self.pause(POLL_S)

    def preload_target(self) -> int:
        """Sets the target to the actual position (motor counts), so that enabling moves nothing."""
        actual = self.sdo.fetch(objects.POSITION_ACTUAL)
        self.sdo.store(objects.TARGET_POSITION, wrap_int32(actual))
        found = self.sdo.fetch(objects.TARGET_POSITION)
        if found != actual:
            raise DriveError(
                f"{self.sdo.describe(0x607A, 0)}: was written {actual}, the actual position, but reads back "
                f"{found}; the drive was not enabled, because it would move"
            )
        return actual

    def wait_for_standstill(self) -> bool:
        """Waits until the motor stands still; returns False on time-out."""
        deadline_s = self.link.now() + BRAKE_TIMEOUT_S
        standstill = Standstill(self.axis)
        while not standstill.take(self.sdo.fetch(objects.POSITION_ACTUAL), self.link.now()):
            if self.link.now() >= deadline_s:
                return False
            self.pause(STANDSTILL_S)
        return True

    def quick_stop(self) -> State:
        """Commands a quick stop and waits until the drive reacts; returns the resulting state."""
        self.image.power.quick_stop()
        self.control(0x0002)
        stopped = (State.QUICK_STOP_ACTIVE, State.SWITCH_ON_DISABLED, *FAULTS)
        word = self.wait_for(
            "a quick stop", lambda word: decode(word) in stopped, STEP_TIMEOUT_S, allow_fault=True
        )
        return self.image.power.observe(word)
