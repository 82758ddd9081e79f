"""Further experiments that the axis can run to separate causes that a diagnosis cannot separate."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from hdbridge.analysis.findings import Diagnosis, depends_on
from hdbridge.analysis.identifiability import plan_report
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.improvement.extension import alternatives
from hdbridge.motion.procedures.moves import AxisView
from hdbridge.motion.procedures.plan import Plan
from hdbridge.motion.procedures.rehearsal import total_duration_s

_CLOSER: Final = {
    "load angle": "two-load-turns",
    "reversal": "growing-reversals",
    "motor angle": "three-speeds",
    "speed": "three-speeds",
    "torque": "load-turn-at-two-speeds",
    "time": "reference-pose",
}
"""Experiment for an unexplained residual, by the coordinate that it depends on."""


def _sweep(speed: float, **length: float) -> dict[str, Any]:
    return {"procedure": "sweep", "motor_turns_per_s": speed, **length}


def _stand(duration_s: float) -> dict[str, Any]:
    return {"procedure": "standstill", "duration_s": duration_s}


_MACHINE: Final[dict[str, tuple[str, tuple[dict[str, Any], ...]]]] = {
    "three-speeds": (
        "sweep three motor turns both ways at three speeds",
        tuple(_sweep(each, motor_turns=3) for each in (0.1, 0.4, 1.6)),
    ),
    "growing-reversals": (
        "reversals of 0.1 to 24 deg of the motor, each beyond the last turning point",
        (
            {
                "procedure": "reversals",
                "depths_deg": [0.1, 0.2, 0.5, 1, 2, 4, 8, 12, 16, 24],
                "motor_deg_per_s": 4,
                "beyond": True,
            },
        ),
    ),
    "frequencies": (
        "sines of one amplitude at three frequencies",
        tuple(
            {"procedure": "sines", "amplitudes_deg": [45], "frequency_hz": hertz, "periods": periods}
            for hertz, periods in ((0.02, 2), (0.1, 2), (0.5, 10))
        ),
    ),
    "stand-and-two-speeds": (
        "stand still for a minute, then sweep eight motor turns at two speeds",
        (_stand(60), _sweep(0.3, motor_turns=8), _sweep(0.7, motor_turns=8)),
    ),
    "reference-pose": ("return to one reference pose every half minute", (_stand(20),) * 8),
    "load-turn-at-two-speeds": (
        "sweep a load turn both ways, then again at twice the speed",
        (_sweep(0.5, load_turns=1), _sweep(1.0, load_turns=1)),
    ),
    "two-load-turns": ("sweep two whole load turns both ways", (_sweep(0.5, load_turns=2),)),
    "long-standstill": (
        "stand still for five minutes, move, and stand for five minutes again",
        (_stand(300), _sweep(0.3, motor_turns=3), _stand(300)),
    ),
}


def machine_plans() -> dict[str, Plan]:
    """Returns the experiments that the axis can run on its own, by name; ``about`` describes each."""
    return {
        name: Plan.model_validate(
            {"schema": "hdbridge.plan/1", "name": name, "about": words, "procedures": procedures}
        )
        for name, (words, procedures) in _MACHINE.items()
    }


def machine_for_unexplained(lives_in: str) -> str:
    """Returns the name of the experiment in `machine_plans` that investigates an unexplained residual."""
    return _CLOSER[depends_on(lives_in)]


@dataclass(frozen=True, slots=True)
class Choice:
    """Chosen experiment, with the pairs of causes that it separates."""

    plan: Plan
    duration_s: float
    """Duration on an ideal axis, s."""
    separates: tuple[str, ...]
    """Alternatives that the experiment is predicted to separate, as text."""

    def as_dict(self) -> dict[str, Any]:
        """Returns the choice as data."""
        return {
            "experiment": self.plan.name,
            "about": self.plan.about,
            "duration_s": self.duration_s,
            "separates": list(self.separates),
        }


def unseparated(
    diagnosis: Diagnosis, model: TransmissionModel, view: AxisView, plans: Sequence[Plan] = ()
) -> dict[str, tuple[str, ...]]:
    """Returns, for each cause found, the other causes from which it has not been separated.

    These are its aliases in the diagnosis, and the causes that none of the measured ``plans`` can separate
    from it. Over a short travel, for example, a load order looks like a ramp, and one of the two always fits
    slightly better.
    """
    reports = [plan_report(each, model, view.limits)["identifiability"] for each in plans]
    rivals: dict[str, tuple[str, ...]] = {}
    for finding in diagnosis.findings:
        one = finding.cause
        found = [*rivals.get(one, ()), *finding.aliases]
        for other in reports[0][one]["aliases"] if reports and one in reports[0] else ():
            if reports[0][other]["detectable"] and not any(
                _separates(each, one, other, finding.peak_arcsec) for each in reports
            ):
                found.append(other)
        if found:
            rivals[one] = tuple(dict.fromkeys(found))
    return rivals


def choose(
    diagnosis: Diagnosis,
    rivals: Mapping[str, Sequence[str]],
    model: TransmissionModel,
    view: AxisView,
    done: Collection[str] = (),
) -> Choice | None:
    """Returns the shortest experiment not ``done`` that separates the most causes from their ``rivals``.

    If none separates any, returns the experiment for the coordinate of an unexplained residual, or None if no
    experiment of the axis is of use.
    """
    menu = sorted(
        (
            (total_duration_s((each.procedure for each in plan.tasks(view).tasks), view), plan)
            for name, plan in machine_plans().items()
            if name not in done
        ),
        key=lambda each: each[0],
    )
    pairs = [
        (each.cause, other, each.peak_arcsec)
        for each in diagnosis.findings
        for other in rivals.get(each.cause, ())
    ]
    best: Choice | None = None
    for duration_s, plan in menu if pairs else ():
        report = plan_report(plan, model, view.limits)["identifiability"]
        separated = dict.fromkeys(
            f"{one} or {other}" for one, other, peak in pairs if _separates(report, one, other, peak)
        )
        if len(separated) > (len(best.separates) if best else 0):
            best = Choice(plan, duration_s, tuple(separated))
        if len(separated) == len(pairs):
            break
    if best:
        return best
    for finding in diagnosis.findings:
        if finding.cause == "unexplained":
            name = machine_for_unexplained(finding.lives_in)
            for duration_s, plan in menu:
                if plan.name == name:
                    return Choice(plan, duration_s, (f"what depends on the {finding.lives_in or 'time'}",))
    return None


def advice(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Returns the recommended experiment for each cause that has aliases or is unexplained, as text."""
    return tuple(
        dict.fromkeys(
            f"{alternatives(each)}: {each.experiment}"
            for each in diagnosis.findings
            if each.experiment and (each.aliases or each.cause == "unexplained")
        )
    )


def _separates(report: dict[str, Any], one: str, other: str, peak_arcsec: float) -> bool:
    """Returns True if the plan alone would detect the cause at its size and separate it from the other."""
    seen = report[one]
    limit = seen["detection_limit_arcsec"]
    if not seen["detectable"] or limit is None or limit > peak_arcsec:
        return False
    return other not in seen["aliases"] and one not in report[other]["aliases"]
