"""Summary of a fleet: joints to inspect first, prevalence of causes, and faults of the data.

On everyday records, the diagnosis of one recording reports too many causes for a list that people act on. A
joint is listed only if a cause repeats over its recordings more often than the fleet's own rate of false
findings explains, and if it appeared after the first recording or grows.
"""

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np

from hdbridge.analysis.intervals import NORMAL_95
from hdbridge.fleet.statistics import (
    Interval,
    Repeats,
    Series,
    identities,
    normal_range,
    outliers,
    prevalence,
    repeats,
    trends,
    within_false_discoveries,
)

SCHEMA: Final = "hdbridge.fleet-summary/1"
FALSE_DISCOVERIES: Final = 0.01
"""Maximum expected fraction of wrong entries in the list of joints to inspect."""
COMMON: Final = 0.4
"""Fraction of a gear type's joints above which a cause is typical of the gear and listed only if it grows."""
SURE: Final = 0.95
REPEATED: Final = 2
"""Minimum number of recordings with a finding of the cause."""
PEAK_ERROR: Final = 0.25
"""Standard deviation of a small peak, as a fraction of its detection limit."""
SILENT: Final = 3.0
"""Time without a recording after which a joint is silent, as a multiple of its median recording interval."""
ATTRIBUTES: Final = ("batch", "cell", "lubricant")
Row = Mapping[str, Any]


@dataclass(frozen=True)
class Candidate:
    """A joint to inspect, with its cause."""

    joint: str
    cause: str
    probability: float
    """Probability that the joint has the cause, from all its recordings and the fleet's rates."""
    aliases: tuple[str, ...]
    peak_arcsec: float
    """Peak of the cause in the latest recording with a finding."""
    named: int
    recordings: int
    growth: Interval | None
    """Growth of the peak, arcsec per 1000 hours; None without operating hours."""
    growing: bool
    remaining: Interval | None
    """Hours until the peak reaches the limit; None if unknown."""
    what_changed: tuple[str, ...]
    remarks: tuple[str, ...]
    path: str
    """Path of the joint's last recording."""
    gear: str


@dataclass(frozen=True)
class Outlier:
    """Quantity of a joint that is outside the normal range of its gear type."""

    joint: str
    gear: str
    figure: str
    value: float
    normal: Interval


@dataclass(frozen=True)
class MismatchedRecording:
    """Recording whose orders differ from its joint's first recording."""

    joint: str
    path: str
    kind: str
    text: str


@dataclass(frozen=True)
class Summary:
    """Content of a fleet page."""

    recordings: int
    joints: int
    limit_arcsec: float
    first: tuple[Candidate, ...]
    prevalence: Mapping[str, Mapping[str, Mapping[str, tuple[int, int, Interval]]]]
    """Number of joints with the cause, number of joints, and prevalence, by attribute, cause and group."""
    rates: Mapping[str, tuple[float, float, float]]
    """Fraction of joints with the cause, and rates of findings in joints with and without it, by cause."""
    odd: tuple[Outlier, ...]
    mistaken: tuple[MismatchedRecording, ...]
    duplicates: tuple[tuple[str, str, str], ...]
    """Joint and path of each duplicate, and path of the original."""
    silent: tuple[tuple[str, str], ...]
    """Joints without current information, each with the reason."""
    failed: tuple[tuple[str, str, str], ...]
    """Joint and path of each recording without a diagnosis, and the reason."""

    def as_dict(self) -> dict[str, Any]:
        """Returns the summary for JSON, schema hdbridge.fleet-summary/1."""
        return {"schema": SCHEMA, **asdict(self)}

    def lines(self) -> Iterator[str]:
        """Yields one line for each kind of fault in the data."""
        yield from counted(self.mistaken)
        for words, found in (
            ("duplicate recordings", self.duplicates),
            ("joints without a usable or a fresh recording", self.silent),
            ("recordings without a diagnosis", self.failed),
        ):
            if found:
                yield f"{words}: {len(found)}"


def counted(mistaken: Sequence[MismatchedRecording]) -> Iterator[str]:
    """Yields the number of mistaken recordings of each kind, as text."""
    for kind, count in Counter(each.kind for each in mistaken).items():
        yield f"recordings {_KINDS[kind]}: {count}"


_KINDS: Final = {
    "swapped": "of another joint than they are filed under",
    "turned": "after the motor encoder was exchanged or its zero set",
    "changed": "with orders unlike those of the joint's first recording",
}


