"""The adaptation through the whole daemon: samples come from the loop, and a changed model goes to it."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.adapting import truth_of
from support.service import Service, stepped_service, until

from hdbridge.axis.effects import Hysteresis
from hdbridge.client import messages
from hdbridge.daemon.machinefile import AdaptationSettings
from hdbridge.daemon.memory import EventKind
from hdbridge.daemon.service.bridge import ServiceBridge
from hdbridge.daemon.service.following import Following
from hdbridge.enums import Scheme

QUICK = AdaptationSettings(mode="on", interval_s=3.0, rate_arcsec_per_hour=7200.0, half_life_turns=10.0)


@pytest.fixture
def service(tmp_path: Path):
    """Axis whose loop is a tenth higher than that of its model."""
    grown = truth_of(1e-3, growth=0.1, second_order_arcsec=0.0)
    with stepped_service(tmp_path, truth=grown) as made:
        axes = tuple(replace(each, adaptation=QUICK) for each in made.machine.axes)
        made.machine = replace(made.machine, axes=axes)
        yield made


@asynccontextmanager
async def adapting(service: Service) -> AsyncIterator[tuple[ServiceBridge, str, Following]]:
    """Adaptation assembled as in the service process."""
    async with service.enabled() as (bridge, _, token):
        made = service.follow(bridge, service.machine.axes[0].adaptation)
        yield bridge, token, made
        made.close()


async def work(bridge: ServiceBridge, token: str, stands: int, seed: int = 0) -> None:
    axis, place = bridge.axes["axis1"], 10.0
    for step in np.random.default_rng(seed).normal(0.0, 3.0, stands).tolist():
        place = abs(place + step)
        bridge.lease.check(token)
        await axis.motion.move(token, place)
        await bridge.core.timing.sleep(0.2)


def offset_arcsec(bridge: ServiceBridge) -> float:
    """Returns the hysteresis offset of the model in use, arcsec."""
    effects = bridge.axes["axis1"].models.in_use.compensating.effects
    return next(each.offset_arcsec for each in effects if isinstance(each, Hysteresis))


async def test_the_model_in_the_loop_is_adapted_and_reverted(service: Service) -> None:
    async with adapting(service) as (bridge, token, _):
        reader = service.daemon.memory.reader()
        await work(bridge, token, 70)
        samples, _ = reader.read()
        samples = samples["axes"][:, 0]
        stands = (samples["velocity_deg_s"] == 0.0) & (samples["weight"] == 1.0)
        changed = np.abs(np.diff(samples["correction_arcsec"]))[stands[1:] & stands[:-1]]
        assert 0.0 < float(np.max(changed)) < 0.5  # per cycle, because the four arcsec are faded in
        assert offset_arcsec(bridge) == pytest.approx(44.0, abs=1.0)
        assert service.daemon.reported(EventKind.CHANGED)
        state = bridge.axes["axis1"].state().adaptation
        assert state.mode == messages.AdaptationMode.ON
        assert state.frozen is None
        assert state.updated is not None
        assert state.parameters["hysteresis.offset_arcsec"] == pytest.approx(4.0, abs=1.0)

        await bridge.axes["axis1"].following_for(token).revert()
        assert offset_arcsec(bridge) == 40.0
        await work(bridge, token, 20, seed=1)
        assert offset_arcsec(bridge) == 40.0
        assert bridge.axes["axis1"].state().adaptation.mode == messages.AdaptationMode.OBSERVE


async def test_the_adaptation_survives_another_scheme_and_a_new_loop(service: Service) -> None:
    async with adapting(service) as (bridge, token, made):
        await work(bridge, token, 50)
        axis = bridge.axes["axis1"]
        learnt = offset_arcsec(bridge)
        assert learnt > 42.0
        await made.set_mode(messages.AdaptationMode.OBSERVE)
        await axis.compensate(token, Scheme.HYSTERESIS)
        assert offset_arcsec(bridge) == learnt
        assert len(axis.models.in_use.compensating.effects) == 1
        service.daemon.begin_again()
        await until(bridge, lambda: axis.models.settled)
        assert offset_arcsec(bridge) == learnt


async def test_an_impossible_adaptation_does_not_block_the_axis(service: Service) -> None:
    settings = QUICK.model_copy(update={"parameters": ("backlash.gap_arcsec",)})
    axes = tuple(replace(each, adaptation=settings) for each in service.machine.axes)
    service.machine = replace(service.machine, axes=axes)
    async with adapting(service) as (bridge, token, _):
        await work(bridge, token, 1)
        frozen = bridge.axes["axis1"].state().adaptation.frozen
        assert frozen is not None
        assert "'backlash.gap_arcsec' is not a parameter that wear or temperature changes" in frozen
