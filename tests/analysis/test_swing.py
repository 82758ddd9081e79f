"""Swing of the load on its spring: response, and distance of the driving angle from its encoder."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.driving import kinematics
from hdbridge.analysis.readings import Reading
from hdbridge.analysis.swing import bend_of, swing
from hdbridge.axis.effects import Hysteresis, Motion, Start, Synchronous
from hdbridge.axis.effects.orders import MotorOrder
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.record import Record

COUNT_DEG = 0.018


@pytest.mark.parametrize(("frequency_hz", "damping"), [(25.0, 0.1), (60.0, 0.4)])
def test_the_load_follows_its_base_according_to_the_equation(frequency_hz: float, damping: float) -> None:
    """The samples are irregular, and two belong to a different record."""
    rng = np.random.default_rng(1)
    time_s = np.cumsum(rng.uniform(0.5e-3, 1.5e-3, 800))
    natural = math.tau * frequency_hz

    def base(t: np.ndarray | float) -> np.ndarray:
        return np.asarray(100.0 * np.exp(-(((t - 0.4) / 0.05) ** 2)))

    def bend(t: float) -> float:
        return float((base(t + 1e-4) - 2.0 * base(t) + base(t - 1e-4)) / 1e-8)

    def rate(t: float, state: np.ndarray) -> list[float]:
        return [state[1], -2.0 * damping * natural * state[1] - natural**2 * state[0] - bend(t)]

    span = (float(time_s[0]), float(time_s[-1]))
    true = solve_ivp(rate, span, [0.0, 0.0], t_eval=time_s, rtol=1e-7, atol=1e-7, max_step=2e-3).y[0]
    both = np.concatenate([base(time_s), [3.0, 4.0]])
    times = np.concatenate([time_s, time_s[:2]])
    step_s = np.maximum(np.diff(times), 1e-9)
    bent = bend_of(both, step_s, [slice(0, 800), slice(800, 802)])
    found = swing(bent, step_s, [0, 800], frequency_hz, damping)
    assert found.contribution_arcsec[:800] == pytest.approx(true, abs=0.01 * np.ptp(true))
    assert not np.any(found.contribution_arcsec[800:])


def test_a_steady_acceleration_winds_the_load_up() -> None:
    """Wind-up per acceleration is J / K = 1 / (2 pi f)^2."""
    time_s = np.arange(2000) * 1e-3
    bent = bend_of(0.5 * 3600.0 * 100.0 * time_s**2, np.diff(time_s), [slice(0, 2000)])
    found = swing(bent, np.diff(time_s), [0], 40.0, 0.2)
    assert found.contribution_arcsec[1500] == pytest.approx(-360_000.0 / (math.tau * 40.0) ** 2, rel=1e-3)


def test_a_quickly_changing_lag_is_not_encoder_noise() -> None:
    """The motor rings about its command in every move and never rests."""
    time_s = np.arange(600) * 0.006
    target = 200.0 * np.sin(math.tau * 1.5 * time_s)
    motor = target + 0.5 * np.sin(math.tau * 35.0 * time_s) * np.sign(np.cos(math.tau * 1.5 * time_s))
    counted = np.round(motor / COUNT_DEG) * COUNT_DEG
    driven = kinematics(counted, target, time_s, Reading(COUNT_DEG, COUNT_DEG / math.sqrt(12.0)))
    moving = np.abs(np.gradient(motor, time_s)) > 300.0
    assert np.max(np.abs(driven.motor_deg - counted)[moving]) <= 0.501 * COUNT_DEG


@pytest.mark.parametrize(
    ("order", "move_s", "way_deg", "every_s"),
    [(MotorOrder(order=2, amplitude_arcsec=6.0, phase_deg=30.0), 0.2, 211.0, 0.004),
     (MotorOrder(order=4, amplitude_arcsec=11.0, phase_deg=30.0), 1.2, 1800.0, 0.046)],
    ids=["resolved", "a sample and a half to a wave"],
)  # fmt: skip
def test_fast_moves_of_a_healthy_axis_yield_a_remark_only(
    order: MotorOrder, move_s: float, way_deg: float, every_s: float
) -> None:
    """The record begins in the middle of a move, with the elastic state of the preceding motion."""
    step_s, number = 0.0005, 48
    clock_s = np.arange(round(number * 2.0 * move_s / step_s)) * step_s
    move, since_s = np.divmod(clock_s, 2.0 * move_s)
    part = np.clip(since_s / move_s, 0.0, 1.0)
    way = part**3 * (10.0 + part * (6.0 * part - 15.0))
    places = np.cumsum(np.random.default_rng(5).choice([-1.0, 1.0], number + 1) * way_deg)
    motor = places[move.astype(int)] + way * np.diff(places)[move.astype(int)]
    model = TransmissionModel(
        50.0, (Synchronous(orders=(order,)), Hysteresis(offset_arcsec=20.0, width_deg=20.0, exponent=1.8))
    )
    error = model.predict(Motion(motor), Start.VIRGIN)
    base = 72.0 * motor + error
    natural, lag, rate, lags = math.tau * 55.0, 0.0, 0.0, np.zeros(len(base))
    for row, bend in enumerate(np.gradient(np.gradient(base, clock_s), clock_s).tolist()):
        rate -= (bend + 0.2 * natural * rate + natural**2 * lag) * step_s
        lag += rate * step_s
        lags[row] = lag
    rows = np.arange(round(0.6 / step_s), len(base), round(every_s / step_s))
    load = (base + lags)[rows] + 0.5 * np.random.default_rng(6).normal(size=len(rows))
    record = Record(
        {
            "time_s": clock_s[rows],
            "motor_position_deg": np.round(motor[rows] / 0.001) * 0.001,
            "motor_target_deg": motor[rows],
            "load_position_deg": load / 3600.0,
        }
    )
    found = diagnose(record, model)
    assert np.max(np.abs(lags)) > 5.0
    assert not found.findings
    assert any("oscillates on its spring at 5" in each for each in found.remarks)
    assert len(found.traces.rows) == len(rows)  # no sample is left out
