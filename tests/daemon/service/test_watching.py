"""The watch behind the service: it takes what the loop tells, and follows the model in use."""

from __future__ import annotations

import logging
import threading
from pathlib import Path

import pytest
from support.service import play, stepped_service, until

from hdbridge.daemon.service.watching import Watching
from hdbridge.evaluation.stepping import Scheme


def test_it_takes_samples_and_another_scheme_and_ends_its_thread(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with stepped_service(tmp_path, axes=2) as service, caplog.at_level(logging.ERROR):

        async def story() -> None:
            async with service.enabled() as (bridge, token):
                watching = Watching(service.machine, bridge, None)
                bridge.core.observer.add(watching)
                first, second = bridge.axes.values()
                await first.move(token, 5.0)
                await second.compensate(token, Scheme.SYNCHRONOUS)
                begun = bridge.core.observer.cycle
                await until(bridge, lambda: bridge.core.observer.cycle > begun + 500)
                assert (first.state().advice, second.state().advice) == ([], [])
                watching.close()

        play(story())
    assert caplog.records == []
    assert "watch" not in {each.name for each in threading.enumerate()}
