"""The filter computed from runs at constant speed inverts the response of the axis in those runs."""

import cmath
import math

import numpy as np
import pytest

from hdbridge.analysis.response import (
    Harmonics,
    Limits,
    Trial,
    gain,
    order_hz,
    response_of,
)
from hdbridge.axis.effects import MotorOrder

RATIO, CYCLE_S, LAG_S = 50.0, 0.004, 0.012
ORDERS = {1: 5.0, 2: 9.0, 3: 2.0, 4: 12.0, 6: 3.0, 8: 1.8}
SPEEDS = tuple(
    sign * 130.0 * share for share in (0.08, 0.18, 0.28, 0.38, 0.5, 0.64, 0.8, 0.95) for sign in (1, -1)
)
TOP = {order: float(order_hz(order, 130.0, RATIO)) for order in ORDERS}


def limits(**changed) -> Limits:
    usual = {"maximum_arcsec": 600.0, "slew_arcsec_s": 1e6, "acceleration_deg_s2": 300.0}
    return Limits(tuple((TOP[order], size) for order, size in ORDERS.items()), **(usual | changed))


def orders() -> list[MotorOrder]:
    return [MotorOrder(order=each, amplitude_arcsec=size, phase_deg=0.0) for each, size in ORDERS.items()]


def flat(hertz: float) -> complex:
    return 1.0 / (1.0 + 1j * hertz / 60.0)


def resonance(hz: float, damping: float):
    """Returns the response of a servo with a notch filter; its inverse has a narrow peak."""

    def answer(hertz: float) -> complex:
        s = 1j * hertz / hz
        notch = (1.0 + 2.0 * damping * s + s * s) / (1.0 + 0.8 * s + s * s)
        return flat(hertz) * notch

    return answer


def runs(answer, filters=None, noise_arcsec: float = 0.0, seed: int = 0) -> tuple[Harmonics, ...]:
    """Residual orders if the load answers a correction with ``answer``; without correction if None."""
    rng = np.random.default_rng(seed)
    found = []
    for speed in SPEEDS:
        values = []
        for order, size in ORDERS.items():
            hertz = float(order_hz(order, speed, RATIO))
            late = cmath.exp(-2j * math.pi * hertz * LAG_S)
            applied = 0.0 if filters is None else 1.0
            if filters:
                applied = complex(gain(filters, np.array([hertz]), CYCLE_S)[0])
            # The error is a function of the target angle, so it reaches the load with the lag of the axis.
            value = size * (late - answer(hertz) * applied)
            value = value.conjugate() if speed < 0.0 else value
            values.append(value + noise_arcsec * complex(*rng.standard_normal(2)))
        spread = np.full(len(ORDERS), max(noise_arcsec, 1e-3))
        mean = -3600.0 * LAG_S * speed
        found.append(Harmonics(speed, np.array(values), spread, mean, 1.0))
    return tuple(found)


def measured(answer, explore: bool = False, trials=(), noise_arcsec: float = 0.0, **changed):
    none = runs(answer, None, noise_arcsec, 1)
    tried = [Trial(runs(answer, (), noise_arcsec, 2))]
    tried += [Trial(runs(answer, each, noise_arcsec, 3), each) for each in trials]
    return response_of(none, tried, orders(), RATIO, CYCLE_S, limits(**changed), explore=explore)


def left(answer, filters, hertz: np.ndarray) -> np.ndarray:
    """Returns the fraction of an order that remains after the correction, at each frequency."""
    late = np.exp(-2j * math.pi * hertz * LAG_S)
    effect = np.array([answer(each) for each in hertz]) * gain(filters, hertz, CYCLE_S)
    return abs(1.0 - effect / late)


@pytest.mark.parametrize("noise_arcsec", [0.0, 0.02])
@pytest.mark.parametrize("hz", [18.0, 31.0, 45.0])
def test_a_narrow_notch_is_inverted_between_the_measured_frequencies(hz, noise_arcsec):
    """A filter without poles would need the length of the notch's ringing, ten times its actual length."""
    answer = resonance(hz, 0.12)
    found = measured(answer, noise_arcsec=noise_arcsec)
    remaining = left(answer, found.filter, np.linspace(1.0, 80.0, 300))
    assert np.median(remaining) < 0.05
    assert np.quantile(remaining, 0.9) < 0.12
    assert remaining.max() < 0.5


def test_the_filter_has_no_peak_where_nothing_was_measured():
    """A pole in a gap between two frequencies would fit both."""
    found = measured(lambda hertz: flat(hertz) * cmath.exp(-2j * math.pi * hertz * 0.002), noise_arcsec=0.1)
    hertz = np.linspace(1.0, 0.9 * found.known_to_hz, 400)
    size = abs(gain(found.filter, hertz, CYCLE_S))
    assert size.max() < 1.3 * abs(1.0 / flat(found.known_to_hz))


def test_a_run_that_explores_extends_the_known_range():
    """Without exploration, the static correction has no effect at high frequencies that exceeds the noise."""

    def answer(hertz: float) -> complex:
        return 1.0 / (1.0 + 1j * hertz / 15.0) ** 2

    first = measured(answer, noise_arcsec=0.08)
    exploring = measured(answer, explore=True, noise_arcsec=0.08)
    second = measured(answer, trials=[exploring.filter], noise_arcsec=0.08)
    assert first.known_to_hz < 70.0
    assert second.known_to_hz > 80.0


def test_an_order_exceeding_the_slew_limit_is_partly_corrected():
    answer = flat
    wide, narrow = measured(answer), measured(answer, slew_arcsec_s=6000.0)
    hertz = np.array([10.0, 60.0])
    sizes = [abs(gain(each.filter, hertz, CYCLE_S)) for each in (wide, narrow)]
    assert sizes[1][0] == pytest.approx(sizes[0][0], rel=0.05)
    assert 12.0 * sizes[1][1] * math.tau * 60.0 < 1.2 * 3000.0
    assert sizes[1][1] > 0.3 * sizes[0][1]
