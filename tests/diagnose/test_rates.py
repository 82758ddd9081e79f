"""Tests of the rate at which the hidden cause is reported first, and of the rate of false findings.

A single record proves little, so the claim is a rate, with which the count over random records must agree.
Each run uses a few records; the slow tests and the blind suites use more.
"""

from __future__ import annotations

from collections.abc import Iterable

import pytest
from support.filters import least
from support.trials import CAUSES, NONE, PAIRS, SPECIAL, UNKNOWN, Verdict, planted, verdict

from hdbridge.analysis.diagnosis import diagnose

MORE = range(1, 5)
"""Seeds of the slow tests."""


def judged(names: Iterable[str], seeds: Iterable[int]) -> dict[str, Verdict]:
    """Returns the verdict on each name with each seed."""
    verdicts = {}
    for name in names:
        for seed in seeds:
            there, record, model = planted(name, seed)
            found = diagnose(record, model).findings
            verdicts[f"{name} {seed}"] = verdict(
                name, there, {each.cause: set(each.aliases) for each in found}
            )
    return verdicts


def holds(verdicts: dict[str, Verdict], rate: float, good: str) -> None:
    """Checks that as many verdicts are ``good`` (a `Verdict` member, or ``silent``) as the rate allows."""
    bad = [
        (name, each)
        for name, each in verdicts.items()
        if not (not each.wrong if good == "silent" else getattr(each, good))
    ]
    assert len(verdicts) - len(bad) >= least(len(verdicts), rate), bad


def test_a_hidden_cause_is_named_first() -> None:
    verdicts = judged(CAUSES[::11], [1])
    holds(verdicts, 0.95, "first_right")
    holds(verdicts, 0.95, "silent")


def test_nothing_is_named_if_nothing_is_hidden() -> None:
    holds(judged(NONE[1:2], [1]), 0.98, "silent")


@pytest.mark.slow
def test_the_rates_over_all_causes() -> None:
    verdicts = judged([*CAUSES, *SPECIAL], MORE)
    holds(verdicts, 0.95, "first_right")
    holds(verdicts, 0.95, "silent")


@pytest.mark.slow
def test_rates_for_two_hidden_causes() -> None:
    verdicts = judged(PAIRS, MORE)
    holds(verdicts, 0.9, "all_right")
    holds(verdicts, 0.9, "silent")


@pytest.mark.slow
def test_rates_for_healthy_and_unknown() -> None:
    holds(judged(NONE, MORE), 0.98, "silent")
    holds(judged(UNKNOWN, MORE), 0.9, "unexplained")
