"""Service of the daemon on a stepped control loop: one thread, virtual time, asyncio."""

import asyncio
import re
import shutil
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterator
from concurrent.futures import Executor, Future
from contextlib import asynccontextmanager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.daemon.machine import Axis, Machine
from hdbridge.daemon.machinefile import AdaptationSettings
from hdbridge.daemon.service.axis import ServiceAxis
from hdbridge.daemon.service.bridge import ServiceBridge
from hdbridge.daemon.service.following import Following
from hdbridge.files.profile import Profile
from support.characters import FRIENDLY, Character
from support.daemon import PROFILE, SteppedDaemon, stepped_daemon

Result = TypeVar("Result")


class AtOnce(Executor):
    """Executor that runs each call at once in the caller's thread."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


def article_profiles(folder: Path, count: int, profile: Path = PROFILE) -> list[Profile]:
    """Creates ``count`` copies of the article's profile on one bus, nodes 1, 2, ..., for tests to change."""
    made = []
    for node in range(1, count + 1):
        own = folder / f"axis{node}"
        shutil.copytree(profile, own)
        text = (own / "axis.yaml").read_text()
        text = re.sub(r"(?m)^name: .*$", f"name: axis{node}", text)
        text = re.sub(r"(?m)^  node_id: .*$", f"  node_id: {node}", text)
        eds = AxisConfig.load(PROFILE).eds_path
        text = re.sub(r"(?m)^  eds: .*$", f"  eds: {eds}", text)
        (own / "axis.yaml").write_text(text)
        model = TransmissionModel.load(own / "model.yaml")
        model.bound_to(AxisConfig.load(own)).save(own / "model.yaml")
        made.append(Profile.find(str(own)))
    return made


class Service:
    """Stepped daemon, with bridges to it."""

    def __init__(self, daemon: SteppedDaemon, machine: Machine, folder: Path) -> None:
        self.daemon = daemon
        self.machine = machine
        self.folder = folder
        self.timing = daemon.timing

    def bridge(self, **options: Any) -> ServiceBridge:
        """Returns a new service bridge to the daemon's loop."""
        return ServiceBridge(self.machine, self.daemon.memory, self.timing, **options)

    @asynccontextmanager
    async def ready(self, **options: Any) -> AsyncIterator[ServiceBridge]:
        """Provides a bridge whose axes are verified."""
        async with self.bridge(**options) as bridge:
            await until(
                bridge, lambda: all(each.state().state == "disabled" for each in bridge.axes.values())
            )
            yield bridge

    @asynccontextmanager
    async def leased(self, **options: Any) -> AsyncIterator[tuple[ServiceBridge, ServiceAxis, str]]:
        """Provides a bridge whose axes are verified, its first axis, and the token of the lease."""
        async with self.ready(**options) as bridge:
            yield bridge, bridge.axes["axis1"], bridge.lease.take("test")

    @asynccontextmanager
    async def enabled(self, **options: Any) -> AsyncIterator[tuple[ServiceBridge, ServiceAxis, str]]:
        """Provides the same as `leased`, with every axis enabled."""
        async with self.leased(**options) as (bridge, first, token):
            for axis in bridge.axes.values():
                await axis.enable(token)
            yield bridge, first, token

    def follow(self, bridge: ServiceBridge, settings: AdaptationSettings) -> Following:
        """Adds watch and adaptation of the first axis, as in the service process, but in the same thread."""
        axis = bridge.axes["axis1"]
        axis.following = Following(axis, settings, self.folder / "adaptation", AtOnce())
        bridge.core.add_sink(axis.following)
        return axis.following


async def until(bridge: ServiceBridge, done: Callable[[], bool], timeout_s: float = 20.0) -> None:
    """Runs cycles of the loop until ``done()`` is true; AssertionError after the time-out."""
    timing = bridge.core.timing
    end_s = timing.clock.now() + timeout_s
    while not done():
        bridge.core.poll()
        states = {name: each.state().state for name, each in bridge.axes.items()}
        texts = [each.text for each in bridge.events().events[-5:]]
        assert timing.clock.now() < end_s, f"not within {timeout_s} s: {states}, {texts}"
        await timing.sleep(0.02)


@contextmanager
def stepped_service(
    folder: Path,
    axes: int = 1,
    lease_s: float = 10.0,
    character: Character = FRIENDLY,
    profile: Path = PROFILE,
    **options: Any,
) -> Iterator[Service]:
    """Provides a service on a control loop with simulated drives, none verified yet."""
    files = article_profiles(folder, axes, profile)
    configs = [character.of_axis(AxisConfig.load(each.axis)) for each in files]
    with stepped_daemon(configs, character=character, **options) as daemon:
        machine = replace(
            Machine.of_profile(str(files[0].folder)),
            axes=tuple(Axis(config, profile) for config, profile in zip(configs, files, strict=True)),
            lease_s=lease_s,
        )
        yield Service(daemon, machine, folder)


def play(coroutine: Coroutine[Any, Any, Result] | Awaitable[Result]) -> Result:
    """Runs a test's coroutine to its end."""

    async def main() -> Result:
        return await coroutine

    return asyncio.run(main())
