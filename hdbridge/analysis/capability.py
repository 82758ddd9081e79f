"""Capability of a record: the causes that it can show, and those that it cannot, in one sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from hdbridge.analysis.driving import settling
from hdbridge.analysis.identification import GENTLE_DEG_S2
from hdbridge.analysis.prepared import Observed, Samples
from hdbridge.analysis.scales import Scales
from hdbridge.axis.effects import CATALOGUE, Channel, Effect
from hdbridge.axis.effects.carried import loop_of
from hdbridge.units import DEG_PER_TURN, rounded

SAMPLES_PER_WIDTH: Final = 4
"""Minimum number of samples over the width of a loop in slow motion: one more than the number of loop
parameters."""
COMPLETE: Final = ("slow motion", "reversals", "rests")
CERTAINTY: Final = ((0.9, ""), (0.6, "probably "), (0.0, "perhaps "))
"""Lower limits of the probability of a cause, each with the qualifier used above that limit."""


def certainty(probability: float) -> str:
    """Returns the qualifier for a cause of this probability, with a trailing space; empty above 0.9."""
    return next((word for least, word in CERTAINTY if probability > least), CERTAINTY[-1][1])


@dataclass(frozen=True, slots=True)
class Identifiability:
    """Detectability of a cause in a record, and the causes from which it is not separable."""

    detectable: bool
    detection_limit_arcsec: float | None
    """Smallest peak that would be reported; None if the cause is invisible."""
    aliases: tuple[str, ...]
    """Causes that are not separable from this cause in the record."""
    share_left: float
    """Fraction of the cause's sum of squares that the baseline cannot absorb."""
    reason: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Returns the JSON object."""
        limit = self.detection_limit_arcsec
        data: dict[str, Any] = {
            **asdict(self),
            "detection_limit_arcsec": None if limit is None else rounded(limit),
            "aliases": list(self.aliases),
            "share_left": rounded(self.share_left, 3),
        }
        return {name: each for name, each in data.items() if name != "reason" or each}


@dataclass(frozen=True, slots=True)
class Capability:
    """Subjects of the catalogue that a record can show, derived from the identifiability of their causes."""

    lacks: tuple[str, ...]
    """Kinds of motion and channels that the record does not have."""
    identified: tuple[str, ...]
    """Subjects with a cause that is detectable and separable from all other subjects."""
    confused: tuple[tuple[str, ...], ...]
    """Groups of subjects, each a detectable subject and those that are not separable from it."""
    unseen: tuple[str, ...]
    """Subjects without a detectable cause."""
    most: float
    """Highest probability that a cause can reach in such a record."""

    def as_dict(self) -> dict[str, Any]:
        """Returns the JSON object."""
        return {
            "sentence": self.sentence(),
            "lacks": list(self.lacks),
            "identified": list(self.identified),
            "confused": [list(each) for each in self.confused],
            "unseen": list(self.unseen),
            "largest_probability": self.most,
        }

    def sentence(self) -> str:
        """Returns the summary sentence that precedes a diagnosis."""
        seldom = len(self.identified) > len(self.unseen) + len(self.confused)
        can = "all else" if seldom else listed(self.identified, "and")
        cannot = listed(self.unseen, "and")
        identified = f"can {certainty(self.most)}be identified"
        parts = [] if seldom or not can else [f"{can} {identified}"]
        if cannot:
            parts.append(f"{cannot} cannot" + ("" if parts else " be identified"))
        verb = "cannot be separated"
        for first, *others in self.confused:
            parts.append(f"{first} {verb} from {listed(others, 'or')}")
            verb = "not"
        if seldom:
            parts.append(f"{can if parts else 'all causes'} {identified}")
        return f"This record has {listed(self.lacks or COMPLETE, 'and')}: {', '.join(parts)}."


def listed(words: Sequence[str], last: str) -> str:
    """Joins words into a list: a, b and c."""
    return "".join(words) if len(words) < 2 else f"{', '.join(words[:-1])} {last} {words[-1]}"


def capability(
    data: Observed,
    base: Sequence[Effect],
    causes: Mapping[str, Identifiability],
    scales: Scales,
) -> Capability:
    """Summarises the identifiability of all causes for a record and a model ``base``."""
    one_way = scales.one_way_repeated if data.full.repeated else scales.one_way
    subject = {name: CATALOGUE[name].about.subject or name.replace("_", " ") for name in causes}
    subjects = tuple(dict.fromkeys(subject.values()))
    alike: dict[str, list[set[str]]] = {}
    for name, each in causes.items():
        if each.detectable:
            others = {subject[other] for other in each.aliases} - {subject[name]}
            alike.setdefault(subject[name], []).append(others)
    separable = {name for name, others in alike.items() if not all(others)}
    groups: list[set[str]] = []
    hidden = alike.keys() - separable
    for name in hidden:
        group = {name}.union(*alike[name])
        joined = [each for each in groups if each & group & hidden]
        groups = [each for each in groups if each not in joined] + [group.union(*joined)]

    def order(name: str) -> tuple[bool, bool, int]:
        return name in separable, name not in alike, subjects.index(name)

    return Capability(
        lacks=tuple(_lacks(data, base, causes)),
        identified=tuple(each for each in subjects if each in separable),
        confused=tuple(sorted(tuple(sorted(each, key=order)) for each in groups)),
        unseen=tuple(each for each in subjects if each not in alike),
        most=scales.surest if data.reversals >= 2 else one_way,
    )


def _lacks(data: Observed, base: Sequence[Effect], causes: Mapping[str, Identifiability]) -> list[str]:
    """Returns the kinds of motion that a record lacks, and the channels that invisible causes require."""
    full = data.full
    travel_deg = float(sum(np.ptp(full.motor_deg[each.rows]) for each in full.chains))
    width_deg = loop_of(base).width_deg
    lacks = []
    if _slow_travel_deg(full, width_deg) < width_deg:
        lacks.append("no slow motion")
    if data.reversals < 2:
        lacks.append("one reversal" if data.reversals else "no reversals")
    if not data.standstill:
        lacks.append("no rests")
    if travel_deg < DEG_PER_TURN:
        lacks.append("no whole motor turn")
    unseen = {name for name, each in causes.items() if not each.detectable}
    needed = {channel for name in unseen for channel in CATALOGUE[name].channels}
    missing = needed - full.motion.available() - {Channel.LOAD_ANGLE}
    return lacks + [f"no {each.about}" for each in Channel if each in missing]


def _slow_travel_deg(samples: Samples, width_deg: float) -> float:
    """Returns the motor travel, degrees, that is slow and sampled densely enough to show a loop's shape."""
    speed, acceleration = samples.speed_deg_s, samples.motion.motor_acceleration_deg_s2
    assert acceleration is not None
    steps = np.diff(samples.time_s, append=samples.time_s[-1])
    steps[[each.rows.stop - 1 for each in samples.chains]] = 0.0
    travel = np.abs(speed * steps)
    slow = ~settling(np.abs(acceleration) > GENTLE_DEG_S2 * samples.ratio, samples.time_s)
    return float(np.sum(travel[slow & (travel < width_deg / SAMPLES_PER_WIDTH)]))
