"""The watch reports a servo that was retuned since the response in motion was measured."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.daemon import stepped_daemon
from support.raised import measured_response, raised_profile

from hdbridge import AxisConfig, TransmissionModel
from hdbridge.analysis.response import answers
from hdbridge.axis.model.response import LeadFilter, Response
from hdbridge.daemon.following.follower import Follower
from hdbridge.daemon.following.judging import Raised, Verdict
from hdbridge.daemon.memory import CommandKind
from hdbridge.sim.truth import Truth

SPEEDS_DEG_S = (60.0, 45.0)


@pytest.fixture(scope="module")
def profile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return raised_profile(tmp_path_factory.mktemp("raised") / "fast")


def raised(profile: Path, **servo: float) -> list[Raised]:
    """Verdicts over moves there and back, with these parameters of the servo."""
    axis = AxisConfig.load(profile)
    model = replace(TransmissionModel.load(profile / "model.yaml"), response=measured_response(profile))
    truth = Truth.load(profile / "truth.yaml")
    truth = truth.model_copy(update={"servo": truth.servo.model_copy(update=servo)})
    found: list[Raised] = []
    with stepped_daemon([axis], model=model, truth=truth) as daemon:
        daemon.verify()
        daemon.enable()
        daemon.run(0.6)
        samples, follower = daemon.memory.reader(), Follower(axis, model)
        for speed in SPEEDS_DEG_S:
            for target in (90.0, -90.0):
                daemon.post(CommandKind.MOVE, 0, a=target, b=speed, c=math.nan)
                daemon.turn()
                while not daemon.axes[0].set_point.at_rest:
                    daemon.turn(25)
                    found += follower.take(samples.read()[0]).raised
    return found


def test_the_same_servo_is_not_reported(profile: Path) -> None:
    assert raised(profile) == []


@pytest.mark.parametrize(
    "servo", [{"position_gain_per_s": 130.0}, {"position_gain_per_s": 270.0}, {"command_filter_ms": 2.6}]
)
def test_a_retuned_servo_is_reported(profile: Path, servo: dict[str, float]) -> None:
    verdicts = [each.verdict for each in raised(profile, **servo)]
    assert Verdict.RETUNED in verdicts, verdicts


@given(
    speed=st.floats(20.0, 100.0) | st.floats(-100.0, -20.0),
    later_ms=st.floats(0.0, 4.0),
    gain=st.floats(0.3, 3.0),
    phase_deg=st.floats(-90.0, 90.0),
)
def test_gain_and_phase_are_seen_in_both_directions_and_a_delay_alone_is_none(
    speed: float, later_ms: float, gain: float, phase_deg: float
) -> None:
    """The motor answers its set-points with a gain, a phase, and its lag."""
    ratio, orders = 50.0, (2, 4)
    stored = Response(
        cycle_ms=4.0, following_lag_ms=10.0, known_to_hz=90.0, frequency_hz=(1.0, 90.0), gain=(1.0, 1.0),
        phase_deg=(-3.6, -324.0), uncertainty=(0.01, 0.01),
        filter=LeadFilter(lead_cycles=0, per_cycle=1, full_speed_deg_s=1.0, weights=(1.0,)),
    )  # fmt: skip
    at_s = 0.004 * np.arange(500)
    lag_s = 0.001 * (10.0 + later_ms)

    def angle(time_s: np.ndarray, size: float, turned_deg: float) -> np.ndarray:
        turned = np.sign(speed) * math.radians(turned_deg)
        waves = (np.cos(math.tau * k * speed * ratio / 360.0 * time_s + 0.7 * k + turned) for k in orders)
        return ratio * (speed * time_s + size * sum(waves) / 360.0)

    issued, motor = angle(at_s, 1.0, 0.0), angle(at_s - lag_s, gain, phase_deg)
    for place, found in answers(stored, speed, lag_s, speed * at_s, issued, motor, orders, ratio):
        hertz = orders[place] * abs(speed) * ratio / 360.0
        expected = gain * np.exp(1j * math.radians(phase_deg))
        kept = stored_at(stored, hertz) * np.exp(2j * math.pi * 0.01 * hertz)
        assert found.response * kept == pytest.approx(expected, rel=1e-3)


def stored_at(stored: Response, hertz: float) -> complex:
    """The stored response, interpolated linearly as a complex number."""
    values = np.array(stored.gain) * np.exp(1j * np.radians(stored.phase_deg))
    return complex(
        np.interp(hertz, stored.frequency_hz, values.real), np.interp(hertz, stored.frequency_hz, values.imag)
    )