def summarise(rows: Sequence[Row], limit_arcsec: float) -> Summary:
    """Summarises the recordings of a data set (`Dataset.recordings`)."""
    joints, mistaken = own_recordings(rows)
    causes = sorted({each["cause"] for own in joints.values() for row in own for each in row["findings"]})
    found = {cause: occurrence(joints, cause) for cause in causes}
    first = _first(joints, found, _figures(joints), limit_arcsec)
    explained = {each.joint for each in first}
    mistaken = tuple(each for each in mistaken if each.kind != "changed" or each.joint not in explained)
    return Summary(
        recordings=len(rows),
        joints=len({row["joint"] for row in rows if row["joint"]}),
        limit_arcsec=limit_arcsec,
        first=first,
        prevalence=_prevalence(joints, found),
        rates={cause: (each.share, each.named, each.wrongly) for cause, (each, _) in found.items()},
        odd=_odd(joints),
        mistaken=mistaken,
        duplicates=tuple(
            (row["joint"], row["path"], row["duplicate_of"]) for row in rows if row["duplicate_of"]
        ),
        silent=_silent(rows),
        failed=tuple((row["joint"], row["path"], row["reason"]) for row in rows if row["reason"] is not None),
    )


def own_recordings(rows: Sequence[Row]) -> tuple[dict[str, list[Row]], tuple[MismatchedRecording, ...]]:
    """Returns each joint's own diagnosed recordings in time order, without duplicates, and mistaken ones."""
    good = [row for row in rows if row["reason"] is None and row["duplicate_of"] is None]
    good.sort(key=_when)
    mistaken, foreign = _mistaken(good)
    joints: dict[str, list[Row]] = defaultdict(list)
    for row in good:
        if (row["key"], row["path"]) not in foreign:
            joints[row["joint"]].append(row)
    return joints, mistaken


def _when(row: Row) -> tuple[float, str, str]:
    return (row["hours"] if row["hours"] is not None else -1.0, row["date"] or "", row["path"])


def _mistaken(good: Sequence[Row]) -> tuple[tuple[MismatchedRecording, ...], set[tuple[str, str]]]:
    """Returns the mistaken recordings, and key and path of those that no other result uses."""
    result: list[MismatchedRecording] = []
    foreign: set[tuple[str, str]] = set()
    gears: dict[str, list[Row]] = defaultdict(list)
    for row in good:
        gears[f"{row['gear']}"].append(row)
    for rows in gears.values():
        names = sorted({row["joint"] for row in rows})
        numbers = {name: number for number, name in enumerate(names)}
        count = max((len(row["orders"] or ()) for row in rows), default=0)
        orders = np.full((len(rows), count), np.nan + 0j)
        for place, row in enumerate(rows):
            if count and len(row["orders"] or ()) == count:
                orders[place] = [complex(each["cos_arcsec"], -each["sin_arcsec"]) for each in row["orders"]]
        found = identities(orders, [numbers[row["joint"]] for row in rows], [_when(row) for row in rows])
        for row, each in zip(rows, found, strict=True):
            if each is None:
                continue
            if each.kind == "swapped":
                assert each.other is not None
                text = f"its orders are those of {names[each.other]}"
            elif each.kind == "turned":
                text = f"all its orders are turned by {each.angle_deg:.1f} deg of the motor: fit a new model"
            else:
                text = "its orders are neither those of the joint's first recording nor another joint's"
            result.append(MismatchedRecording(row["joint"], row["path"], each.kind, text))
            if each.kind != "changed":
                foreign.add((row["key"], row["path"]))
    return tuple(result), foreign


def occurrence(joints: Mapping[str, Sequence[Row]], cause: str) -> tuple[Repeats, set[str]]:
    """Returns the estimated rates of a cause, and the joints that have it."""
    named = [[named_by(row, cause) is not None for row in rows] for rows in joints.values()]
    found = repeats(named)
    probable = zip(joints, named, found.probability.tolist(), strict=True)
    return found, {joint for joint, own, share in probable if share > 0.5 and sum(own) >= REPEATED}


def grouped(joints: Mapping[str, Sequence[Row]], attribute: str) -> dict[str, list[str]]:
    """Returns the joints by their group of an attribute, in order of the groups' names."""
    groups: dict[str, list[str]] = defaultdict(list)
    for joint, rows in joints.items():
        if rows[-1][attribute] is not None:
            groups[rows[-1][attribute]].append(joint)
    return dict(sorted(groups.items()))


def named_by(row: Row, cause: str) -> Mapping[str, Any] | None:
    """Returns a recording's finding of a cause, or None."""
    return next((each for each in row["findings"] if each["cause"] == cause), None)


