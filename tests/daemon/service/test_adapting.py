"""The adaptation behind the service: what it moves, the control process compensates by."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from support.service import Service, play, stepped_service, until

from hdbridge.client.messages import AdaptationMode
from hdbridge.daemon.adaptation.settings import AdaptationSettings
from hdbridge.daemon.adaptation.sink import followed
from hdbridge.daemon.memory import EventKind
from hdbridge.daemon.service.adapting import Adapting
from hdbridge.daemon.service.bridge import ServiceBridge

MOVED_ARCSEC = 2.0


def now() -> datetime:
    return datetime.now(UTC)


def learnt(service: Service, folder: Path, settings: AdaptationSettings) -> None:
    """Leave what an earlier service has learnt: the first coefficient moved, and in use so."""
    axis = service.machine.axes[0]
    one = followed(axis.config, axis.model(), settings, folder, now)
    memory = one.adaptation.memory()
    estimate, applied = ((MOVED_ARCSEC, *each[1:]) for each in (memory.estimate, memory.applied))
    one.keeping.save(one.fingerprint, replace(memory, estimate=estimate, applied=applied, windows=5))


def adapting(bridge: ServiceBridge, settings: AdaptationSettings, folder: Path) -> Adapting:
    (axis,) = bridge.axes.values()
    made = Adapting(0, axis, settings, folder, ThreadPoolExecutor(1))
    bridge.core.observer.add(made)
    bridge.adaptations[axis.name] = made
    return made


def changes(bridge: ServiceBridge) -> int:
    entries = bridge.core.log.since(0)
    return sum(each.event is not None and each.event.kind is EventKind.CHANGED for each in entries)


def test_what_was_learnt_is_used_again_and_taken_back(tmp_path: Path) -> None:
    settings = AdaptationSettings(mode="on")
    folder = tmp_path / "adaptation"
    with stepped_service(tmp_path) as service:
        learnt(service, folder, settings)

        async def story() -> None:
            async with service.ready() as bridge:
                (axis,) = bridge.axes.values()
                in_use = axis.models.in_use
                made = adapting(bridge, settings, folder)
                before = changes(bridge)
                await until(bridge, lambda: bool(made.state().parameters))
                assert axis.state().adaptation.mode is AdaptationMode.ON

                await made.follow()
                assert changes(bridge) == before + 1
                await made.follow()  # it is in use already
                assert changes(bridge) == before + 1
                assert axis.models.in_use.model is in_use.model  # by its name, the committed one

                token = bridge.lease.take("test")
                await bridge.adaptation_back(token, axis.name)
                assert changes(bridge) == before + 2
                assert made.state().mode is AdaptationMode.OBSERVE
                assert not made.state().parameters
                made.close()

        play(story())


def test_an_adaptation_that_is_off_learns_and_writes_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "adaptation"
    with stepped_service(tmp_path) as service:

        async def story() -> None:
            async with service.ready() as bridge:
                made = adapting(bridge, AdaptationSettings(), folder)
                before = changes(bridge)
                await until(bridge, lambda: bridge.core.observer.cycle > 100)
                await made.follow()
                assert made.state().mode is AdaptationMode.OFF
                assert changes(bridge) == before
                assert not folder.exists()
                await made.set_mode(AdaptationMode.OBSERVE)
                await until(bridge, folder.exists)
                assert made.state().mode is AdaptationMode.OBSERVE
                made.close()

        play(story())


def test_without_a_model_it_says_what_to_do(tmp_path: Path) -> None:
    with stepped_service(tmp_path) as service:
        service.machine.axes[0].profile.model.unlink()

        async def story() -> None:
            async with service.ready() as bridge:
                made = adapting(bridge, AdaptationSettings(mode="on"), tmp_path / "adaptation")
                await until(bridge, lambda: made.state().frozen is not None)
                assert made.state().frozen == "there is no model to follow: calibrate first"
                await made.follow()

        play(story())


def test_without_a_place_to_write_it_says_so_and_the_axis_works(tmp_path: Path) -> None:
    folder = tmp_path / "adaptation"
    folder.write_text("not a folder")
    with stepped_service(tmp_path) as service:

        async def story() -> None:
            async with service.ready() as bridge:
                made = adapting(bridge, AdaptationSettings(mode="on"), folder)
                await until(bridge, lambda: made.state().frozen is not None)
                assert str(folder) in (made.state().frozen or "")

        play(story())
