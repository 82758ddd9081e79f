"""Before anything is measured: what a plan's procedures could detect, and what they could not tell apart."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from hdbridge.diagnose.identifiability import identifiability
from hdbridge.effects import Motion, Start
from hdbridge.estimation.hypothesis import Estimator, Hypothesis
from hdbridge.estimation.observed import gather
from hdbridge.estimation.terms import Effort
from hdbridge.model import TransmissionModel
from hdbridge.procedures.moves import AxisView, MotionLimits, Procedure, Sample
from hdbridge.procedures.plan import Plan
from hdbridge.records.record import Record
from hdbridge.records.recording import Segment
from hdbridge.units import ARCSEC_PER_DEG

PERIOD_S: Final = 0.04
NOISE_ARCSEC: Final = 0.5
"""White noise that is assumed of a planned record, of one sample every `PERIOD_S`."""
LIMITS: Final = MotionLimits(-400.0, 400.0, 20.0, 200.0, 4000.0)
"""Limits of the load that are assumed where no axis says."""


def plan_report(plan: Plan, model: TransmissionModel, limits: MotionLimits = LIMITS) -> dict[str, Any]:
    """Per cause what the plan could say; the part ``identifiability`` of a diagnosis, and how long it
    takes.
    """
    view = AxisView(model.ratio, limits)
    tasks = plan.tasks(view)
    times: list[float] = []
    places: list[float] = []
    legs: list[Segment] = []
    for task in tasks.tasks:
        _walk(task.procedure, view, times, places, legs)
    time = np.array(times)
    motor = np.array(places) * model.ratio
    start = Start.FORWARD
    motion = Motion(motor, time_s=time)
    error = model.predict(motion, start)
    rng = np.random.default_rng(0)
    load = motor / model.ratio + (error + NOISE_ARCSEC * rng.standard_normal(len(time))) / ARCSEC_PER_DEG
    record = Record(
        {"time_s": time, "motor_position_deg": motor, "load_position_deg": load, "motor_target_deg": motor}
    )
    data = gather(record, model.ratio, legs, expected=lambda given: model.predict(given, start))
    estimator = Estimator(data)
    fitted = estimator.fit(Hypothesis(model.effects, start), effort=Effort(steps=2))
    found = identifiability(estimator, fitted, model.effects)
    return {
        "schema": "hdbridge.plan-diagnosis/1",
        "plan": plan.name,
        "duration_s": float(time[-1]),
        "noise_arcsec": NOISE_ARCSEC,
        "identifiability": {name: each.as_dict() for name, each in found.items()},
        "notes": list(tasks.notes),
    }


def _walk(
    procedure: Procedure[object], view: AxisView, times: list[float], places: list[float], legs: list[Segment]
) -> None:
    """Go through a procedure on an ideal axis, sample by sample."""
    steps = procedure.moves(view)
    place = places[-1] if places else 0.0
    now = times[-1] + PERIOD_S if times else 0.0
    try:
        move = next(steps)
        while True:
            path = move.path(place, view.limits)
            count = max(1, round(path.duration_s / PERIOD_S))
            begin = now
            samples = []
            for i in range(1, count + 1):
                place = path.at(path.duration_s * i / count)
                times.append(now)
                places.append(place)
                samples.append(Sample(now, place, place * view.ratio, place * view.ratio, place, 0.0))
                now += PERIOD_S
            legs.append(Segment(kind=move.kind, start_s=begin, end_s=now - PERIOD_S, notes={}))
            move = steps.send(samples)
    except StopIteration:
        return