def _peak(row: Row, cause: str) -> float | None:
    found = named_by(row, cause)
    return found["peak_arcsec"] if found else None


def _floor(row: Row, cause: str) -> float:
    """Returns the smallest peak of a cause that the diagnosis of a recording would report, arcsec."""
    limit = next((each["arcsec"] for each in row["limits"] or () if each["cause"] == cause), None)
    return limit if limit is not None else max(row["rms_arcsec"] or 0.0, 1.0)


def _size(rows: Sequence[Row], cause: str) -> Series:
    """Returns the peak of a cause over the hours; without a finding, half the detection limit."""
    points = []
    for row in rows:
        peak, floor = _peak(row, cause), _floor(row, cause)
        if peak is not None:
            points.append((row, peak, max(PEAK_ERROR * floor, 0.02 * peak)))
        else:  # 0.29: standard deviation of a uniform distribution of width 1
            points.append((row, 0.5 * floor, 0.29 * floor))
    return _series(points)


def _series(points: Sequence[tuple[Row, float, float]]) -> Series:
    """Returns values and standard deviations over the hours; recordings without hours are left out."""
    known = [each for each in points if each[0]["hours"] is not None]
    hours, value, sd = np.array([(row["hours"], *own) for row, *own in known]).reshape(-1, 3).T
    warm = [row["temperature_c"] for row, _, _ in known]
    return Series(hours, value, sd, np.array(warm) if warm and None not in warm else None)


def _figures(joints: Mapping[str, Sequence[Row]]) -> dict[str, list[tuple[float, str]]]:
    """Returns, by joint, the strength of each significant trend of a model parameter, and its text."""
    table: dict[str, dict[str, list[tuple[Row, float, float]]]] = defaultdict(lambda: defaultdict(list))
    for name, rows in joints.items():
        for row in rows:
            for each in row["figures"] or ():
                effect, _, parameter = each["name"].partition(".")
                if (
                    effect in {"synchronous", "hysteresis"}
                    and each["half_width"] > 0.0
                    and not parameter.endswith("phase_deg")
                ):
                    table[each["name"]][name].append((row, each["value"], each["half_width"] / NORMAL_95))
    result: dict[str, list[tuple[float, str]]] = defaultdict(list)
    for figure, of_joint in table.items():
        found = trends([_series(points) for points in of_joint.values()])
        for name, trend in zip(of_joint, found, strict=True):
            if trend is not None and trend.changing > SURE and abs(trend.growing() - 0.5) > SURE - 0.5:
                slope = trend.per_1000_hours
                strength = abs(slope.value) / max(slope.high - slope.low, 1e-12)
                result[name].append((strength, f"{figure} {slope.value:+.2g} per 1000 h"))
    return result


def _first(
    joints: Mapping[str, Sequence[Row]],
    occurrences: Mapping[str, tuple[Repeats, set[str]]],
    changed: Mapping[str, Sequence[tuple[float, str]]],
    limit_arcsec: float,
) -> tuple[Candidate, ...]:
    claims: list[Candidate] = []
    for cause, (found, _) in occurrences.items():
        probabilities = found.probability.tolist()
        common = _common(joints, probabilities)
        of_joint = trends([_size(rows, cause) for rows in joints.values()])
        for (name, rows), probability, trend in zip(joints.items(), probabilities, of_joint, strict=True):
            named = [row for row in rows if _peak(row, cause) is not None]
            recent = any(_peak(row, cause) is not None for row in rows[-2:])
            if len(named) < REPEATED or not recent:
                continue
            growing = trend is not None and trend.growing() >= SURE and trend.changing >= SURE
            last = next(each for each in named[-1]["findings"] if each["cause"] == cause)
            # A cause of this size would have been found in the first recording.
            seen = last["peak_arcsec"] > (1.0 + 2.0 * PEAK_ERROR) * _floor(rows[0], cause)
            appeared = _peak(rows[0], cause) is None and seen and not common[rows[-1]["gear"]]
            if not growing and not appeared:
                continue
            claims.append(
                Candidate(
                    joint=name,
                    cause=cause,
                    probability=probability,
                    aliases=tuple(last["aliases"] or ()),
                    peak_arcsec=last["peak_arcsec"],
                    named=len(named),
                    recordings=len(rows),
                    growth=trend.per_1000_hours if trend else None,
                    growing=growing,
                    remaining=trend.hours_to(limit_arcsec) if trend and growing else None,
                    what_changed=tuple(text for _, text in sorted(changed.get(name, ()), reverse=True)[:2]),
                    remarks=tuple(rows[-1]["remarks"] or ()),
                    path=rows[-1]["path"],
                    gear=rows[-1]["gear"],
                )
            )
    kept = within_false_discoveries(np.array([each.probability for each in claims]), FALSE_DISCOVERIES)
    chosen: dict[str, Candidate] = {}
    for each, keep in zip(claims, kept.tolist(), strict=True):
        # One line for each joint: its other causes are consequences, or can wait for the first repair.
        if keep and (each.joint not in chosen or _weight(each) > _weight(chosen[each.joint])):
            chosen[each.joint] = each
    return tuple(sorted(chosen.values(), key=_urgency))


