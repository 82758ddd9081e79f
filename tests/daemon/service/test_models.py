"""Compensation of an axis: schemes and models, changed at rest and in motion without a step."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.effect_examples import EXAMPLES
from support.service import Service, stepped_service, until

from hdbridge.axis.effects import Hysteresis
from hdbridge.axis.model import TransmissionModel, store
from hdbridge.control.bench import compensation_for
from hdbridge.control.switchover import Correction
from hdbridge.daemon.machinefile import LoadLoopSettings
from hdbridge.daemon.memory import Cell
from hdbridge.daemon.service.bridge import ServiceBridge
from hdbridge.daemon.setting import CompensationSetting
from hdbridge.enums import Scheme
from hdbridge.errors import DaemonError, InputError, RefusedError

NOW = datetime(2026, 3, 1, tzinfo=UTC)


def wider(model: TransmissionModel) -> TransmissionModel:
    """Returns the model with 1.5 times the hysteresis offset."""
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
    """Returns the change of the correction from cycle to cycle, arcsec."""
    return np.abs(np.diff(samples["axes"][:, 0]["correction_arcsec"]))


async def test_schemes_are_cross_faded_in_motion(service: Service) -> None:
    async with service.enabled() as (bridge, axis, token):
        assert axis.state().scheme == "extended"
        await axis.motion.move(token, 2.0)
        await axis.motion.move(token, 200.0, velocity_deg_s=0.5, wait=False)
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


async def test_a_new_model_is_committed_and_used_in_motion(service: Service) -> None:
    async with service.enabled() as (bridge, axis, token):
        first = axis.state().model
        commit(service, wider(axis.models.in_use.model))
        await axis.motion.move(token, 200.0, velocity_deg_s=0.5, wait=False)
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


async def test_a_missing_or_foreign_model_changes_nothing(service: Service) -> None:
    async with service.enabled() as (_, axis, token):
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


@pytest.mark.parametrize("service", [{"model": TransmissionModel(50.0)}], indirect=True)
async def test_an_axis_without_a_model_runs_uncompensated(service: Service) -> None:
    service.machine.axes[0].profile.model.unlink()
    async with service.enabled() as (_, axis, token):
        assert axis.state().model is None
        await axis.motion.move(token, 5.0)
        with pytest.raises(InputError, match="calibrate"):
            await axis.compensate(token, Scheme.EXTENDED)
        await axis.compensate(token, Scheme.NONE)


SCHEMES = {"axis1": "synchronous", "axis2": "hysteresis"}


def used(service: Service) -> list[list[str]]:
    """The effects that the control loop compensates on each axis."""
    return [[each.name for each in axis.follower.correction.model.effects] for axis in service.daemon.axes]


def settled(bridge: ServiceBridge) -> bool:
    return all(axis.models.settled for axis in bridge.axes.values())


def watched(service: Service, bridge: ServiceBridge) -> list[tuple[list[str], list[str]]]:
    """Returns differences between the effects in use and those that the API reports, over a second."""
    differing = []
    for _ in range(round(1.0 / service.daemon.period_s)):
        service.daemon.turn()
        said = [
            [] if axis.models.in_use.scheme is Scheme.NONE else
            [each.name for each in axis.models.in_use.compensating.effects]
            for axis in bridge.axes.values()
        ]  # fmt: skip
        if said != used(service):
            differing.append((said, used(service)))
    return differing


@pytest.fixture
def pair(tmp_path: Path):
    """Two axes, the second with a load loop."""
    with stepped_service(tmp_path, axes=2) as made:
        first, second = made.machine.axes
        made.machine = replace(made.machine, axes=(first, replace(second, load_loop=LoadLoopSettings())))
        yield made


def begin_uncompensated(service: Service) -> None:
    """Restarts the control process as the keeper does: with no model, and a new process number."""
    service.daemon.begin_again()
    for axis in service.daemon.axes:
        axis.follower.correction = Correction(
            compensation_for(axis.config, TransmissionModel(axis.config.gear.ratio))
        )
    status = service.daemon.memory.status
    status[Cell.LOOP_PID] = status[Cell.LOOP_PID] + 1


async def choose(bridge: ServiceBridge, token: str) -> None:
    for name, scheme in SCHEMES.items():
        await bridge.axes[name].compensate(token, Scheme(scheme))


async def test_each_axis_keeps_its_compensation_over_restarts_of_the_control_process(pair: Service) -> None:
    async with pair.enabled() as (bridge, _, token):
        await choose(bridge, token)
        for _ in range(7):
            begin_uncompensated(pair)
            assert [axis.state().scheme for axis in bridge.axes.values()] == ["none", "none"]
            assert not any(axis.state().load_loop.on for axis in bridge.axes.values())
            await until(bridge, lambda: settled(bridge))
            assert used(pair) == [["synchronous"], ["hysteresis"]]
            assert [axis.state().scheme for axis in bridge.axes.values()] == [*SCHEMES.values()]
            assert [axis.state().load_loop.on for axis in bridge.axes.values()] == [False, True]
        texts = [each.text for each in bridge.events().events]
        assert "the control process was started again: every axis is disabled" in texts


async def test_an_axis_is_enabled_with_its_chosen_compensation_only(pair: Service) -> None:
    async with pair.leased() as (bridge, _, token):
        await choose(bridge, token)
        begin_uncompensated(pair)
        await bridge.axes["axis2"].enable(token)
        assert used(pair)[1] == ["hysteresis"]


@pytest.mark.parametrize("lost", range(1, 4))
async def test_lost_settings_are_sent_again(pair: Service, lost: int) -> None:
    async with pair.leased() as (bridge, _, token):
        await choose(bridge, token)
        begin_uncompensated(pair)
        for _ in range(lost):  # each time the new control process dies before it has read a command
            await bridge.core.timing.sleep(0.0)
            bridge.core.poll()
            begin_uncompensated(pair)
        await until(bridge, lambda: settled(bridge))
        assert used(pair) == [["synchronous"], ["hysteresis"]]


async def test_a_new_service_reads_the_settings_in_use(pair: Service) -> None:
    async with pair.enabled() as (bridge, _, token):
        await choose(bridge, token)
        await bridge.axes["axis2"].switch_load_loop(token, on=False)
        chosen = [axis.models.chosen for axis in bridge.axes.values()]
    for axis in pair.machine.axes:
        axis.profile.model.unlink()  # the next process needs no file for it
    before = pair.daemon.memory.settings[0].number
    async with pair.bridge() as bridge:
        assert [axis.models.in_use for axis in bridge.axes.values()] == chosen
        assert [axis.state().scheme for axis in bridge.axes.values()] == [*SCHEMES.values()]
        assert not bridge.axes["axis2"].state().load_loop.on
        assert pair.daemon.memory.settings[0].number == before  # nothing was sent again
        # Both processes die.
    begin_uncompensated(pair)
    async with pair.bridge() as bridge:
        assert settled(bridge)
        assert used(pair) == [["synchronous"], ["hysteresis"]]


async def test_a_half_written_setting_falls_back_to_the_machine_file(pair: Service) -> None:
    async with pair.enabled() as (bridge, _, token):
        await choose(bridge, token)
    slot = pair.daemon.memory.settings[0]
    slot._sent[0] = -slot.number - 1
    async with pair.bridge() as bridge:
        assert settled(bridge)
        assert [axis.state().scheme for axis in bridge.axes.values()] == ["extended", "hysteresis"]
        assert used(pair) == [["synchronous", "hysteresis"], ["hysteresis"]]


async def test_refused_settings_are_never_reported_or_repeated(pair: Service) -> None:
    async with pair.enabled() as (bridge, axis, token):
        await choose(bridge, token)
        other = replace(axis.models.chosen, model=replace(axis.models.chosen.model, ratio=50.1))
        with pytest.raises(RefusedError, match="ratio"):
            await axis._use(other)
        assert axis.state().scheme == "synchronous"
        assert not watched(pair, bridge)
        await until(bridge, lambda: settled(bridge))
    async with pair.bridge() as bridge:
        assert [axis.state().scheme for axis in bridge.axes.values()] == [*SCHEMES.values()]


async def test_late_answers_change_no_report(pair: Service) -> None:
    async with pair.enabled() as (bridge, axis, token):
        await choose(bridge, token)
        daemon = pair.daemon
        turn, daemon.controller.turn = daemon.controller.turn, lambda: daemon.hang(daemon.period_s)
        with pytest.raises(DaemonError, match="did not answer"):
            await axis.compensate(token, Scheme.EXTENDED)
        assert axis.state().scheme == "synchronous"
        daemon.controller.turn = turn
        assert not watched(pair, bridge)
        await until(bridge, lambda: settled(bridge))
        assert used(pair) == [["synchronous"], ["hysteresis"]]


@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_a_setting_reads_back_exactly(data: st.DataObject) -> None:
    names = data.draw(st.lists(st.sampled_from(sorted(EXAMPLES)), unique=True, max_size=5))
    effects = [data.draw(EXAMPLES[each]) for each in names]
    model = TransmissionModel(
        data.draw(st.floats(30.0, 200.0)), tuple(effects), {each: {"offset_arcsec": 0.3} for each in names},
        {"axis": "arm", "date": "2026-03-01T12:00:00+00:00", "drive": {"vendor": 0x539}},
    )  # fmt: skip
    setting = CompensationSetting(
        model, data.draw(st.sampled_from(Scheme)), data.draw(st.none() | st.integers(1, 99)),
        data.draw(st.none() | st.just(Path("/a/model.yaml"))), data.draw(st.booleans()),
        data.draw(st.none() | st.just(replace(model, ratio=50.0))),
    )  # fmt: skip
    assert CompensationSetting.from_json(setting.to_json()) == setting


LOAD_LOOP = LoadLoopSettings(gain_1_s=0.5, maximum_arcsec=20.0)


@pytest.mark.parametrize("service", [{"load_loop": LOAD_LOOP}], indirect=True, ids=["loop"])
async def test_an_inactive_load_loop_reports_its_reason(service: Service) -> None:
    service.machine = replace(service.machine, axes=(replace(service.machine.axes[0], load_loop=LOAD_LOOP),))
    async with service.enabled() as (bridge, axis, token):
        encoder = service.daemon.nodes[0].faults
        await bridge.core.timing.sleep(3.0)
        assert axis.state().load_loop.doubt is None
        for _ in range(2):
            encoder.load_jump_counts = 150
            await until(bridge, lambda: axis.state().load_loop.doubt is not None)
            assert "the load encoder moved by" in axis.state().load_loop.doubt
            encoder.load_jump_counts = 0
            await until(bridge, lambda: axis.state().load_loop.doubt is None)
        events = [each for each in bridge.events().events if each.kind == "load-loop"]
        assert ["acts again" in each.text for each in events] == [False, True, False, True]
        assert {each.axis for each in events} == {"axis1"}
        encoder.load_jump_counts = 150
        await until(bridge, lambda: axis.state().load_loop.doubt is not None)
        for on in (False, True):
            await axis.switch_load_loop(token, on=on)
        await until(bridge, lambda: axis.state().load_loop.doubt is None, timeout_s=1.0)
