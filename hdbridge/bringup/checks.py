"""A list of checks run in order: what a check is, what it can say, and which ones it needs before it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, Generic, TypeVar

from hdbridge.errors import DriveError, HdbridgeError

P = TypeVar("P")
Figure = float | int | str | bool | None


class Outcome(Enum):
    """How a check ended."""

    PASS = "pass"
    FAIL = "fail"
    NOT_POSSIBLE = "not possible"


@dataclass(frozen=True, slots=True)
class Verdict:
    """What one check found."""

    outcome: Outcome
    measured: str
    """What was found, in words, with figures and units."""
    remedies: tuple[str, ...] = ()
    """On failure: lines of the axis file to change (``file:line:column: key: found, expected``), or what to
    do; the likeliest first."""
    figures: Mapping[str, Figure] = field(default_factory=dict)
    """The same for machines, units in the names."""
    error: type[HdbridgeError] = DriveError
    """Kind of the failure; it decides the exit status."""


def passed(measured: str, **figures: Figure) -> Verdict:
    """The check passed."""
    return Verdict(Outcome.PASS, measured, (), figures)


def failed(measured: str, *remedies: str, **figures: Figure) -> Verdict:
    """The check failed, and what to do about it."""
    return Verdict(Outcome.FAIL, measured, remedies, figures)


def not_possible(why: str) -> Verdict:
    """The check could not be made."""
    return Verdict(Outcome.NOT_POSSIBLE, why)


@dataclass(frozen=True, slots=True)
class Check(Generic[P]):
    """One row of a list of checks."""

    name: str
    """One word, for machines."""
    title: str
    """What is checked, in a few words."""
    run: Callable[[P], Verdict]
    needs: tuple[str, ...] = ()
    """Names of checks that must have passed before."""
    moves: bool = False
    """Whether power is switched on."""


@dataclass(frozen=True, slots=True)
class Row(Generic[P]):
    """A check and its verdict."""

    check: Check[P]
    verdict: Verdict

    def as_dict(self) -> dict[str, Any]:
        """For machines."""
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
    """Run the checks in order; ``tell`` receives each row as soon as it is there.

    A check whose needs have not passed is not possible. ``permitted`` is asked once, before the first check
    that moves: a text is the reason why nothing may move. An error that hdbridge raises on purpose is a
    failure of the check in which it was raised; every other one passes through.
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
