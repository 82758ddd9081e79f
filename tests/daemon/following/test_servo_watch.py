"""A servo retuned since the response in motion was measured is reported, and the response refined."""

import math
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.adapting import History
from support.daemon import stepped_daemon
from support.keys import changed
from support.raised import measured_response, raised_profile

from hdbridge import AxisConfig, TransmissionModel
from hdbridge.analysis.response import answers
from hdbridge.axis.model.response import LeadFilter, Response
from hdbridge.client import messages
from hdbridge.daemon.following.follower import Follower
from hdbridge.daemon.following.judging import Verdict
from hdbridge.daemon.machinefile import AdaptationSettings
from hdbridge.daemon.memory import CommandKind
from hdbridge.enums import AdaptationMode
from hdbridge.sim.truth import Truth

SPEEDS_DEG_S = (61.7, 43.3)
"""At 60 and 45 deg/s the motor advances by 266 2/3 and 200 counts a cycle: the error of its counts repeats,
and no average removes it.
"""


@pytest.fixture(scope="module")
def profile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return raised_profile(tmp_path_factory.mktemp("raised") / "fast")


class Seen(NamedTuple):
    verdicts: list[Verdict]
    events: list[str]
    """Events of the adaptation's history about the response."""
    responses: list[Response | None]
    """Responses that have replaced the committed one."""
    state: messages.AdaptationState


def seen(profile, mode=AdaptationMode.ON, stuck=False, **servo):
    """Returns verdicts and refinements over moves in both directions, with these servo parameters."""
    axis = AxisConfig.load(profile)
    model = replace(TransmissionModel.load(profile / "model.yaml"), response=measured_response(profile))
    truth = changed(Truth.load(profile / "truth.yaml"), **{f"servo__{key}": servo[key] for key in servo})
    verdicts: list[Verdict] = []
    responses: list[Response | None] = []
    history = History()
    with stepped_daemon([axis], model=model, truth=truth) as daemon:
        daemon.verify()
        daemon.enable()
        daemon.run(0.6)
        samples = daemon.memory.reader()
        follower = Follower(axis, model, settings=AdaptationSettings(interval_s=1.0))
        follower.adapt(mode, history)  # type: ignore[arg-type]
        assert follower.adaptation is not None
        if stuck:
            daemon.nodes[0].faults.load_reading = lambda _: 0
        for speed in SPEEDS_DEG_S:
            for target in (90.0, -90.0):
                daemon.post(CommandKind.MOVE, 0, a=target, b=speed, c=math.nan)
                daemon.turn()
                while not daemon.axes[0].set_point.at_rest:
                    daemon.turn(25)
                    verdicts += [each.verdict for each in follower.take(samples.read()[0]) or ()]
                    used = follower.adaptation.model.response
                    if used is not (responses[-1] if responses else model.response):
                        responses.append(used)
        events = [each["event"] for each in history.entries if "refine" in each["event"]]
        return Seen(verdicts, events, responses, follower.state())


def test_the_same_servo_is_neither_reported_nor_refined(profile: Path) -> None:
    assert seen(profile)[:3] == ([], [], [])


@pytest.mark.parametrize(
    "servo", [{"position_gain_per_s": 130.0}, {"position_gain_per_s": 270.0}, {"command_filter_ms": 2.6}]
)
def test_a_retuned_servo_is_reported_and_the_response_refined(profile: Path, servo: dict[str, float]) -> None:
    found = seen(profile, **servo)
    assert Verdict.RETUNED in found.verdicts
    committed = measured_response(profile)
    assert found.responses
    assert found.events == ["refined"] * len(found.responses)
    for each in found.responses:
        assert each is not None
        change = abs(without_lag(committed) / without_lag(each) - 1.0)
        assert 0.02 < change.max() < 1.01 * AdaptationSettings().bound_share
    shown, last = found.state.response, found.responses[-1]
    assert shown is not None
    assert last is not None
    change = abs(without_lag(last) / without_lag(committed) - 1.0)
    assert shown.percent == pytest.approx(100.0 * change.max())
    assert shown.at_hz == committed.frequency_hz[change.argmax()]
    assert change[np.searchsorted(committed.frequency_hz, shown.low_hz)] >= 0.01
    assert f"{shown.low_hz:.0f} to {shown.high_hz:.0f} Hz" in str(shown)


def without_lag(response: Response) -> np.ndarray:
    turned = np.radians(response.phase_deg) + math.tau * 0.001 * response.following_lag_ms * np.array(
        response.frequency_hz
    )
    return np.array(response.gain) * np.exp(1j * turned)


@pytest.mark.parametrize(
    ("mode", "stuck"),
    [(AdaptationMode.OFF, False), (AdaptationMode.ON, True), (AdaptationMode.OBSERVE, False)],
)
def test_refinement_needs_a_trusted_encoder_and_permission(profile, mode, stuck):
    found = seen(profile, mode, stuck, position_gain_per_s=130.0)
    assert Verdict.RETUNED in found.verdicts
    assert not found.responses
    assert found.events == ["would refine"] * (mode is AdaptationMode.OBSERVE)
    assert ("load encoder" in (found.state.frozen or "")) == stuck
    assert found.state.response is None


@given(
    speed=st.floats(20.0, 100.0) | st.floats(-100.0, -20.0),
    later_ms=st.floats(0.0, 4.0),
    gain=st.floats(0.3, 3.0),
    phase_deg=st.floats(-90.0, 90.0),
)
def test_gain_and_phase_changes_are_detected_but_a_pure_delay_is_not(speed, later_ms, gain, phase_deg):
    """The motor follows its set-points with a gain, a phase, and its lag."""
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
    given = list(answers(stored, speed, lag_s, speed * at_s, issued, motor, orders, ratio))
    assert [place for place, _ in given] == [0, 1]
    for place, found in given:
        hertz = orders[place] * abs(speed) * ratio / 360.0
        assert found.frequency_hz == pytest.approx(hertz)
        assert found.response == pytest.approx(gain * np.exp(1j * math.radians(phase_deg)), rel=1e-3)
