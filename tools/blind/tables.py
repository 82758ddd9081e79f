"""Tables of a blind suite: rates from the verdicts on its cases."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Callable, Iterable, Sequence

from blind.verdict import Verdict
from proportions import proportion

BINS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.99, 1.0001)
NEAR = 0.05
"""Relative tolerance within which a claimed gain counts as correct."""
EFFECTS = ((0.0, 0.3), (0.3, 1.0), (1.0, 3.0), (3.0, math.inf))
"""Bin edges: rms of a cause over the noise of a reading."""
LONG = 30_000
"""Number of samples from which the program start is a negligible part of the run time."""
CALIBRATION = ("stated probability", "mean", "right")
"""Head of the table of `calibration`."""
Test = Callable[[Verdict], bool]
Pair = tuple[float, bool]


def rate(hits: Iterable[bool]) -> str:
    """``hits / all (per cent; 95 % interval)``; a dash for none."""
    every = list(hits)
    return proportion(sum(every), len(every))


def wrong_first(verdict: Verdict) -> bool:
    """True if a wrong name leads."""
    return verdict.first == "wrong"


def right_first(verdict: Verdict) -> bool:
    """True if the right name or an alias leads."""
    return verdict.first == "right"


def unexplained_first(verdict: Verdict) -> bool:
    """True if ``unexplained`` leads."""
    return verdict.first == "unexplained"


def false_name(verdict: Verdict) -> bool:
    """True if an absent cause is named."""
    return bool(verdict.wrong)


def everyday(verdicts: Sequence[Verdict]) -> list[tuple[str, str, str]]:
    """Returns the figures of everyday records: (quantity, figure, goal)."""
    healthy = [each for each in verdicts if each.kind in {"healthy_bench", "healthy_work"}]
    faults = [each for each in verdicts if each.kind == "fault"]
    law = [each for each in verdicts if each.kind == "law"]
    outside = [each for each in verdicts if each.kind == "outside"]
    rows: list[tuple[str, str, str]] = []

    def add(what: str, chosen: Iterable[Verdict], test: Test, goal: str = "") -> None:
        rows.append((what, rate(map(test, chosen)), goal))

    for kind, words in (("healthy_bench", "healthy, bench"), ("healthy_work", "healthy, work")):
        mine = [each for each in healthy if each.kind == kind]
        add(f"{words}: false name", mine, false_name, "at most 1 %")
        add(f"{words}: unexplained leads", mine, unexplained_first, "at most 2 %")
        add(f"{words}: ordinary dynamics named", mine, lambda each: each.ordinary)
    detectable = [each for each in faults if each.detectable]
    add("one fault, reported detectable: right first", detectable, right_first, "at least 90 %")
    add("one fault, reported detectable: wrong first", detectable, wrong_first, "at most 1 %")
    add("one fault: wrong first", faults, wrong_first, "at most 1 %")
    add("one fault: right first", faults, right_first)
    add("one fault: right first, without its alias", faults, lambda each: each.first_names_it)
    add("one fault: unexplained leads", faults, unexplained_first)
    add("one fault: nothing named", faults, lambda each: each.first == "nothing")
    add("one fault: a wrong name in addition", filter(right_first, faults), false_name)
    add("one fault: reported detectable", faults, lambda each: bool(each.detectable))
    add("another law: a name but hysteresis_memory", law, false_name, "at most 2 %")
    add("another law: unexplained leads", law, unexplained_first)
    add("another law: hysteresis_memory", law, lambda each: bool(each.met))
    add("unknown cause: unexplained leads", outside, unexplained_first)
    add("unknown cause: a name in its place", outside, wrong_first)
    add("unknown cause: a name given", outside, false_name)
    rows += _pairs([each for each in verdicts if each.pair])
    return rows


def _pairs(verdicts: Sequence[Verdict]) -> list[tuple[str, str, str]]:
    """Compares fine flickering encoders with the same axis at 16 bits."""
    by_pair: dict[str, dict[bool, Verdict]] = {}
    for each in verdicts:
        by_pair.setdefault(each.pair, {})[each.flicker_counts > 0.0] = each
    both = [(each[True], each[False]) for each in by_pair.values() if len(each) == 2]
    return [
        ("flicker: false name on the fine encoder alone", rate(f.wrong > () == c.wrong for f, c in both), ""),
        ("flicker: false name at 16 bits alone", rate(c.wrong > () == f.wrong for f, c in both), ""),
        ("flicker: another first answer", rate(f.first != c.first for f, c in both), "none"),
    ]


def bench(verdicts: Sequence[Verdict]) -> list[tuple[str, str, str]]:
    """Returns the figures of the bench suite: (quantity, figure, goal)."""
    by_kind: dict[str, list[Verdict]] = {}
    for each in verdicts:
        by_kind.setdefault(each.kind, []).append(each)
    single, law, unknown = (by_kind.get(kind, []) for kind in ("single", "other_law", "unknown"))
    none = by_kind.get("none", [])
    several = [*by_kind.get("pair", []), *by_kind.get("triple", [])]
    return [
        ("single: right first", rate(map(right_first, single)), "99 %"),
        ("single: right first, without its alias", rate(each.first_names_it for each in single), ""),
        ("single: wrong first", rate(map(wrong_first, single)), ""),
        ("single: nothing named", rate(each.first == "nothing" for each in single), ""),
        ("single: nothing false in addition", rate(not each.wrong for each in single), "98 %"),
        ("nothing hidden: silent", rate(each.first == "nothing" for each in none), "99 %"),
        (
            "another law: silent or hysteresis_memory",
            rate(each.first in {"nothing", "right"} and not each.wrong for each in law),
            "98 %",
        ),
        ("unknown: unexplained leads", rate(map(unexplained_first, unknown)), "95 %"),
        ("unknown: a name given", rate(map(false_name, unknown)), ""),
        *(
            row
            for kind, goal in (("pair", "97 %"), ("triple", "95 %"))
            for row in _several(kind, by_kind.get(kind, []), goal)
        ),
        ("two or three at once: all found", rate(len(v.met) == len(v.hidden) for v in several), ""),
    ]


def _several(kind: str, verdicts: Sequence[Verdict], goal: str) -> list[tuple[str, str, str]]:
    hidden = [cause in each.met for each in verdicts for cause in each.hidden]
    named = [right for each in verdicts for right in [True] * len(each.met) + [False] * len(each.wrong)]
    return [(f"{kind}: recall", rate(hidden), goal), (f"{kind}: precision", rate(named), goal)]


def common(verdicts: Sequence[Verdict]) -> list[tuple[str, str, str]]:
    """Returns the figures of every suite: (quantity, figure, goal)."""
    compared = [each for verdict in verdicts for each in verdict.compared]
    pairs = probabilities(verdicts)
    sure = [right for chance, right in pairs if chance >= 0.95]
    gains = [each.fresh_gain for each in verdicts if each.fresh_gain is not None]
    left = [each.fresh_left for each in verdicts if each.fresh_left is not None]
    rows = [
        ("truth inside the 95 % interval", rate(each.covered for each in compared), "93 to 97 %"),
        ("parameters: relative error, median", _median([each.error for each in compared]), ""),
        ("probability of 0.95 and more: right", rate(sure), "97 %"),
        ("a finding's gain holds on a fresh record", rate(abs(each - 1.0) <= NEAR for each in gains), "all"),
        ("what was stated to be left holds there", rate(abs(each - 1.0) <= NEAR for each in left), "all"),
        (
            "a name is missing from the written model",
            rate(each in verdict.unwritten for verdict in verdicts for each in verdict.named),
            "none",
        ),
        ("refused", rate(each.refused for each in verdicts), ""),
        ("failed", rate(bool(each.failed) for each in verdicts), "none"),
        ("run time, s: median", _median([each.seconds for each in verdicts]), ""),
        (
            "run time, s for 100,000 samples: median of the long",
            _median([1e5 * each.seconds / each.samples for each in verdicts if each.samples >= LONG]),
            "4",
        ),
    ]
    if pairs:
        rows.insert(3, (*brier(pairs), ""))
    return rows


def probabilities(verdicts: Sequence[Verdict]) -> list[Pair]:
    """Returns, for each reported cause, its stated probability and whether the cause was correct."""
    return [pair for each in verdicts for pair in each.probabilities]


def brier(pairs: Sequence[Pair]) -> tuple[str, str]:
    """Returns the Brier score of the findings: (quantity, figure)."""
    score = statistics.fmean((chance - right) ** 2 for chance, right in pairs)
    base = statistics.fmean(right for _, right in pairs)
    words = f"Brier score of the names; {base * (1.0 - base):.3f} if all had the same probability"
    return words, f"{score:.3f} of {len(pairs)}"


def _median(values: Iterable[float | None]) -> str:
    there = [each for each in values if each is not None and not math.isnan(each)]
    return f"{statistics.median(there):.3g} of {len(there)}" if there else "-"


def calibration(pairs: Sequence[Pair]) -> list[tuple[str, str, str]]:
    """Returns probabilities by bin: (bin, mean probability, share that was right)."""
    rows = []
    for low, high in itertools.pairwise(BINS):
        inside = [(chance, right) for chance, right in pairs if low <= chance < high]
        if inside:
            mean = statistics.fmean(chance for chance, _ in inside)
            rows.append((f"{low:g} to {min(high, 1.0):g}", f"{mean:.3f}", rate(hit for _, hit in inside)))
    return rows


def by_effect(verdicts: Sequence[Verdict]) -> list[list[str]]:
    """Tabulates everyday faults by their rms in the record over the noise of a reading."""
    rows = []
    for low, high in EFFECTS:
        mine = [each for each in verdicts if each.effect_over_noise is not None]
        mine = [
            each for each in mine if each.sort == "fault" and low <= (each.effect_over_noise or 0.0) < high
        ]
        tests: tuple[Test, ...] = (lambda each: bool(each.detectable), right_first, wrong_first)
        rows.append([f"{low:g} to {high:g}", *(rate(map(test, mine)) for test in tests)])
    return rows


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def page(verdicts: Sequence[Verdict], seed: int, cases: bool = False) -> str:
    """Returns all tables; with ``cases`` also the errors of each case."""
    held = "development" if cases or seed < 1000 else "held out"
    parts = [
        f"{len(verdicts)} cases of seed {seed} ({held}); in brackets per cent and Wilson's 95 % interval"
    ]
    for family, figures in (("everyday", everyday), ("bench suite", bench)):
        mine = [each for each in verdicts if each.family == family]
        if not mine:
            continue
        rows = [row for row in (*figures(mine), *common(mine)) if row[1] != "-"]
        parts += [f"## {family.capitalize()}", table(("figure", "", "goal"), rows)]
        if chances := calibration(probabilities(mine)):
            parts.append(table(CALIBRATION, chances))
        if family == "everyday":
            head = ("reported detectable", "right first", "wrong first")
            parts.append(table(("fault's rms over noise", *head), by_effect(mine)))
    if cases:
        parts += _cases(verdicts)
    return "\n\n".join(parts) + "\n"


def _cases(verdicts: Sequence[Verdict]) -> Iterable[str]:
    outside = [
        (
            each.case,
            f"`{one.cause}` {one.name}",
            f"{one.true:.5g}",
            f"{one.found:.5g}",
            f"{one.low:.5g} to {one.high:.5g}",
        )
        for each in verdicts
        for one in each.compared
        if not one.covered
    ]
    if outside:
        yield table(("case", "parameter outside its interval", "truth", "value", "interval"), outside)
    wrong = [
        (each.case, ", ".join(each.hidden) or "-", ", ".join(each.named) or "-", _missed(each))
        for each in verdicts
        if _missed(each)
    ]
    if wrong:
        yield table(("case", "hidden", "named", "what went wrong"), wrong)


def _missed(verdict: Verdict) -> str:
    missed = [each for each in verdict.hidden if each not in verdict.met and each != "unexplained"]
    said = [verdict.failed, f"missed {', '.join(missed)}" if missed else ""]
    said.append(f"wrong {', '.join(verdict.wrong)}" if verdict.wrong else "")
    said.append(f"not written: {', '.join(verdict.unwritten)}" if verdict.unwritten else "")
    if "unexplained" in verdict.hidden and verdict.first != "unexplained":
        said.append("not called unexplained")
    if "unexplained" not in verdict.hidden and verdict.first == "unexplained":
        said.append("unexplained leads")
    return "; ".join(each for each in said if each)
