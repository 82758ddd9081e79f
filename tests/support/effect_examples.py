"""Strategies for random effects of every kind, and for motions with every channel, also sampled unevenly."""

import numpy as np
from hypothesis import strategies as st

from hdbridge.axis.effects import (
    CATALOGUE,
    Channel,
    Loop,
    Motion,
    MotorOrder,
    Relaxation,
    Start,
    Step,
    TorqueGrowth,
)

arcsec = st.floats(0, 40)
signed = st.floats(-40, 40)
ratios = st.floats(20, 200)


def orders(numbers):
    """Draws some of these orders, each with its own amplitude and phase."""
    return st.lists(numbers, min_size=1, max_size=6, unique=True).flatmap(
        lambda ks: st.tuples(
            *[
                st.builds(
                    MotorOrder, order=st.just(k), amplitude_arcsec=arcsec, phase_deg=st.floats(-180, 180)
                )
                for k in ks
            ]
        )
    )


def tuples(parts):
    """Draws one to four of these parts."""
    return st.lists(parts, min_size=1, max_size=4).map(tuple)


low_orders = orders(st.integers(1, 12))
loop = {
    "offset_arcsec": st.floats(-80, 80),
    "width_deg": st.floats(1, 60),
    "exponent": st.one_of(st.floats(1.05, 3.0), st.just(2.0), st.just(2.0 + 1e-9)),
}
loops = st.builds(Loop, **loop, memory=st.booleans())
warmth = {
    "tau_s": st.floats(10, 5000),
    "driven_by": st.sampled_from(["temperature", "time"]),
    "reference_c": st.floats(10, 40),
    "limit_k": st.floats(5, 80),
}
torque = {
    "torque": st.sampled_from(["load_torque_nm", "motor_torque_nm"]),
    "limit_nm": st.floats(1, 100),
}
growths = st.builds(TorqueGrowth, growth_percent_per_nm=st.floats(-5, 5), signed=st.booleans(), **torque)
BASE = [CATALOGUE[name].candidate(50.0) for name in ("synchronous", "hysteresis")]


def _torques(sense, levels, first_nm, more_nm, **rest):
    """Makes a compliance whose second torque is above the first."""
    c1, c2, c3 = levels
    return CATALOGUE["compliance"](
        c1_arcsec_per_nm=c1, c2_arcsec_per_nm=c2, c3_arcsec_per_nm=c3, sense=sense,
        torque1_nm=first_nm, torque2_nm=first_nm + more_nm, **rest,
    )  # fmt: skip


PARAMETERS = {
    "synchronous": {"orders": low_orders},
    "hysteresis": loop,
    "motor_order": {"orders": low_orders},
    "motor_encoder_eccentricity": {"orders": orders(st.integers(1, 2))},
    "load_order": {"orders": orders(st.integers(1, 4)), "ratio": ratios},
    "flexspline_order": {"orders": low_orders, "ratio": ratios},
    "direction_phase": {"orders": low_orders, "shift_deg": st.floats(-10, 10)},
    "torque_modulation": {
        "orders": low_orders, "growth_percent_per_nm": st.floats(-5, 5), "signed": st.booleans(), **torque,
    },
    "inertial_windup": {"ratio": ratios, "inertia_over_stiffness_s2": st.floats(0, 1e-4)},
    "velocity_windup": {
        "coulomb_arcsec": arcsec, "viscous_arcsec_s_per_deg": st.floats(0, 0.1),
        "shear_deg_s": st.floats(10, 1e4),
    },
    "channel_skew": {
        "ratio": ratios, "delay_ms": st.floats(-5, 5), "second_order_ms2": st.floats(-25, 25),
    },
    "backlash": {"gap_arcsec": arcsec, "crossing_deg": st.floats(0.05, 20)},
    "hysteresis_memory": loop,
    "hysteresis_parameters": {"base": loops, **loop},
    "rate_dependence": {
        "loop": loops, "growth_percent": st.floats(0, 50), "reference_deg_s": st.floats(1, 1000),
    },
    "subdivisional_error": {
        "lines_per_turn": st.integers(16, 20_000), "orders": orders(st.sampled_from([1, 2, 4])),
    },
    "zero_drift": {"drift_arcsec_per_k": st.floats(-5, 5), **warmth},
    "amplitude_drift": {
        "orders": low_orders, "loop": loops, "ripple_percent_per_k": st.floats(-1, 1),
        "friction_percent_per_k": st.one_of(st.just(0.0), st.floats(-1, 1)),
        "under_load": st.none() | growths, **warmth,
    },
    "wear": {
        "growth_arcsec_per_kiloturn": st.floats(-100, 100), "width_deg": st.floats(0.1, 30),
        "exponent": st.one_of(st.just(1.0), st.floats(0.3, 1.5)),
        "turns_before": st.floats(0, 50), "turns_limit": st.floats(1, 1000),
    },
    "creep": {
        "parts": tuples(st.builds(Relaxation, amplitude_arcsec=signed, tau_s=st.floats(0.01, 100))),
        "build_up": st.floats(0.01, 2),
    },
    "ratio_error": {"ramp_arcsec_per_turn": signed, "limit_deg": st.floats(100, 1e5)},
    "count_loss": {"steps": tuples(st.builds(Step, time_s=st.floats(-1, 50), size_arcsec=signed))},
    "vibration": {
        "frequency_hz": st.floats(0.1, 500), "amplitude_arcsec": arcsec, "phase_deg": st.floats(-180, 180),
    },
    "local_defect": {
        "ratio": ratios, "height_arcsec": signed, "centre_deg": st.floats(0, 360),
        "half_width_deg": st.floats(0.1, 20),
    },
}  # fmt: skip
"""Strategies for the parameters of effects, usually of typical size, by effect name."""
EXAMPLES = (
    {name: st.just(kind.candidate(50.0, BASE)) for name, kind in CATALOGUE.items()}
    | {name: st.builds(CATALOGUE[name], **parameters) for name, parameters in PARAMETERS.items()}
    | {
        "compliance": st.builds(
            _torques, st.sampled_from([1, -1]), st.tuples(arcsec, arcsec, arcsec), st.floats(1, 20),
            st.floats(1, 40), **torque,
        )
    }
)  # fmt: skip
"""Strategies for effects of each kind, by effect name."""

angle_steps = st.lists(
    st.one_of(st.sampled_from([0.0, 1e-6, -1e-6]), st.floats(-30, 30, allow_subnormal=False)),
    min_size=1,
    max_size=40,
)
starts = st.sampled_from(list(Start))


def _motion(first, steps, seed, even):
    """Returns a path with all other channels drawn at random."""
    angle = np.cumsum(np.array([first, *steps]))
    draw = np.random.default_rng(seed)
    count = len(angle)
    period = np.full(count, 0.004) if even else draw.uniform(0.001, 2.0, count)
    return Motion(
        angle,
        time_s=draw.uniform(-5, 5) + np.cumsum(period),
        measured={
            Channel.LOAD_TORQUE: draw.normal(0, 30, count),
            Channel.MOTOR_TORQUE: draw.normal(0, 1, count),
            Channel.TEMPERATURE: np.clip(25 + np.cumsum(draw.normal(0, 2, count)), -20, 90),
        },
        load_deg=angle / 50 + draw.normal(0, 0.01, count),
    )


motions = st.builds(_motion, st.floats(-2000, 2000), angle_steps, st.integers(0, 2**32 - 1), st.booleans())
