"""The tables of a blind suite, from the verdicts on its cases."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Iterable, Sequence

from blindscore import Verdict


def percent(hits: Iterable[bool]) -> str:
    """``hits / all (percent)``; a dash for none."""
    every = list(hits)
    return f"{sum(every)} / {len(every)} ({100.0 * sum(every) / len(every):.0f} %)" if every else "-"


def summary(verdicts: Sequence[Verdict]) -> list[tuple[str, str]]:
    """The figures of the suite, as (what, figure)."""
    by_kind: dict[str, list[Verdict]] = {}
    for each in verdicts:
        by_kind.setdefault(each.kind, []).append(each)
    single = by_kind.get("single", [])
    several = [*by_kind.get("pair", []), *by_kind.get("triple", [])]
    rows = [
        ("single: right name or right alias set first", percent(each.first_is_right for each in single)),
        ("single: right name first, without its alias", percent(each.first_names_it for each in single)),
        ("single: wrong name first, of all", percent(_wrong_first(each) for each in single)),
        ("single: nothing named", percent(not each.named for each in single)),
        ("single: a wrong name beside", percent(bool(each.wrong) and each.first_is_right for each in single)),
        ("none, law of the model: false name", percent(bool(v.named) for v in by_kind.get("none", []))),
        ("none, law of the model: unexplained", percent(v.unexplained for v in by_kind.get("none", []))),
        ("none, another law: false name", percent(bool(v.named) for v in by_kind.get("other_law", []))),
        ("none, another law: unexplained", percent(v.unexplained for v in by_kind.get("other_law", []))),
        ("unknown: unexplained", percent(v.unexplained for v in by_kind.get("unknown", []))),
        ("unknown: unexplained leads", percent(v.unexplained_leads for v in by_kind.get("unknown", []))),
        ("unknown: a name given", percent(bool(v.named) for v in by_kind.get("unknown", []))),
        (
            "no torque channel: right alias set first",
            percent(v.first_is_right for v in by_kind.get("no_torque", [])),
        ),
        ("two or three at once: recall", _recall(several)),
        ("two or three at once: precision", _precision(several)),
        ("two or three at once: all found", percent(len(v.met) == len(v.hidden) for v in several)),
        (
            "two or three at once: truth within the 95 % interval",
            percent(c.covered for v in several for c in v.compared),
        ),
        ("share recovered on held-out data, median", _median([v.recovered for v in single])),
        ("left over after extension / noise, median", _median([v.rms_over_noise for v in single])),
        ("parameters: relative error, median", _median([c.error for v in single for c in v.compared])),
        (
            "parameters: truth within the 95 % interval",
            percent(c.covered for v in single for c in v.compared),
        ),
        ("probability: mean off what it should be", _calibration_error(verdicts)),
        ("run time, s: median", _median([v.seconds for v in verdicts])),
        ("run time, s: highest", f"{max((v.seconds for v in verdicts), default=math.nan):.1f}"),
        ("failed", percent(bool(v.failed) for v in verdicts)),
    ]
    return [(what, figure) for what, figure in rows if figure != "-"]


def _wrong_first(verdict: Verdict) -> bool:
    return bool(verdict.named) and not verdict.first_is_right and not verdict.unexplained_leads


def _recall(several: Sequence[Verdict]) -> str:
    there = sum(len(each.hidden) for each in several)
    return f"{sum(len(each.met) for each in several) / there:.2f} of {there}" if there else "-"


def _precision(several: Sequence[Verdict]) -> str:
    named = sum(len(each.named) for each in several)
    return f"{1.0 - sum(len(each.wrong) for each in several) / named:.2f} of {named}" if named else "-"


def _median(values: Iterable[float | None]) -> str:
    there = [each for each in values if each is not None and not math.isnan(each)]
    return f"{statistics.median(there):.3g} of {len(there)}" if there else "-"


BINS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.99, 1.0001)


def calibration(verdicts: Sequence[Verdict]) -> list[tuple[str, str, str]]:
    """Probabilities by bin: (bin, mean probability, share that was right)."""
    pairs = [pair for each in verdicts for pair in each.probabilities]
    rows = []
    for low, high in itertools.pairwise(BINS):
        inside = [(chance, right) for chance, right in pairs if low <= chance < high]
        if inside:
            mean = statistics.fmean(chance for chance, _ in inside)
            rows.append((f"{low:g} to {min(high, 1.0):g}", f"{mean:.3f}", percent(hit for _, hit in inside)))
    return rows


def _calibration_error(verdicts: Sequence[Verdict]) -> str:
    pairs = [pair for each in verdicts for pair in each.probabilities]
    off = 0.0
    for low, high in itertools.pairwise(BINS):
        inside = [(chance, right) for chance, right in pairs if low <= chance < high]
        if inside:
            off += abs(sum(chance - right for chance, right in inside))
    return f"{off / len(pairs):.3f} of {len(pairs)}" if pairs else "-"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def by_cause(verdicts: Sequence[Verdict]) -> list[list[str]]:
    """Single causes, a row each: right, what else was said, recovered, parameters."""
    rows = []
    single = [each for each in verdicts if each.kind == "single"]
    for cause in dict.fromkeys(each.hidden[0] for each in single):
        mine = [each for each in single if each.hidden[0] == cause]
        compared = [each for verdict in mine for each in verdict.compared]
        said = sorted({name for each in mine for name in each.wrong} | _nothing(mine))
        rows.append(
            [
                f"`{cause}`",
                percent(each.first_is_right for each in mine),
                ", ".join(said) or "-",
                _median([each.recovered for each in mine]),
                _median([each.error for each in compared]),
                percent(each.covered for each in compared),
            ]
        )
    return rows


def _nothing(verdicts: Sequence[Verdict]) -> set[str]:
    said = {"(unexplained)" for each in verdicts if each.unexplained}
    return said | {"(nothing)" for each in verdicts if not each.named and not each.unexplained}


def power(verdicts: Sequence[Verdict]) -> list[list[str]]:
    """Right names by cause and size over the noise."""
    mine = [each for each in verdicts if each.kind == "power"]
    ratios = sorted({each.over_noise for each in mine if each.over_noise is not None})
    causes = dict.fromkeys(each.hidden[0] for each in mine)
    rows = [
        [f"`{cause}`"]
        + [
            percent(v.first_is_right for v in mine if v.hidden[0] == cause and v.over_noise == ratio)
            for ratio in ratios
        ]
        for cause in causes
    ]
    rows += [["all"] + [percent(v.first_is_right for v in mine if v.over_noise == ratio) for ratio in ratios]]
    return [["cause", *(f"{ratio:g} x noise" for ratio in ratios)], *rows] if mine else []


def page(verdicts: Sequence[Verdict]) -> str:
    """All tables."""
    parts = [f"{len(verdicts)} cases", table(("figure", ""), summary(verdicts))]
    causes = by_cause(verdicts)
    if causes:
        head = ("hidden alone", "right", "else said", "recovered", "parameter error", "in the interval")
        parts.append(table(head, causes))
    powers = power(verdicts)
    if powers:
        parts.append(table(powers[0], powers[1:]))
    chances = calibration(verdicts)
    if chances:
        parts.append(table(("probability", "mean", "right"), chances))
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
        head = ("case", "parameter outside its interval", "truth", "value", "interval")
        parts.append(table(head, outside))
    wrong = [
        (each.case, ", ".join(each.hidden) or "-", ", ".join(each.named) or "-", each.failed or _missed(each))
        for each in verdicts
        if each.failed or _missed(each)
    ]
    if wrong:
        parts.append(table(("case", "hidden", "named", "what went wrong"), wrong))
    return "\n\n".join(parts) + "\n"


def _missed(verdict: Verdict) -> str:
    missed = [each for each in verdict.hidden if each not in verdict.met and each != "unexplained"]
    said = []
    if missed:
        said.append(f"missed {', '.join(missed)}")
    if verdict.wrong:
        said.append(f"wrong {', '.join(verdict.wrong)}")
    if "unexplained" in verdict.hidden and not verdict.unexplained:
        said.append("not called unexplained")
    return "; ".join(said)
