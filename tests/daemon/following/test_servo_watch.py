"""The watch reports a servo that was retuned since the response in motion was measured."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
from support.daemon import stepped_daemon
from support.raised import measured_response, raised_profile

from hdbridge import AxisConfig, TransmissionModel
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