def _common(joints: Mapping[str, Sequence[Row]], probabilities: Sequence[float]) -> dict[str, bool]:
    shares: dict[str, list[float]] = defaultdict(list)
    for rows, probability in zip(joints.values(), probabilities, strict=True):
        shares[rows[-1]["gear"]].append(probability)
    return {gear: float(np.mean(each)) > COMMON for gear, each in shares.items()}


def _weight(each: Candidate) -> tuple[bool, float]:
    return (each.cause != "unexplained", each.peak_arcsec * each.probability)


def _urgency(each: Candidate) -> tuple[float, float, str]:
    return (each.remaining.value if each.remaining else float("inf"), -each.peak_arcsec, each.joint)


def _prevalence(
    joints: Mapping[str, Sequence[Row]], occurrences: Mapping[str, tuple[Repeats, set[str]]]
) -> dict[str, dict[str, dict[str, tuple[int, int, Interval]]]]:
    result: dict[str, dict[str, dict[str, tuple[int, int, Interval]]]] = {}
    for attribute in ATTRIBUTES:
        groups = grouped(joints, attribute)
        if len(groups) < 2:
            continue
        result[attribute] = {}
        for cause, (_, sick) in occurrences.items():
            cases = {group: (len(sick.intersection(own)), len(own)) for group, own in groups.items()}
            if any(count for count, _ in cases.values()):
                shares = prevalence(cases)
                result[attribute][cause] = {group: (*cases[group], shares[group]) for group in cases}
    return result


def _odd(joints: Mapping[str, Sequence[Row]]) -> tuple[Outlier, ...]:
    """Returns the quantities with a median over a joint's recordings outside its gear type's normal range."""
    table: dict[tuple[str, str], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for name, rows in joints.items():
        for row in rows:
            for each in row["orders"] or ():
                figure = f"order {each['order']}, arcsec"
                table[row["gear"], figure][name].append(
                    float(np.hypot(each["cos_arcsec"], each["sin_arcsec"]))
                )
            for each in row["figures"] or ():
                if each["name"] in {"hysteresis.offset_arcsec", "hysteresis.width_deg"}:
                    table[row["gear"], each["name"]][name].append(each["value"])
    found = []
    for (gear, figure), of_joint in table.items():
        values = np.array([float(np.median(each)) for each in of_joint.values()])
        chosen = outliers(values)
        if not chosen.any():
            continue
        normal = normal_range(values)
        for name, value, odd in zip(of_joint, values.tolist(), chosen.tolist(), strict=True):
            if odd:
                found.append(Outlier(name, gear, figure, value, normal))
    return tuple(sorted(found, key=lambda each: -abs(each.value - each.normal.value)))


def _silent(rows: Sequence[Row]) -> tuple[tuple[str, str], ...]:
    """Returns the joints without a usable recording, or without one for a long time, with the reason."""
    usable: dict[str, list[datetime]] = {row["joint"]: [] for row in rows if row["joint"]}
    diagnosed = {row["joint"] for row in rows if row["reason"] is None}
    for row in rows:
        if row["reason"] is None and row["date"]:
            try:
                date = datetime.fromisoformat(row["date"])
            except ValueError:
                continue
            usable[row["joint"]].append(date if date.tzinfo else date.replace(tzinfo=UTC))
    newest = max((each for dates in usable.values() for each in dates), default=None)
    result = []
    for joint, dates in sorted(usable.items()):
        if joint not in diagnosed:
            result.append((joint, "no usable recording"))
        elif newest is not None and len(set(dates)) > 1:
            days = np.diff(sorted(each.timestamp() for each in set(dates))) / 86_400.0
            since = (newest - max(dates)).total_seconds() / 86_400.0
            if since > SILENT * float(np.median(days)):
                result.append(
                    (
                        joint,
                        f"no recording for {since:.0f} days; one in {float(np.median(days)):.0f} is usual",
                    )
                )
    return tuple(result)
