"""Draws the axes of blind cases: the truth without the cause.

`drawn_axis` is an axis of the bench suite: of ordinary size, with a model file that is a few per cent wrong.
`everyday_axes` spans real machines: soft and stiff springs, coarse and fine encoders, slow and fast buses.
Their models come from calibrations (`blind.plant`).
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml
from scipy.optimize import curve_fit
from support.hidden.elastic import remembering
from support.hidden.site import ARCSEC_PER_RAD, ARCSEC_PER_TURN

from hdbridge.axis import AxisConfig
from hdbridge.commissioning.calibration.measure import remaining_plan
from hdbridge.control.bench import axis_view
from hdbridge.files.profile import bundled_profile
from hdbridge.motion.procedures.moves import MoveTo
from hdbridge.motion.procedures.plan import Plan
from hdbridge.sim.hysteresis_laws import law_of
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import RollingFriction, Truth
from hdbridge.sim.truth.resonance import Resonance

OTHER_LAWS = ("maxwell_slip", "bouc_wen", "dahl")
PRESLIDING = "presliding"
"""Friction at the load that yields before it slips, in place of most of the gear's loop."""
EVERYDAY_LAWS = (*OTHER_LAWS, PRESLIDING)
COARSE_COUNTS = (8_000, 8_192, 10_000, 16_384, 20_000)
FINE_COUNTS = (2**16, 2**17, 2**18, 2**20)
SUBSTEPS_MS = (1.0, 0.5, 0.25, 0.2, 0.1, 0.05)
MOST_SAMPLES = 600_000
"""Maximum number of samples of a calibration; if it would take more, a smaller travel is drawn."""


@dataclass(frozen=True)
class BlindAxis:
    """Axis with the model that the diagnosis is given."""

    truth: Truth
    model_yaml: str
    law: str
    noise_arcsec: float
    """Rms of a single reading of the load encoder, rounding included."""


def drawn_axis(rng: random.Random, name: str, law: str = "rolling_friction") -> BlindAxis:
    """Draws an axis of ordinary size; ``law`` is the plant's hysteresis law, the model's is the article's."""
    ratio = rng.choice((50, 50, 80, 100, 120, 160))
    motor = _motor(rng)
    share = rng.uniform(1.2, 2.8)
    load_inertia = share * motor["inertia_kg_m2"] * ratio**2
    frequency_hz = rng.uniform(60.0, 72.0)
    damping_ratio = rng.uniform(0.1, 0.25)
    turn = math.tau * frequency_hz
    noise_arcsec = _stretched(rng, 0.3, 3.0)
    load_counts = rng.choice((1_440_000, 2_880_000, 2**22, 2**23))
    orders = _orders(rng)
    loop = _loop(rng, law)
    data: dict[str, Any] = {
        "schema": "hdbridge.truth/1",
        "name": name,
        "substep_ms": 1.0,
        "motor": motor,
        "servo": _servo(rng, motor, share, frequency_hz, damping_ratio),
        "gear": {
            "ratio": ratio,
            "stiffness_nm_per_rad": load_inertia * turn**2,
            "damping_nm_s_per_rad": 2.0 * damping_ratio * load_inertia * turn,
            "motor_orders": orders,
            "hysteresis": loop,
        },
        "load": {
            "inertia_kg_m2": load_inertia,
            "encoder": {
                "counts_per_turn": load_counts,
                "noise_arcsec": noise_arcsec,
                "coupling": {
                    "frequency_hz": rng.uniform(180.0, 260.0),
                    "damping_ratio": rng.uniform(0.1, 0.3),
                },
            },
        },
        "temperature": {
            "ambient_c": rng.uniform(18.0, 26.0),
            "resistance_k_per_w": rng.uniform(0.5, 1.5),
            "time_constant_s": rng.uniform(600.0, 2400.0),
        },
    }
    truth = Truth.model_validate(data)
    rounding = 360.0 * 3600.0 / load_counts / math.sqrt(12.0)
    return BlindAxis(truth, _model_yaml(rng, truth, name), law, math.hypot(noise_arcsec, rounding))


