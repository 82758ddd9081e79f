"""Draws the axis of a blind case: the truth without the cause, and the model file that calibration left.

Nothing here is shared with the tool under test: the truth is the simulated plant's, and the model is YAML
text in the published format, a few per cent wrong.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import curve_fit
from support.hidden.elastic import remembering

from hdbridge.sim.hysteresis_laws import law_of
from hdbridge.sim.truth import RollingFriction, Truth

OTHER_LAWS = ("maxwell_slip", "bouc_wen", "dahl")


@dataclass(frozen=True)
class BlindAxis:
    """An axis and what its owner believes of it."""

    truth: Truth
    model_yaml: str
    law: str
    noise_arcsec: float
    """Rms of a single reading of the load encoder, rounding included."""


def drawn_axis(rng: random.Random, name: str, law: str = "rolling_friction") -> BlindAxis:
    """An axis of ordinary size; ``law`` is the plant's hysteresis law, the model's is the article's."""
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
    """Offset, width and exponent of the article's law that come nearest to the plant's, in one reversal."""
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
    """The baseline: right in kind, a few per cent wrong in its numbers."""
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
