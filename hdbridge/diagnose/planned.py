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
from hdbridge.procedures.moves import AxisView, MotionLimits
from hdbridge.procedures.plan import Plan
from hdbridge.procedures.rehearsal import legs_of
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
    places: list[float] = []
    legs: list[Segment] = []
    for task in tasks.tasks:
        for move, path in legs_of(task.procedure, view, places[-1] if places else 0.0):
            count, first = max(1, round(path.duration_s / PERIOD_S)), len(places)
            places += [path.at(path.duration_s * i / count) for i in range(1, count + 1)]
            end_s = (len(places) - 1) * PERIOD_S
            legs.append(Segment(kind=move.kind, start_s=first * PERIOD_S, end_s=end_s, notes={}))
    time = np.arange(len(places), dtype=np.float64) * PERIOD_S
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
