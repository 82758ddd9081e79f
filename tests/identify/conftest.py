"""Fixtures of this folder: records of synthetic axes from formulas, independent of the tested code."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from support.legs import Leg, fit

from hdbridge.analysis.identification import FitOptions, FitResult
from hdbridge.axis.effects import Start

RATE_HZ = 50.0


@dataclass
class Axis:
    """Ideal axis with a transmission error like the article's, and noisy encoders of finite resolution."""

    ratio: float = 20.0
    orders: dict[int, tuple[float, float]] = field(
        default_factory=lambda: {1: (5.0, -120.0), 2: (9.0, 30.0), 6: (3.0, 100.0)}
    )
    offset: float = 40.0
    width: float = 18.0
    exponent: float = 1.7
    noise: float = 0.5
    load_first: float = 0.0
    motor_counts: float = 65536.0
    behind_counts: float = 0.0
    """Lag of the motor behind its encoder in the direction of motion, counts."""
    zero_arcsec: float = 700.0

    def error(self, motor_deg: np.ndarray, state: float = 1.0) -> np.ndarray:
        """Computes the transmission error, arcsec; ``state`` is the initial saturation, +1 or -1."""
        radians = np.deg2rad(motor_deg)
        total = sum(
            amplitude * np.cos(order * radians + np.deg2rad(phase))
            for order, (amplitude, phase) in self.orders.items()
        )
        total = total + self.load_first * np.cos(radians / self.ratio + 0.4)
        loop, begin, before, sign = np.empty(len(motor_deg)), motor_deg[0], state, state
        loop[0] = state
        for index in range(1, len(motor_deg)):
            step = np.sign(motor_deg[index] - motor_deg[index - 1])
            if step and step != sign:
                begin, before, sign = motor_deg[index - 1], loop[index - 1], step
            xi = min(abs(motor_deg[index] - begin) / self.width, 1.0)
            n = self.exponent
            rise = (xi ** (n - 1) - (n - 1) * xi) / (2 - n) if n != 2 else xi * (1 - np.log(xi or 1))
            loop[index] = sign * min(sign * before + 2 * rise, 1.0)
        return total + self.offset * loop

    def record(self, legs: list[tuple[str, np.ndarray]], seed: int = 0, state: float = 1.0) -> list[Leg]:
        """Records legs of motor angles, one after the other, at `RATE_HZ`; ``state`` is that of `error`."""
        rng = np.random.default_rng(seed)
        motor = np.concatenate([each for _, each in legs])
        count = 360.0 / self.motor_counts
        motor = np.round(motor / count) * count
        true = motor - self.behind_counts * count * np.sign(np.diff(motor, prepend=motor[0]))
        error = self.error(true, state) + self.zero_arcsec + rng.normal(size=len(motor)) * self.noise
        load = true / self.ratio + error / 3600.0
        time = np.arange(len(motor)) / RATE_HZ
        segments, at = [], 0
        for kind, leg in legs:
            part = slice(at, at + len(leg))
            segments.append(Leg(time[part], motor[part], load[part], kind))
            at += len(leg)
        return segments


def ramp(begin: float, end: float, motor_deg_s: float) -> np.ndarray:
    """Returns motor angles at constant speed, without the first point."""
    count = max(round(abs(end - begin) / motor_deg_s * RATE_HZ), 1)
    return np.linspace(begin, end, count + 1)[1:]


def wave(amplitude_deg: float, periods: float = 2.0, period_s: float = 10.0) -> np.ndarray:
    """Returns a sine of motor angles about zero that begins at its maximum, without the first point."""
    time = np.arange(1, int(periods * period_s * RATE_HZ) + 1) / RATE_HZ
    return amplitude_deg * np.cos(2 * np.pi * time / period_s)


def bench_plan(turns: float = 20.0, speed: float = 200.3) -> list[tuple[str, np.ndarray]]:
    """Returns the legs of a bench plan, motor degrees: rest, sweeps, sines of three amplitudes, reversals."""
    end = 360.0 * turns
    legs = [
        ("standstill", np.zeros(int(10 * RATE_HZ))),
        ("sweep", ramp(0.0, end, speed)),
        ("sweep", ramp(end, 0.0, speed)),
    ]
    for amplitude in (180.0, 45.0, 5.0):
        legs += [("move", ramp(0.0, amplitude, 400.0)), ("sine", wave(amplitude))]
        legs += [("move", ramp(amplitude, -60.0, 400.0)), ("move", ramp(-60.0, 0.0, 400.0))]
    for depth in (4.0, 8.0, 16.0):
        legs += [("move", ramp(0.0, -60.0, 400.0))]
        for begin, to in (
            (-60.0, 0.0),
            (0.0, -depth),
            (-depth, -depth / 2),
            (-depth / 2, -depth),
            (-depth, 0.0),
        ):
            legs.append(("reversal", ramp(begin, to, 10.3)))
    return legs


@dataclass(frozen=True)
class Bench:
    """The helpers of this module, as one object for the tests."""

    axis = Axis
    ramp = staticmethod(ramp)
    wave = staticmethod(wave)
    plan = staticmethod(bench_plan)
    rate_hz = RATE_HZ
    options = FitOptions(start=Start.FORWARD, highest_order=12)


@pytest.fixture(scope="session")
def bench() -> Bench:
    return Bench()


@pytest.fixture(scope="session")
def standard(bench: Bench) -> FitResult:
    """Returns the fit to the standard axis on the standard plan, without an active model."""
    return fit(Axis().record(bench_plan()), 20.0, bench.options)
