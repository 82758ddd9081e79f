"""A bring-up: its list of checks run in order, and the state that they share."""

from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, Generic, TypeVar

import can
from canopen.objectdictionary import ObjectDictionary

from hdbridge.axis import AxisConfig
from hdbridge.clock import Clock
from hdbridge.commissioning.bringup import TORQUE_PERCENT
from hdbridge.commissioning.bringup.slow import SlowAxis
from hdbridge.control.cycle import Feedback
from hdbridge.drive.drive import Drive
from hdbridge.drive.states import State
from hdbridge.errors import DriveError, HdbridgeError

P = TypeVar("P")
Figure = float | int | str | bool | None


class Outcome(Enum):
    """Outcome of a check."""

    PASS = "pass"
    FAIL = "fail"
    NOT_POSSIBLE = "not possible"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of one check."""

    outcome: Outcome
    measured: str
    """Measured result as text, with figures and units."""
    remedies: tuple[str, ...] = ()
    """On failure: lines of the axis file to change, or actions, the likeliest first."""
    figures: Mapping[str, Figure] = field(default_factory=dict)
    """Measured figures as data, with units in the names."""
    error: type[HdbridgeError] = DriveError
    """Error class of the failure, which decides the exit status."""


def passed(measured: str, **figures: Figure) -> Verdict:
    """Returns a pass."""
    return Verdict(Outcome.PASS, measured, (), figures)


def failed(measured: str, *remedies: str, **figures: Figure) -> Verdict:
    """Returns a failure with its remedies."""
    return Verdict(Outcome.FAIL, measured, remedies, figures)


def not_possible(why: str) -> Verdict:
    """Returns the verdict of a check that could not be made."""
    return Verdict(Outcome.NOT_POSSIBLE, why)


@dataclass(frozen=True, slots=True)
class Check(Generic[P]):
    """One row of a list of checks."""

    name: str
    """One word that identifies the check in data."""
    title: str
    """Subject of the check, in a few words."""
    run: Callable[[P], Verdict]
    needs: tuple[str, ...] = ()
    """Names of checks that must have passed before."""
    moves: bool = False
    """True if the check switches power on."""


@dataclass(frozen=True, slots=True)
class Row(Generic[P]):
    """A check and its verdict."""

    check: Check[P]
    verdict: Verdict

    def as_dict(self) -> dict[str, Any]:
        """Returns the row as data."""
        return {
            "name": self.check.name,
            "title": self.check.title,
            "outcome": self.verdict.outcome.value,
            "measured": self.verdict.measured,
            "remedies": list(self.verdict.remedies),
            "figures": dict(self.verdict.figures),
        }


def run_checks(
    subject: P,
    checks: Iterable[Check[P]],
    *,
    permitted: Callable[[], str | None] = lambda: None,
    tell: Callable[[Row[P]], None] = lambda _: None,
) -> list[Row[P]]:
    """Runs the checks in order; ``tell`` receives each row as soon as it is complete.

    A check whose dependencies have not passed is not possible. ``permitted`` is called once, before the first
    check that moves the axis; a returned text is the reason why nothing may move. A `HdbridgeError` is a
    failure of the check that raised it; all other exceptions pass through.
    """
    rows: list[Row[P]] = []
    outcomes: dict[str, Outcome] = {}
    titles: dict[str, str] = {}
    refusal: str | None = None
    asked = False
    for check in checks:
        lacking = [each for each in check.needs if outcomes.get(each) is not Outcome.PASS]
        if lacking:
            named = ", ".join(f"'{titles.get(each, each)}'" for each in lacking)
            verdict = not_possible(f"needs {named}, which did not pass")
        else:
            if check.moves and not asked:
                asked, refusal = True, permitted()
            verdict = not_possible(refusal) if check.moves and refusal else _run(check, subject)
        outcomes[check.name], titles[check.name] = verdict.outcome, check.title
        row = Row(check, verdict)
        rows.append(row)
        tell(row)
    return rows


def _run(check: Check[P], subject: P) -> Verdict:
    try:
        return check.run(subject)
    except HdbridgeError as error:
        notes = tuple(getattr(error, "__notes__", ()))
        return replace(failed(str(error), *notes), error=type(error))


Connect = Callable[["AxisConfig"], AbstractContextManager[tuple["can.BusABC", Clock]]]
"""Opens an axis's bus and returns it with its clock."""
Interruptible = Callable[[], AbstractContextManager[Callable[[], bool]]]
"""Context that defers interrupts; the function that it yields reports if there was one."""


class BringUpContext(ExitStack):
    """One axis under examination; a context manager that leaves the drive off and the bus closed.

    ``load`` reads the axis file and ``connect`` opens its bus; both are checks, so they are passed as
    functions. ``torque_percent`` limits every motion, percent of the rated torque, in addition to the axis
    file's own limit. With ``force``, frames are sent even if another master is heard on the bus.
    """

    def __init__(
        self,
        load: Callable[[], AxisConfig],
        connect: Connect,
        *,
        torque_percent: float = TORQUE_PERCENT,
        force: bool = False,
        interruptible: Interruptible = lambda: nullcontext(lambda: False),
    ) -> None:
        super().__init__()
        self.load = load
        self.torque_percent = torque_percent
        self.interruptible = interruptible
        self.began_deg = 0.0
        """Motor angle before the axis was moved, degrees."""
        self.noise_arcsec = 0.0
        """Noise of the load encoder at rest, arcsec."""
        self.confirmed: set[str] = set()
        """Keys of the axis file that the drive's own objects confirm."""
        self.out: list[Feedback] = []
        """Feedback of the long forward move, and of the standstill at its end."""
        self.rest_begins = 0
        self._connect = connect
        self._force = force
        self._axis: AxisConfig | None = None
        self._od: ObjectDictionary | None = None
        self._drive: Drive | None = None

    def admit(self, axis: AxisConfig, od: ObjectDictionary) -> None:
        """Stores the axis file and the EDS after they have been read."""
        self._axis, self._od = axis, od

    def connect(self) -> None:
        """Opens the bus; sends nothing yet. Raises `BusError`."""
        bus, clock = self.enter_context(self._connect(self.axis))
        self._drive = self.enter_context(Drive(bus, self.axis, clock, self._od, force=self._force))

    @property
    def axis(self) -> AxisConfig:
        """The axis file."""
        assert self._axis is not None, "checks that need the files come after them"
        return self._axis

    @property
    def drive(self) -> Drive:
        """The drive, not necessarily booted."""
        assert self._drive is not None, "checks that need the bus come after it"
        return self._drive

    def boot(self) -> Drive:
        """Reboots the drive, resets a fault left by an earlier check, and returns it switched off."""
        report = self.drive.boot()
        if report.state in (State.FAULT, State.FAULT_REACTION_ACTIVE):
            self.drive.fault_reset()
        return self.drive

    def slow(self, interrupted: Callable[[], bool]) -> SlowAxis:
        """Returns the axis for slow motion, freshly booted and still switched off."""
        return SlowAxis(self.boot(), self.torque_percent, interrupted)
