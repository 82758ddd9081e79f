"""Watch and adaptation behind the service."""

import logging
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from support.axis_samples import SampleMaker, moves_and_rests
from support.service import Service, until

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import Hysteresis
from hdbridge.axis.model import TransmissionModel
from hdbridge.client import messages
from hdbridge.client.messages import AdaptationMode
from hdbridge.daemon.machinefile import AdaptationSettings
from hdbridge.daemon.serve import follow
from hdbridge.daemon.service.bridge import ServiceBridge
from hdbridge.daemon.service.following import Following
from hdbridge.daemon.setting import CompensationSetting
from hdbridge.enums import Scheme

DEMO = Path("profiles/demo/axis.yaml")


def changes(bridge: ServiceBridge) -> int:
    return sum(each.kind is messages.EventKind.CHANGED for each in bridge.core.log.since(0))


async def test_a_disabled_adaptation_learns_and_writes_nothing(service: Service, tmp_path: Path) -> None:
    folder = tmp_path / "adaptation"
    async with service.ready() as bridge:
        made = service.follow(bridge, AdaptationSettings())
        before = changes(bridge)
        await until(bridge, lambda: bridge.core.cycle > 100)
        assert made.state.mode is AdaptationMode.OFF
        assert changes(bridge) == before
        assert not folder.exists()
        await made.set_mode(AdaptationMode.OBSERVE)
        await until(bridge, folder.exists)
        assert made.state.mode is AdaptationMode.OBSERVE
        made.close()


async def test_without_a_model_a_calibration_is_requested(service: Service) -> None:
    service.machine.axes[0].profile.model.unlink()
    async with service.ready() as bridge:
        made = service.follow(bridge, AdaptationSettings(mode="on"))
        await until(bridge, lambda: made.state.frozen is not None)
        assert made.state.frozen == "there is no model to follow: calibrate first"


async def test_an_unwritable_folder_is_reported_and_the_axis_works(service: Service, tmp_path: Path) -> None:
    folder = tmp_path / "adaptation"
    folder.write_text("not a folder")
    async with service.ready() as bridge:
        made = service.follow(bridge, AdaptationSettings(mode="on"))
        await until(bridge, lambda: made.state.frozen is not None)
        assert str(folder) in (made.state.frozen or "")


@pytest.mark.parametrize("service", [{"axes": 2}], indirect=True)
async def test_each_axis_is_watched_in_its_own_thread_that_ends(service, caplog):
    with caplog.at_level(logging.ERROR):
        async with service.enabled() as (bridge, _, token), AsyncExitStack() as stack:
            follow(bridge, stack)
            first, second = bridge.axes.values()
            await first.motion.move(token, 5.0)
            await second.compensate(token, Scheme.SYNCHRONOUS)
            begun = bridge.core.cycle
            await until(bridge, lambda: bridge.core.cycle > begun + 500)
            assert (first.state().advice, second.state().advice) == ([], [])
    assert caplog.records == []
    assert not [each for each in threading.enumerate() if each.name.startswith("following")]


def test_a_verdict_gives_advice_note_and_diagnosis_until_a_new_model(tmp_path: Path) -> None:
    config = AxisConfig.from_text(DEMO.read_text().replace("cycle_ms: 4", "cycle_ms: 20"), DEMO)
    model = TransmissionModel.load("profiles/article/model.yaml")
    loop = next(each for each in model.effects if isinstance(each, Hysteresis))
    worn = loop.model_copy(update={"offset_arcsec": 1.4 * loop.offset_arcsec})
    truth = replace(model, effects=tuple(worn if each is loop else each for each in model.effects))
    samples = SampleMaker(config, model, truth).make(moves_and_rests(900.0, config.drive.cycle_s))
    axis, diagnosis = MagicMock(), MagicMock()
    axis.name, axis.axis.config, axis.models.chosen.model = "demo", config, model
    axis.link.index = 0
    axis.models.in_use = CompensationSetting(model, Scheme.EXTENDED)
    with ThreadPoolExecutor(1) as worker:
        made = Following(axis, AdaptationSettings(), tmp_path, worker, diagnosis)
        for batch in np.array_split(samples, 100):
            made.take(batch, [], 0)
        made.close()
        (advice,) = made.advice
        assert advice.startswith("recalibrate: hysteresis.offset_arcsec ")
        axis.core.log.note.assert_called_once_with(advice, 0, "WATCH")
        assert diagnosis.start.call_args.args[:4] == ("demo", model.dump(), 15.0, advice)

        axis.models.chosen.model = truth
        made.take(samples[:0], [], 0)
        made.close()
        assert made.advice == []
