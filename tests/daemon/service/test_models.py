"""What compensates an axis: schemes and models, changed at rest and in motion without a step."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from support.service import Service, play, stepped_service, until

from hdbridge.effects import Hysteresis
from hdbridge.errors import InputError
from hdbridge.evaluation.stepping import Scheme
from hdbridge.model import TransmissionModel, store

NOW = datetime(2026, 3, 1, tzinfo=UTC)


@pytest.fixture
def service(tmp_path: Path):
    with stepped_service(tmp_path) as made:
        yield made


def wider(model: TransmissionModel) -> TransmissionModel:
    """The model with half as much hysteresis again."""
    effects = tuple(
        each.model_copy(update={"offset_arcsec": 1.5 * each.offset_arcsec})
        if isinstance(each, Hysteresis)
        else each
        for each in model.effects
    )
    assert effects != model.effects
    return replace(model, effects=effects)


def commit(service: Service, model: TransmissionModel) -> None:
    folder = service.machine.axes[0].profile.folder
    store.propose(folder, model, "a test", NOW)


def steps(samples: np.ndarray) -> np.ndarray:
    """By how much the correction changes from cycle to cycle, arcsec."""
    return np.abs(np.diff(samples["axes"][:, 0]["correction_arcsec"]))


def test_schemes_are_faded_over_in_motion(service: Service) -> None:
    async def story() -> None:
        async with service.enabled() as (bridge, token):
            axis = bridge.axes["axis1"]
            assert axis.state().scheme == "extended"
            await axis.move(token, 2.0)
            await axis.move(token, 200.0, velocity_deg_s=0.5, wait=False)
            await bridge.core.timing.sleep(1.0)
            reader = service.daemon.memory.reader()
            for scheme in (Scheme.SYNCHRONOUS, Scheme.NONE, Scheme.HYSTERESIS, Scheme.EXTENDED):
                await axis.compensate(token, scheme)
                assert axis.state().scheme == scheme.value
                assert axis.state().compensating is (scheme is not Scheme.NONE)
                await bridge.core.timing.sleep(1.0)
                if scheme is Scheme.NONE:
                    assert axis.state().correction_arcsec == pytest.approx(0.0, abs=1e-6)
                assert not axis.state().at_rest
            samples, lost = reader.read()
            assert lost == 0
            assert steps(samples).max() < 1.0
            assert not service.daemon.axes[0].supervision.stop

    play(story())


def test_another_model_is_committed_and_used_in_motion(service: Service) -> None:
    async def story() -> None:
        async with service.enabled() as (bridge, token):
            axis = bridge.axes["axis1"]
            first = axis.state().model
            commit(service, wider(axis.models.in_use.model))
            await axis.move(token, 200.0, velocity_deg_s=0.5, wait=False)
            await bridge.core.timing.sleep(1.0)
            reader = service.daemon.memory.reader()
            await axis.activate_model(token, "pending")
            in_use = axis.state().model
            assert in_use.version is not None
            assert in_use.reason == "a test"
            assert in_use.age_s > 0.0
            folder = service.machine.axes[0].profile.folder
            assert store.find(folder, "active").number == in_use.version
            samples, _ = reader.read()
            assert steps(samples).max() < 1.0
            await axis.activate_model(token, in_use.version - 1)
            assert axis.state().model.version == in_use.version - 1
            assert axis.state().model.effects == first.effects
            assert store.find(folder, "active").number == in_use.version - 1

    play(story())


def test_a_model_that_is_not_there_or_not_of_this_axis_changes_nothing(service: Service) -> None:
    async def story() -> None:
        async with service.enabled() as (bridge, token):
            axis = bridge.axes["axis1"]
            before = axis.state().model
            with pytest.raises(InputError, match="no model '7'"):
                await axis.activate_model(token, 7)
            with pytest.raises(InputError, match="no model 'pending'"):
                await axis.activate_model(token, "pending")
            other = axis.models.in_use.model
            text = replace(other, provenance={**other.provenance, "axis": "another"})
            text.save(service.machine.axes[0].profile.folder / "pending.yaml")
            with pytest.raises(InputError, match="another"):
                await axis.activate_model(token, "pending")
            after = axis.state().model
            assert (after.version, after.effects, after.file) == (before.version, before.effects, before.file)

    play(story())


def test_an_axis_without_a_model_runs_uncompensated(tmp_path: Path) -> None:
    async def story(service: Service) -> None:
        service.machine.axes[0].profile.model.unlink()
        async with service.enabled() as (bridge, token):
            axis = bridge.axes["axis1"]
            assert axis.state().model is None
            await axis.move(token, 5.0)
            with pytest.raises(InputError, match="calibrate"):
                await axis.compensate(token, Scheme.EXTENDED)
            await axis.compensate(token, Scheme.NONE)

    with stepped_service(tmp_path, model=TransmissionModel(50.0)) as service:
        play(story(service))


def test_a_new_control_process_gets_what_was_in_use(service: Service) -> None:
    from hdbridge.daemon.memory import Cell

    async def story() -> None:
        async with service.enabled() as (bridge, token):
            axis = bridge.axes["axis1"]
            service.daemon.memory.status.set(Cell.LOOP_PID, 1)
            await bridge.core.timing.sleep(0.1)
            await axis.compensate(token, Scheme.SYNCHRONOUS)
            number = service.daemon.memory.blobs.number
            service.daemon.memory.status.set(Cell.LOOP_PID, 2)
            await until(bridge, lambda: service.daemon.memory.blobs.number > number)
            told = [each.text for each in bridge.events().events]
            assert "the control process was started again: every axis is disabled" in told
            assert axis.state().scheme == "synchronous"

    play(story())
