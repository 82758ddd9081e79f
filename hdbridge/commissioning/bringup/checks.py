"""Ordered list of checks: each has an outcome, and may depend on other checks."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, Generic, TypeVar

from hdbridge.errors import DriveError, HdbridgeError, SafetyStop

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
    """Measured result as text, with values and units."""
    remedies: tuple[str, ...] = ()
    """On failure: lines of the axis file to change, or actions, most likely first."""
    figures: Mapping[str, Figure] = field(default_factory=dict)
    """Measured values as data, with units in the names."""
    error: type[HdbridgeError] = DriveError
    """Error class of the failure, which determines the exit status."""


def passed(measured: str, **figures: Figure) -> Verdict:
    """Returns a verdict of success."""
    return Verdict(Outcome.PASS, measured, (), figures)


def failed(measured: str, *remedies: str, **figures: Figure) -> Verdict:
    """Returns a verdict of failure with its remedies."""
    return Verdict(Outcome.FAIL, measured, remedies, figures)


def judged(is_right: bool, measured: str, *remedies: str, **figures: Figure) -> Verdict:
    """Returns a verdict of success, or of failure with the remedies."""
    return passed(measured, **figures) if is_right else failed(measured, *remedies, **figures)


def not_possible(why: str) -> Verdict:
    """Returns the verdict of a check that could not be performed."""
    return Verdict(Outcome.NOT_POSSIBLE, why)


@dataclass(frozen=True, slots=True)
class Check(Generic[P]):
    """One row of a list of checks."""

    name: str
    """Word that identifies the check in data."""
    title: str
    """Subject of the check, as shown to the user."""
    run: Callable[[P], Verdict]
    needs: tuple[str, ...] = ()
    """Names of the checks that must have passed first."""
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
    notify: Callable[[Row[P]], None] = lambda _: None,
) -> list[Row[P]]:
    """Runs the checks in order; ``notify`` receives each row as soon as it is complete.

    A check whose dependencies have not all passed is not run; its outcome is `Outcome.NOT_POSSIBLE`.
    ``permitted`` is called once, before the first check that moves the axis; if it returns a text, no check
    moves the axis, and the text is given as the reason. After a check that ended in a `SafetyStop`, no other
    moves the axis either. A check that raises an `HdbridgeError` has failed; all other exceptions propagate.
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
        if issubclass(verdict.error, SafetyStop):
            asked, refusal = True, f"the axis stopped at a fault in '{check.title}'; remove it and run again"
        row = Row(check, verdict)
        rows.append(row)
        notify(row)
    return rows


def _run(check: Check[P], subject: P) -> Verdict:
    try:
        return check.run(subject)
    except HdbridgeError as error:
        notes = tuple(getattr(error, "__notes__", ()))
        return replace(failed(str(error), *notes), error=type(error))
