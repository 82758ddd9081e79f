"""Compares what a diagnosis says with what was hidden: one verdict by case, then the figures of a suite.

Only the published JSON of ``hdbridge diagnose`` is read. A finding *meets* a hidden cause when it names it,
or gives it as an alias. What hidden.yaml calls ``also`` is really there too: to name it is neither right nor
wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

Data = Mapping[str, Any]
UNEXPLAINED = "unexplained"


@dataclass(frozen=True)
class Compared:
    """A parameter that is in both: the finding's and the truth's."""

    cause: str
    name: str
    found: float
    low: float
    high: float
    true: float

    @property
    def error(self) -> float:
        """Relative error."""
        return abs(self.found - self.true) / max(abs(self.true), 1e-12)

    @property
    def covered(self) -> bool:
        """Whether the interval has the truth in it."""
        return self.low <= self.true <= self.high


@dataclass(frozen=True)
class Verdict:
    """One case judged."""

    case: str
    kind: str
    over_noise: float | None
    hidden: tuple[str, ...]
    named: tuple[str, ...]
    """Causes named, most important first; not those that are there anyway."""
    met: tuple[str, ...]
    """Hidden causes that were named or given as an alias."""
    first_is_right: bool
    first_names_it: bool
    """Right without the help of an alias."""
    wrong: tuple[str, ...]
    """Named, but not there."""
    unexplained: bool
    unexplained_leads: bool
    seconds: float
    samples: int
    probabilities: tuple[tuple[float, bool], ...] = ()
    compared: tuple[Compared, ...] = ()
    recovered: float | None = None
    rms_over_noise: float | None = None
    """What the extended model leaves, over the noise floor that the diagnosis states."""
    failed: str = ""
    law: str = ""


def judged(hidden: Data, diagnosis: Data | None, seconds: float, failed: str = "") -> Verdict:
    """The verdict on a case; ``diagnosis`` is None where the command failed."""
    causes = tuple(each["cause"] for each in hidden["hidden"])
    known = tuple(each for each in causes if each != UNEXPLAINED)
    also = set(hidden["also"])
    findings = list((diagnosis or {}).get("findings", ()))
    relevant = [each for each in findings if _meets(each, known) or each["cause"] not in also]
    named = [each for each in relevant if each["cause"] != UNEXPLAINED]
    met: list[str] = []
    wrong: list[str] = []
    right: list[bool] = []
    for each in named:
        new = [cause for cause in _names(each) if cause in known and cause not in met]
        met += new[:1]
        right.append(bool(new))
        if not new:
            wrong.append(each["cause"])
    first = named[0] if named and relevant[0] is named[0] else None
    return Verdict(
        case=hidden["case"],
        kind=hidden["kind"],
        over_noise=hidden.get("over_noise"),
        hidden=causes,
        named=tuple(each["cause"] for each in named),
        met=tuple(met),
        first_is_right=first is not None and _meets(first, known),
        first_names_it=first is not None and first["cause"] in known,
        wrong=tuple(wrong),
        unexplained=any(each["cause"] == UNEXPLAINED for each in findings),
        unexplained_leads=bool(relevant) and relevant[0]["cause"] == UNEXPLAINED,
        seconds=seconds,
        samples=int(hidden["samples"]),
        probabilities=tuple(
            (float(each["probability"]), hit) for each, hit in zip(named, right, strict=True)
        ),
        compared=tuple(_compared(hidden, named)),
        recovered=_recovered(hidden, named, known, _floor(hidden, diagnosis)),
        rms_over_noise=_left(diagnosis, _floor(hidden, diagnosis)),
        failed=failed,
        law=str(hidden.get("law", "")),
    )


def _names(finding: Data) -> list[str]:
    return [finding["cause"], *finding.get("aliases", ())]


def _meets(finding: Data, causes: Iterable[str]) -> bool:
    return any(cause in _names(finding) for cause in causes)


def _floor(hidden: Data, diagnosis: Data | None) -> float:
    """The noise floor as the diagnosis has it (it may work on means of samples), else that of a reading."""
    return float((diagnosis or {}).get("noise_floor_arcsec") or hidden["noise_arcsec"])


def _recovered(hidden: Data, named: list[Data], known: tuple[str, ...], floor_arcsec: float) -> float | None:
    """Share of the explainable variance on held-out data that a single right finding takes away."""
    if len(hidden["hidden"]) != 1 or not named or not _meets(named[0], known):
        return None
    gain = named[0].get("gain") or {}
    before = gain.get("held_out_rms_before_arcsec")
    after = gain.get("held_out_rms_after_arcsec")
    floor = min(floor_arcsec, float(after or 0.0))
    if before is None or after is None or before**2 - floor**2 <= 0.0:
        return None
    return float((before**2 - after**2) / (before**2 - floor**2))


def _left(diagnosis: Data | None, floor_arcsec: float) -> float | None:
    left = ((diagnosis or {}).get("extended") or {}).get("rms_arcsec")
    return None if left is None else float(left) / floor_arcsec


Conversion = tuple[str, str, Callable[[float], float]]


def _same(value: float) -> float:
    return value


def _negative(value: float) -> float:
    return -value


# By cause: a parameter's name in a finding (in braces a number of the secret), its name in hidden.yaml, and
# what makes the finding's number one of the same unit. Names that are not in a finding are passed over, so
# spellings may stand side by side.
COMPARABLE: Mapping[str, tuple[Conversion, ...]] = {
    "motor_order": (("order_{order:.0f}_amplitude_arcsec", "amplitude_arcsec", _same),),
    "flexspline_order": (("order_{order:.0f}_amplitude_arcsec", "amplitude_arcsec", _same),),
    "motor_encoder_eccentricity": (("order_1_amplitude_arcsec", "amplitude_arcsec", _same),),
    "load_order": (
        ("order_1_amplitude_arcsec", "amplitude_arcsec", _same),
        ("order_2_amplitude_arcsec", "second_arcsec", _same),
    ),
    "direction_phase": (("shift_deg", "shift_deg", _same),),
    "torque_modulation": (("growth_per_nm", "growth_per_nm", _same),),
    "compliance": (
        ("c1_arcsec_per_nm", "compliance_arcsec_per_nm", _same),
        ("compliance_arcsec_per_nm", "compliance_arcsec_per_nm", _same),
        ("stiffness_nm_per_rad", "stiffness_nm_per_rad", _same),
    ),
    "inertial_windup": (("frequency_hz", "frequency_hz", _same), ("resonance_hz", "frequency_hz", _same)),
    # hidden.yaml counts the age of the load's sample, the finding how much later it is taken.
    "channel_skew": (("delay_ms", "delay_ms", _negative),),
    "backlash": (("gap_arcsec", "gap_arcsec", _same), ("width_arcsec", "gap_arcsec", _same)),
    "hysteresis_parameters": (
        ("offset_arcsec", "offset_arcsec", _same),
        ("width_deg", "width_deg", _same),
        ("exponent", "exponent", _same),
    ),
    "rate_dependence": (("growth_per_decade", "growth_per_decade", _same),),
    "subdivisional_error": (("lines_per_turn", "lines_per_turn", _same), ("lines", "lines_per_turn", _same)),
    "zero_drift": (("arcsec_per_k", "arcsec_per_k", _same),),
    "amplitude_drift": (("growth_per_k", "growth_per_k", _same),),
    "wear": (("end_arcsec", "end_arcsec", _same),),
    "creep": (
        ("time_constant_s", "time_constant_s", _same),
        ("tau_s", "time_constant_s", _same),
    ),
    "ratio_error": (
        ("ratio", "ratio", _same),
        ("ramp_arcsec_per_turn", "arcsec_per_motor_turn", _same),
    ),
    "count_loss": (("time_s", "time_s", _same), ("step_arcsec", "step_arcsec", _same)),
    "vibration": (("frequency_hz", "frequency_hz", _same), ("amplitude_arcsec", "amplitude_arcsec", _same)),
    "local_defect": (("at_deg", "at_deg", _same), ("height_arcsec", "height_arcsec", _same)),
}


def _compared(hidden: Data, named: list[Data]) -> Iterable[Compared]:
    truths = {each["cause"]: each["parameters"] for each in hidden["hidden"]}
    for finding in named:
        cause = finding["cause"]
        for name, true_name, convert in COMPARABLE.get(cause, ()):
            known = truths.get(cause, {})
            there = (finding.get("parameters") or {}).get(name.format(**known) if known else name)
            if there is None or not known.get(true_name):
                continue
            low, high = sorted(convert(float(each)) for each in there.get("ci95") or (math.nan, math.nan))
            true = float(known[true_name])
            yield Compared(cause, name, convert(float(there["value"])), low, high, true)