def _stretched(rng: random.Random, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def _motor(rng: random.Random) -> dict[str, Any]:
    scale = _stretched(rng, 0.7, 2.0)
    return {
        "inertia_kg_m2": 3.0e-5 * scale,
        "rated_torque_nm": 0.32 * scale,
        "coulomb_nm": 0.03 * scale * rng.uniform(0.8, 1.3),
        "viscous_nm_s_per_rad": 2.0e-4 * scale * rng.uniform(0.7, 1.4),
        "encoder": {"counts_per_turn": rng.choice((8000, 10_000, 16_384, 20_000)), "interpolation": 64},
    }


def _servo(
    rng: random.Random, motor: dict[str, Any], share: float, frequency_hz: float, damping_ratio: float
) -> dict[str, Any]:
    inertia = motor["inertia_kg_m2"]
    return {
        "position_gain_per_s": rng.uniform(140.0, 200.0),
        "velocity_gain_nm_s_per_rad": 0.035 * inertia / 3.0e-5 * rng.uniform(0.8, 1.0),
        "integral_time_ms": rng.uniform(14.0, 20.0),
        # Two lags of this time constant: the following error is speed times twice it.
        "command_filter_ms": rng.uniform(1.0, 2.5),
        "inertia_feedforward_kg_m2": inertia * rng.uniform(0.95, 1.05),
        "load_feedforward": {
            "inertia_kg_m2": share * inertia * rng.uniform(0.95, 1.05),
            "frequency_hz": frequency_hz * rng.uniform(0.97, 1.03),
            "damping_ratio": damping_ratio,
        },
        "viscous_feedforward_nm_s_per_rad": motor["viscous_nm_s_per_rad"],
        "friction_feedforward_nm": motor["coulomb_nm"] * rng.uniform(0.75, 0.85),
        "torque_limit_percent": 300,
    }


def _orders(rng: random.Random) -> list[dict[str, Any]]:
    sizes = {1: (2, 8), 2: (5, 14), 3: (0.5, 3), 4: (4, 13), 6: (1, 4), 8: (0.5, 2)}
    kept = [order for order in sizes if order in (1, 2, 4) or rng.random() < 0.7]
    return [
        {
            "order": order,
            "amplitude_arcsec": rng.uniform(*sizes[order]),
            "phase_deg": rng.uniform(-180.0, 180.0),
        }
        for order in kept
    ]


def _loop(rng: random.Random, law: str) -> dict[str, Any]:
    offset, width = rng.uniform(15.0, 42.0), rng.uniform(12.0, 28.0)
    rolling = RollingFriction(
        law="rolling_friction", offset_arcsec=offset, width_deg=width, exponent=rng.uniform(1.4, 1.9)
    )
    if law == "rolling_friction":
        return rolling.model_dump()
    if law == "maxwell_slip":
        return remembering(rolling, 1.0, rng.randint(8, 24)).model_dump()
    travel = width * rng.uniform(0.1, 0.25)
    if law == "bouc_wen":
        return {
            "law": law,
            "offset_arcsec": offset,
            "yield_deg": travel,
            "exponent": rng.uniform(1.0, 1.6),
            "beta": rng.uniform(0.5, 0.8),
        }
    if law == "dahl":
        exponent = rng.uniform(0.7, 1.5)
        return {"law": law, "offset_arcsec": offset, "yield_deg": travel, "exponent": exponent}
    raise ValueError(f"law: found '{law}'; expected rolling_friction or one of {', '.join(OTHER_LAWS)}")


def nearest_loop(truth: Truth) -> tuple[float, float, float]:
    """Returns offset, width and exponent of the article's law that best fit the plant's in one reversal."""
    law = truth.gear.hysteresis
    if isinstance(law, RollingFriction):
        return law.offset_arcsec, law.width_deg, law.exponent
    model = law_of(law, 0.0)
    assert model is not None
    top = model.advance(3000.0)
    travels = np.concatenate([np.geomspace(0.01, 1.0, 40), np.linspace(1.1, 60.0, 300)])
    crossed = np.array([top - model.advance(3000.0 - each) for each in travels])

    def branch(travel: Any, offset: float, width: float, exponent: float) -> Any:
        part = np.minimum(travel / width, 1.0)
        return 2.0 * offset * (part ** (exponent - 1.0) - (exponent - 1.0) * part) / (2.0 - exponent)

    found, _ = curve_fit(
        branch,
        travels,
        crossed,
        (top, 15.0, 1.7),
        bounds=((0.5 * top, 1.0, 1.05), (1.5 * top, 120.0, 1.98)),
    )
    return float(found[0]), float(found[1]), float(found[2])


def _model_yaml(rng: random.Random, truth: Truth, name: str) -> str:
    """Returns a model file of the right form with parameters a few per cent wrong."""
    offset, width, exponent = nearest_loop(truth)
    rows = "\n".join(
        f"        - {{order: {each.order}, "
        f"amplitude_arcsec: {each.amplitude_arcsec * rng.gauss(1.0, 0.03):.3f}, "
        f"phase_deg: {each.phase_deg + rng.gauss(0.0, 2.0):.2f}}}"
        for each in truth.gear.motor_orders
    )
    return f"""schema: hdbridge.model/1
ratio: {truth.gear.ratio:g}
effects:
  - effect: synchronous
    parameters:
      orders:
{rows}
  - effect: hysteresis
    parameters:
      offset_arcsec: {offset * rng.gauss(1.0, 0.03):.3f}
      width_deg: {width * rng.gauss(1.0, 0.04):.3f}
      exponent: {min(max(exponent + rng.gauss(0.0, 0.02), 1.05), 1.98):.3f}
provenance:
  axis: {name}
  gear: {{ratio: {truth.gear.ratio:g}}}
  reason: an earlier calibration, a few per cent off
"""


@dataclass(frozen=True)
class EverydayAxis:
    """Axis with its axis file, plan and calibrated model."""

    config: AxisConfig
    truth: Truth
    law: str
    flicker_counts: float
    """Rms by which the motor encoder's reading flickers before it is rounded."""
    plan: str
    """Plan of its calibration."""

    @property
    def noise_arcsec(self) -> float:
        """Rms of a single reading of the transmission error: both encoders, rounding included."""
        load = self.truth.load_.encoder
        rounding = ARCSEC_PER_TURN / load.counts_per_turn / math.sqrt(12.0)
        return math.hypot(
            load.noise_arcsec, rounding, self.count_arcsec * math.hypot(self.flicker_counts, 12.0**-0.5)
        )

    @property
    def count_arcsec(self) -> float:
        """Returns one count of the motor encoder, arcsec at the load."""
        return ARCSEC_PER_TURN / self.truth.motor.encoder.counts_per_turn / self.truth.gear.ratio


def everyday_axes(
    rng: random.Random,
    name: str,
    law: str = "rolling_friction",
    encoders: Sequence[tuple[int, float] | None] = (None,),
) -> list[EverydayAxis]:
    """Draws an axis with each motor encoder: counts per turn and flicker, or drawn if None.

    An axis that does not come to rest after a move, or lacks the torque for it, is drawn again.
    """
    base = yaml.safe_load((bundled_profile("demo") / "axis.yaml").read_text(encoding="utf-8"))
    while True:
        seed = rng.random()
        axes = [_everyday(random.Random(seed), name, law, encoder, base) for encoder in encoders]
        if all(map(_works, axes)):
            return axes


def _everyday(
    rng: random.Random, name: str, law: str, encoder: tuple[int, float] | None, base: dict[str, Any]
) -> EverydayAxis:
    ratio = rng.choice((30, 50, 50, 80, 100, 100, 120, 160))
    scale = _stretched(rng, 0.7, 4.0)
    inertia = 3.0e-5 * scale
    counts, flicker = (
        rng.choice(rng.choice((COARSE_COUNTS, FINE_COUNTS))),
        rng.choice((0.0, rng.uniform(0.0, 0.5))),
    )
    if encoder is not None:
        counts, flicker = encoder
    share = _stretched(rng, 0.3, 4.0)
    load_inertia = share * inertia * ratio**2
    stiffness = 15_000.0 * scale * (ratio / 50.0) ** 2 * _stretched(rng, 0.3, 25.0)
    frequency_hz = math.sqrt(stiffness / load_inertia) / math.tau
    damping_ratio = rng.uniform(0.05, 0.25)
    coulomb, viscous = 0.03 * scale * _stretched(rng, 0.3, 2.0), 2.0e-4 * scale * _stretched(rng, 0.4, 2.5)
    rated = 0.32 * scale
    motor_deg_s = 6.0 * _stretched(rng, 150.0, 3000.0)
    reflected = inertia * (1.0 + share)
    torque = 1.6 * rated - coulomb - viscous * math.radians(motor_deg_s)
    acceleration = min(motor_deg_s / _stretched(rng, 0.05, 0.6), math.degrees(torque / reflected))
    wind_up_nm = stiffness / ARCSEC_PER_RAD
    cycle_ms = rng.choice((1, 1, 2, 2, 4, 4, 5, 8, 10))
    gear: dict[str, Any] = {
        "ratio": ratio,
        "stiffness_nm_per_rad": stiffness,
        "damping_nm_s_per_rad": 2.0 * damping_ratio * math.sqrt(stiffness * load_inertia),
        "motor_orders": _everyday_orders(rng),
    }
    load: dict[str, Any] = {
        "inertia_kg_m2": load_inertia,
        # Bearings of the load, in addition to the gear's own; their wind-up is insignificant.
        "coulomb_nm": wind_up_nm * _stretched(rng, 0.01, 0.3),
        "viscous_nm_s_per_rad": wind_up_nm * _stretched(rng, 0.01, 0.3) / math.radians(motor_deg_s / ratio),
        "encoder": {
            "counts_per_turn": rng.choice((2**18, 1_440_000, 2_880_000, 2**22, 2**23)),
            "noise_arcsec": _stretched(rng, 0.1, 2.0),
        },
    }
    if rng.random() < 0.6:
        load["encoder"]["coupling"] = {
            "frequency_hz": rng.uniform(150.0, 600.0),
            "damping_ratio": rng.uniform(0.1, 0.3),
        }
    _give_law(rng, law, gear, load)
    truth: dict[str, Any] = {
        "schema": "hdbridge.truth/1",
        "name": name,
        "motor": {
            "inertia_kg_m2": inertia,
            "rated_torque_nm": rated,
            "coulomb_nm": coulomb,
            "viscous_nm_s_per_rad": viscous,
            "encoder": {"counts_per_turn": counts, "interpolation": 64 if counts < 2**16 else 4},
        },
        "servo": {
            "position_gain_per_s": _stretched(rng, 50.0, 220.0),
            "velocity_gain_nm_s_per_rad": 0.035 * scale * _stretched(rng, 0.5, 1.3),
            "integral_time_ms": _stretched(rng, 12.0, 40.0),
            "command_filter_ms": _stretched(rng, 0.5, 5.0),
            "velocity_feedforward": rng.choice((1.0, 1.0, rng.uniform(0.8, 1.0))),
            "inertia_feedforward_kg_m2": inertia
            * rng.choice((0.0, rng.uniform(0.9, 1.1), rng.uniform(0.9, 1.1))),
            "viscous_feedforward_nm_s_per_rad": viscous * rng.uniform(0.8, 1.2),
            "friction_feedforward_nm": coulomb * rng.uniform(0.4, 0.85),
            "dead_time_ms": rng.choice((0.0, 0.0, rng.uniform(0.0, 2.0))),
            "torque_limit_percent": 300,
        },
        "gear": gear,
        "load": load,
        "temperature": {
            "ambient_c": rng.uniform(18.0, 28.0),
            "resistance_k_per_w": rng.uniform(0.5, 2.0),
            "time_constant_s": rng.uniform(600.0, 2400.0),
        },
    }
    if rng.random() < 0.7:
        truth["servo"]["load_feedforward"] = {
            "inertia_kg_m2": share * inertia * rng.uniform(0.85, 1.15),
            "frequency_hz": min(frequency_hz * rng.uniform(0.9, 1.1), 500.0),
            "damping_ratio": damping_ratio,
        }
    fastest = Resonance.of(truth).rad_s
    truth["substep_ms"] = next(each for each in SUBSTEPS_MS if fastest * each <= 600.0)
    reach_deg = _stretched(rng, 60.0, 360.0)
    data = {
        **base,
        "name": name,
        "drive": {**base["drive"], "cycle_ms": cycle_ms, "rated_torque_nm": rated},
        "motor_encoder": {"counts_per_turn": counts},
        "load_encoder": {
            "counts_per_turn": load["encoder"]["counts_per_turn"],
            "source": base["load_encoder"]["source"],
        },
        "gear": {"ratio": ratio},
        "limits": {
            "velocity_deg_s": motor_deg_s / ratio,
            "acceleration_deg_s2": acceleration / ratio,
            "jerk_deg_s3": acceleration / ratio / _stretched(rng, 0.01, 0.1),
            "torque_percent": 300,
        },
    }
    plan = rng.choice(("quick", "quick", "quick", "full"))
    while True:
        data["limits"] |= {"position_min_deg": -reach_deg, "position_max_deg": reach_deg}
        config = AxisConfig.from_text(yaml.safe_dump(data), bundled_profile("demo") / "axis.yaml")
        if remaining_plan(Plan.load(plan), config).duration_s <= MOST_SAMPLES * config.drive.cycle_s:
            return EverydayAxis(config, Truth.model_validate(truth), law, flicker, plan)
        if reach_deg > 60.0:
            reach_deg = max(0.7 * reach_deg, 60.0)
        else:
            plan, data["drive"]["cycle_ms"] = "quick", max(4, cycle_ms)


def _everyday_orders(rng: random.Random) -> list[dict[str, Any]]:
    chosen = {2, *rng.sample((1, 3, 4, 4, 5, 6, 7, 8, 10), rng.randint(2, 6))}
    return [
        {
            "order": order,
            "amplitude_arcsec": _stretched(rng, 1.0, 14.0)
            if order in {1, 2, 4}
            else _stretched(rng, 0.5, 4.0),
            "phase_deg": rng.uniform(-180.0, 180.0),
        }
        for order in sorted(chosen)
    ]


def _give_law(rng: random.Random, law: str, gear: dict[str, Any], load: dict[str, Any]) -> None:
    """Gives the gear a loop with this law; with `PRESLIDING`, most of the friction is at the load."""
    rolling = RollingFriction(
        law="rolling_friction",
        offset_arcsec=_stretched(rng, 8.0, 60.0),
        width_deg=rng.uniform(5.0, 40.0),
        exponent=rng.uniform(1.3, 2.5),
    )
    start = rng.uniform(-1.0, 1.0) * rolling.offset_arcsec
    if law == "rolling_friction":
        gear["hysteresis"] = rolling.model_copy(update={"start_arcsec": start}).model_dump()
        return
    gear["hysteresis"] = _loop(rng, OTHER_LAWS[0] if law == PRESLIDING else law)
    if law == PRESLIDING:
        gear["hysteresis"] = rolling.model_copy(update={"offset_arcsec": rng.uniform(2.0, 6.0)}).model_dump()
        whole_nm = _stretched(rng, 10.0, 40.0) * gear["stiffness_nm_per_rad"] / ARCSEC_PER_RAD
        travel_deg = rng.uniform(5.0, 40.0) / gear["ratio"]
        load["presliding"] = [
            {"limit_nm": whole_nm * part, "travel_deg": travel_deg * stretch}
            for part, stretch in ((0.3, 0.1), (0.3, 0.3), (0.2, 0.6), (0.2, 1.0))
        ]


def _works(axis: EverydayAxis) -> bool:
    """True if the axis follows a fast move each way, stands still afterwards, and has torque to spare."""
    limits, period_s = axis_view(axis.config).limits, axis.config.drive.cycle_s
    machine = Machine(axis.truth, 1, may_compile=True)
    substeps = round(period_s / axis.truth.substep_s)
    scale, ratio = axis.config.motor_encoder.scale, axis.config.gear.ratio
    place, last, held = 0.0, 0.0, round(1.0 / period_s)
    top_nm = 3.0 * axis.truth.motor.rated_torque_nm
    for goal in (min(30.0, limits.position_max_deg), 0.1, 0.0):
        way = MoveTo(goal).path(place, limits)
        cycles = math.ceil(way.duration_s / period_s) + 1
        targets = [way.at(cycle * period_s) for cycle in range(cycles)] + [goal] * held
        counts = np.rint(scale.counts(ratio) * np.array(targets)).tolist()
        seen = machine.follow_all([last, *counts], [substeps] * len(counts))
        place, last = goal, counts[-1]
        standing = scale.degrees(1.0) * seen.motor_reading[-held // 4 :] - ratio * goal
        if np.ptp(standing) > 0.004 or np.max(np.abs(standing)) > 0.5 * abs(scale.degrees(1.0)) + 0.02:
            return False
        if np.max(np.abs(seen.torque_nm)) > 0.95 * top_nm:
            return False
    return True
