"""Leases, moves, queues, streams and stops in any order cause no unpermitted motion."""

import asyncio
import tempfile
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule
from support.service import stepped_service, until

from hdbridge.client.messages import QueueItem, StreamPoint
from hdbridge.daemon.loop.states import AxisState
from hdbridge.errors import HdbridgeError, LeaseError

LEASE_S = 2.0
TARGETS = st.sampled_from([-12.0, 0.0, 3.0, 40.0, 1e4, float("nan")])
BRAKING_S = 1.0


class Disorder(RuleBasedStateMachine):
    """One axis, clients with right and wrong tokens."""

    def __init__(self) -> None:
        super().__init__()
        self.stack = ExitStack()
        folder = self.stack.enter_context(tempfile.TemporaryDirectory())
        self.service = self.stack.enter_context(stepped_service(Path(folder), lease_s=LEASE_S))
        self.loop = asyncio.new_event_loop()
        self.bridge = self.service.bridge()
        self.tokens = ["never given"]
        self.holder: str | None = None
        self.may_have_power = False
        self.reader = self.service.daemon.memory.reader()
        self.run(self.bridge.__aenter__())
        self.axis = self.bridge.axes["axis1"]
        self.run(until(self.bridge, lambda: self.axis.link.state is AxisState.DISABLED))

    def teardown(self) -> None:
        self.run(self.bridge.__aexit__())
        self.loop.close()
        self.stack.close()

    # ---------------------------------------------------------------- requests

    def run(self, coroutine: Coroutine[Any, Any, Any]) -> Any:
        return self.loop.run_until_complete(coroutine)

    def wait(self, seconds: float) -> None:
        self.run(self.bridge.core.timing.sleep(seconds))

    def ask(self, token: str, request: Callable[[str], Awaitable[Any]]) -> bool:
        """Returns True if the request was carried out. It is refused with a reason without the lease."""
        holds = self.bridge.lease.holds(token)

        async def asked() -> Any:
            return await request(token)

        try:
            self.run(asked())
        except LeaseError:
            assert not self.bridge.lease.holds(token)
            return False
        except HdbridgeError:
            return False
        assert holds, "was done without the lease"
        return True

    token = st.integers(0, 5)

    def of(self, which: int) -> str:
        """Returns a token, mostly the newest."""
        return self.tokens[-1] if which else self.tokens[len(self.tokens) // 2]

    # ---------------------------------------------------------------- actions of clients

    @rule(client=st.sampled_from(["page", "script"]), force=st.booleans())
    def take(self, client: str, force: bool) -> None:
        try:
            self.tokens.append(self.bridge.lease.take(client, force=force))
        except LeaseError:
            assert not force

    @rule(which=token)
    def release(self, which: int) -> None:
        with suppress(LeaseError):
            self.bridge.lease.release(self.of(which))

    @rule(seconds=st.sampled_from([0.0, 0.02, 0.3, 1.0, 3.0]))
    def pass_time(self, seconds: float) -> None:
        self.wait(seconds)

    @rule(which=token)
    def enable(self, which: int) -> None:
        self.may_have_power = self.may_have_power or self.bridge.lease.holds(self.of(which))
        self.ask(self.of(which), self.axis.enable)

    @rule(which=token)
    def disable(self, which: int) -> None:
        if self.ask(self.of(which), self.axis.disable):
            self.may_have_power = False

    @rule(which=token)
    def reset(self, which: int) -> None:
        if self.ask(self.of(which), self.axis.reset) and self.axis.link.state is AxisState.DISABLED:
            self.may_have_power = False

    @rule(which=token, place=TARGETS, wait=st.booleans())
    def move(self, which: int, place: float, wait: bool) -> None:
        self.ask(self.of(which), lambda token: self.axis.motion.move(token, place, wait=wait))

    @rule(which=token, velocity=st.sampled_from([-10.0, 5.0, 0.0, float("inf")]))
    def jog(self, which: int, velocity: float) -> None:
        self.ask(self.of(which), lambda token: self.axis.motion.jog(token, velocity, 4.0))

    @rule(which=token, places=st.lists(TARGETS, min_size=1, max_size=3))
    def queue(self, which: int, places: list[float]) -> None:
        points = [QueueItem.model_construct(target_deg=each, dwell_s=0.1) for each in places]
        self.ask(self.of(which), lambda token: self.axis.motion.queue(token, points))

    @rule(which=token)
    def clear(self, which: int) -> None:
        self.ask(self.of(which), self.axis.motion.clear_queue)

    @rule(which=token, step=st.sampled_from([0.05, 0.3, 50.0]), end=st.booleans())
    def stream(self, which: int, step: float, end: bool) -> None:
        async def streamed(token: str) -> None:
            stream = await self.axis.motion.stream(token)
            here = self.axis.state().load_target_deg
            await stream.put(
                [StreamPoint(time_s=0.1 * n, position_deg=here + step * min(n, 8 - n)) for n in range(1, 9)]
            )
            if end:
                await stream.end()

        self.ask(self.of(which), streamed)

    @rule()
    def stop(self) -> None:
        self.run(self.axis.stop())
        assert self.axis.motion.queued == 0

    @rule()
    def quick_stop(self) -> None:
        self.run(self.axis.quick_stop())
        self.may_have_power = False
        self.wait(BRAKING_S)

    @rule(fault=st.sampled_from(["drop", "boot", "error"]))
    def spoil(self, fault: str) -> None:
        faults = self.service.daemon.nodes[0].faults
        if fault == "drop":
            faults.drop_tpdos = 4
        elif fault == "boot":
            faults.boot_up()
        else:
            faults.raise_error(0x3210)
        self.wait(BRAKING_S)
        if self.axis.link.state is not AxisState.ENABLED:
            self.may_have_power = False

    @rule()
    def nobody_is_left(self) -> None:
        """After the end of the lease, only a move continues, until its end."""
        self.wait(LEASE_S + 0.1)
        assert self.bridge.lease.holder is None
        self.wait(8.0)
        assert self.axis.state().at_rest
        assert self.axis.motion.queued == 0

    # ---------------------------------------------------------------- laws

    @invariant()
    def every_target_was_one_that_may_be_sent(self) -> None:
        samples, lost = self.reader.read()
        assert lost == 0
        if not len(samples):
            return
        axis = samples["axes"][:, 0]
        limits = self.axis.axis.config.limits
        driven = axis["state"] == AxisState.ENABLED
        targets = axis["load_target_deg"][driven]
        assert np.isfinite(targets).all()
        if not len(targets):
            return
        assert limits.position_min_deg <= targets.min()
        assert targets.max() <= limits.position_max_deg
        on = driven[1:] & driven[:-1]
        steps = np.abs(np.diff(axis["load_target_deg"]))[on]
        if len(steps):
            assert steps.max() <= limits.velocity_deg_s * self.service.daemon.period_s * (1.0 + 1e-5)

    @invariant()
    def nobody_gets_power_who_did_not_ask(self) -> None:
        if not self.may_have_power:
            assert self.axis.link.state not in {AxisState.ENABLED, AxisState.ENABLING}


class Longer(Disorder):
    """The same test with more steps and examples."""


TestDisorder = Disorder.TestCase
TestDisorder.settings = settings(
    max_examples=3, stateful_step_count=15, deadline=None, suppress_health_check=list(HealthCheck)
)
TestLonger = pytest.mark.slow(pytest.mark.timeout(3600)(Longer.TestCase))
TestLonger.settings = settings(
    max_examples=100, stateful_step_count=50, deadline=None, suppress_health_check=list(HealthCheck)
)
