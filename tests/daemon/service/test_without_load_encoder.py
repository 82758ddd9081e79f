"""An axis without an encoder at its load: the servo is watched, the rest is reported as not available."""

from pathlib import Path

import pytest
from support.keys import changed
from support.raised import measured_profile, without_load_encoder
from support.service import Service, play, stepped_service

from hdbridge.client import messages
from hdbridge.daemon.following.follower import NO_LOAD_ENCODER
from hdbridge.daemon.machine import Machine
from hdbridge.daemon.machinefile import AdaptationSettings
from hdbridge.errors import InputError
from hdbridge.sim.truth import Truth

FAR_DEG = 90.0
SPEED_DEG_S = 60.0


@pytest.fixture(scope="module")
def blind(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Raised limits, a model with the measured response, and the load encoder removed afterwards."""
    return without_load_encoder(measured_profile(tmp_path_factory.mktemp("blind") / "axis"))


def at_work(blind: Path, folder: Path, **servo: float) -> tuple[messages.AxisState, list[str]]:
    """Moves in both directions with these servo parameters; returns the state and all notes."""

    async def story(service: Service) -> tuple[messages.AxisState, list[str]]:
        async with service.enabled() as (bridge, axis, token):
            service.follow(bridge, AdaptationSettings(mode="on"))
            for target in (FAR_DEG, -FAR_DEG, FAR_DEG):
                bridge.lease.check(token)
                await axis.motion.move(token, target, SPEED_DEG_S)
            await axis.disable(token)
            return axis.state(), [each.text for each in bridge.events().events]

    truth = changed(Truth.load(blind / "truth.yaml"), **{f"servo__{key}": servo[key] for key in servo})
    with stepped_service(folder, profile=blind, truth=truth) as service:
        return play(story(service))


def test_features_needing_a_load_encoder_are_reported_as_unavailable(blind: Path, tmp_path: Path) -> None:
    state, noted = at_work(blind, tmp_path)
    assert state.load_position_deg is None
    assert state.error_arcsec is None
    assert state.load_target_deg == pytest.approx(FAR_DEG, abs=0.1)
    assert state.advice == [NO_LOAD_ENCODER]
    assert state.adaptation.frozen == NO_LOAD_ENCODER
    assert not [each for each in noted if "load encoder" in each or "recalibrate" in each], noted


def test_a_retuned_servo_is_reported(blind: Path, tmp_path: Path) -> None:
    state, _ = at_work(blind, tmp_path, position_gain_per_s=110.0)
    verdict, unwatched = state.advice
    assert verdict.startswith("measure the response in motion again")
    assert unwatched == NO_LOAD_ENCODER


def test_a_load_loop_is_refused(blind: Path, tmp_path: Path) -> None:
    machine = tmp_path / "machine.yaml"
    machine.write_text(
        f"schema: hdbridge.machine/1\nname: m\naxes:\n  - profile: {blind}\n    load_loop: {{}}\n"
    )
    with pytest.raises(InputError, match=r"machine.yaml:5:.*axis.yaml:.*expected an encoder at the load"):
        Machine.load(machine)
