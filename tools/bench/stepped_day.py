"""The daemon in one thread on virtual time, for hours of axis time: what `endurance.py stepped` runs.

Control loop, simulated drive, bridge with its sinks (log, metrics, adaptation that observes, flight log on
the disk), a live client that reads, one that never does. A random story of what may happen:

    moves, re-targeted in motion - jogs - queues - streams - compensation off and on - the model taken anew
    SDO reads - leases that run out - refused requests - power off and on - quick stops
    lost, duplicated and delayed TPDOs - stalls of the loop - EMCY - a node reset - the interface down and up

After each fault the axis is reset, verified where that is due, and enabled again.
"""

from __future__ import annotations

import asyncio
import errno
import gc
import logging
import math
import os
import random
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from accounts import Accounts

sys.path.append(str(Path(__file__).resolve().parents[2] / "tests"))
from support.service import Service, stepped_service

from hdbridge.commissioning.evaluation.stepping import Scheme
from hdbridge.daemon.api.metrics import Metrics
from hdbridge.daemon.following.settings import AdaptationSettings
from hdbridge.daemon.memory import Event, EventKind, SampleArray
from hdbridge.daemon.recorder.about import About, AxisAbout
from hdbridge.daemon.recorder.flightlog import Batch, FlightLog
from hdbridge.daemon.recorder.settings import RecorderSettings
from hdbridge.daemon.recorder.store import Store
from hdbridge.daemon.service.bridge import ServiceBridge
from hdbridge.daemon.service.eventlog import ANSWERS_KEPT, KEPT
from hdbridge.daemon.service.following import Following
from hdbridge.daemon.service.journal import Journal
from hdbridge.daemon.service.moves import WayPoint
from hdbridge.daemon.service.streams import StreamPoint
from hdbridge.errors import HdbridgeError

RECORDER: Final = RecorderSettings(size_mb=8, file_mb=2, file_s=60, kept_mb=4, before_s=10, after_s=5)
"""Recorder settings with a small ring, which is full within minutes."""
SETTLE_S: Final = 20.0
"""Time in which a stopped axis is enabled again, s."""
SPAN_DEG: Final = 20.0
FAULT_SHARE: Final = 0.12
"""Share of faults among the events of a day."""


Say = Callable[[dict[str, float]], None]


class Recorder:
    """Flight log as a sink, written in this thread by the loop's time."""

    def __init__(self, service: Service) -> None:
        axes = tuple(AxisAbout.of(axis.config) for axis in service.machine.axes)
        clock, begun_ns = service.daemon.clock, time.time_ns()
        self._flight = FlightLog(
            Store(service.folder / "flight", RECORDER),
            About.of("endurance", axes, service.machine.cycle_s),
            wall_ns=lambda: begun_ns + round(1e9 * clock.now()),
        )
        self._due_s = 0.0
        self._clock = clock

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        """Takes samples and events from the observer."""
        self._flight.put(Batch(samples if len(samples) else None, tuple(events), lost))
        if self._clock.now() >= self._due_s:
            self._due_s = self._clock.now() + 1.0
            self._flight.flush()

    def close(self) -> dict[str, int]:
        """Closes the log; returns the account of the cycles."""
        self._flight.close()
        counts = self._flight.counts
        return {"recorded": counts.recorded, "dropped": counts.dropped, "refused": counts.refused}


class Told:
    """Sink that counts events and reported skipped periods."""

    def __init__(self) -> None:
        self.kinds: Counter[str] = Counter()
        self.skipped = 0

    def take(self, samples: SampleArray, events: Sequence[Event], lost: int) -> None:
        """Takes samples and events from the observer."""
        for event in events:
            self.kinds[event.kind.name] += 1
            if event.kind is EventKind.FAULT and "periods skipped: " in event.text:
                self.skipped += int(event.text.rpartition(" ")[2])


class Story:
    """Draws the events of the axis at random."""

    def __init__(self, service: Service, bridge: ServiceBridge, seed: int) -> None:
        self.service, self.bridge = service, bridge
        self.chance = random.Random(seed)
        self.axis = next(iter(bridge.axes.values()))
        self.node = service.daemon.nodes[0]
        self.done: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.token = self.last = ""
        self.sleep = bridge.core.timing.sleep
        self.wishes: tuple[Callable[[], Awaitable[object]], ...] = (
            self.move, self.retarget, self.jog, self.queue, self.stream, self.compensate, self.activate,
            self.read, self.off_and_on, self.lease_runs_out, self.nonsense,
        )  # fmt: skip
        self.faults: tuple[Callable[[], Awaitable[object]], ...] = (
            self.quick_stop, self.lost_frames, self.odd_frames, self.stall, self.emergency, self.node_reset,
            self.bus_down,
        )  # fmt: skip

    def target(self) -> float:
        return self.chance.uniform(-SPAN_DEG, SPAN_DEG)

    async def fill(self) -> None:
        """Fills the buffers that keep the newest entries only: the log, answers to commands."""
        for _ in range(KEPT):
            self.bridge.core.log.note("the log is full")
        for _ in range(ANSWERS_KEPT):
            await self.axis.stop()

    async def step(self) -> None:
        """Makes one event and recovers from it."""
        await self.ready()
        table = self.faults if self.chance.random() < FAULT_SHARE else self.wishes
        wish = self.chance.choice(table)
        self.done[wish.__name__] += 1
        self.last = wish.__name__
        try:
            await wish()
        except HdbridgeError as error:
            self.refused[f"{wish.__name__}: {type(error).__name__}"] += 1
        self.bridge.state()
        self.bridge.events(0)
        self.service.daemon.intruder.queue.queue.clear()  # the test bench's third node, who reads nothing

    async def ready(self) -> None:
        """Enables the axis with the lease."""
        lease = self.bridge.lease
        if not self.token or not lease.holds(self.token):
            self.token = lease.take("endurance", force=True)
        lease.renew(self.token)
        end_s, why = self.service.daemon.clock.now() + SETTLE_S, ""
        while (state := self.axis.state().state) != "enabled":
            if self.service.daemon.clock.now() > end_s:
                told = [each.text for each in self.bridge.events(self.bridge.core.log.newest - 12).events]
                raise SystemExit(f"the axis stays {state} after {self.last}: {why}; {told}")
            lease.renew(self.token)
            try:
                if state in ("quick-stopped", "latched"):
                    await self.axis.reset(self.token)
                elif state == "disabled":
                    await self.axis.enable(self.token)
            except HdbridgeError as error:
                why = str(error)
            await self.sleep(0.05)

    # ---------------------------------------------------------------- what clients do

    async def move(self) -> None:
        await self.axis.move(self.token, self.target())

    async def retarget(self) -> None:
        for _ in range(3):
            await self.axis.move(self.token, self.target(), wait=False)
            await self.sleep(self.chance.uniform(0.0, 0.5))
        await self.axis.move(self.token, self.target(), velocity_deg_s=10.0)

    async def jog(self) -> None:
        for _ in range(5):
            await self.axis.jog(self.token, self.chance.uniform(-3.0, 3.0), 0.3)
            await self.sleep(0.1)
        await self.axis.stop()
        await self.sleep(0.5)

    async def queue(self) -> None:
        await self.axis.queue(self.token, [WayPoint(self.target(), dwell_s=0.1) for _ in range(3)])
        await self.sleep(2.0)
        await self.axis.clear_queue(self.token)
        await self.axis.move(self.token, self.target())

    async def stream(self) -> None:
        await self.axis.stop()
        await self.sleep(0.5)
        middle_deg = self.axis.state().load_target_deg
        assert middle_deg is not None
        ends = self.chance.random() < 0.8  # otherwise its set-points run out
        async with await self.axis.stream(self.token) as stream:
            for begin in range(0, 201, 50):
                phases = [(0.01 * knot, math.pi * 0.01 * knot) for knot in range(begin, min(begin + 50, 201))]
                await stream.put([
                    StreamPoint(at, middle_deg + math.sin(phase) ** 2, math.pi * math.sin(2.0 * phase))
                    for at, phase in phases
                ])  # fmt: skip
                if not ends and begin:
                    await self.sleep(2.0)
            await stream.end()

    async def compensate(self) -> None:
        await self.axis.move(self.token, self.target(), wait=False)
        await self.axis.compensate(self.token, self.chance.choice((Scheme.NONE, Scheme.EXTENDED)))
        await self.sleep(1.0)
        await self.axis.compensate(self.token, Scheme.EXTENDED)

    async def activate(self) -> None:
        await self.axis.move(self.token, self.target(), wait=False)
        await self.axis.activate_model(self.token, "active")

    async def read(self) -> None:
        await self.axis.sdo_read("0x6041")

    async def off_and_on(self) -> None:
        await self.axis.disable(self.token)

    async def lease_runs_out(self) -> None:
        self.bridge.lease.release(self.token)
        await self.sleep(0.1)
        await self.axis.move(self.token, 0.0)  # refused

    async def nonsense(self) -> None:
        self.bridge.mark("a remark")
        await self.axis.move(self.token, 1e6)  # refused

    # ---------------------------------------------------------------- what happens to it

    async def quick_stop(self) -> None:
        await self.axis.move(self.token, self.target(), wait=False)
        await self.sleep(0.2)
        await self.axis.quick_stop()

    async def lost_frames(self) -> None:
        await self.axis.move(self.token, self.target(), wait=False)
        self.node.faults.drop_tpdos = self.chance.randint(1, 6)
        await self.sleep(0.3)

    async def odd_frames(self) -> None:
        await self.axis.move(self.token, self.target(), wait=False)
        self.node.faults.duplicate_tpdos = 2
        await self.sleep(0.1)
        self.node.faults.hold_tpdos = 1
        await self.sleep(0.1)
        self.node.faults.shorten_tpdos = 1
        await self.sleep(0.2)

    async def stall(self) -> None:
        """Skips some periods of the loop, as on a busy machine."""
        await self.axis.move(self.token, self.target(), wait=False)
        clock, period_s = self.service.daemon.clock, self.service.daemon.period_s
        clock.sleep_until(clock.now() + self.chance.choice((1.7, 2.5, 5.0, 12.0, 40.0)) * period_s)
        await self.sleep(0.3)

    async def emergency(self) -> None:
        await self.axis.move(self.token, self.target(), wait=False)
        self.node.faults.raise_error(0x3210)
        await self.sleep(0.5)

    async def node_reset(self) -> None:
        await self.axis.move(self.token, self.target(), wait=False)
        self.node.faults.boot_up()
        await self.sleep(0.5)

    async def bus_down(self) -> None:
        await self.axis.move(self.token, self.target(), wait=False)
        self.service.daemon.bus.down = self.chance.choice((errno.ENETDOWN, errno.ENODEV))
        await self.sleep(0.5)
        self.service.daemon.bus.down = None
        await self.sleep(1.0)


def look(clock_s: float, began_s: float) -> dict[str, float]:
    """Returns the memory of this process, after a garbage collection."""
    gc.collect()
    status = Path("/proc/self/status").read_text(encoding="ascii")
    resident = next(line for line in status.splitlines() if line.startswith("RssAnon"))
    return {
        "axis_h": clock_s / 3600.0,
        "wall_s": time.monotonic() - began_s,
        "rss_kb": int(resident.split()[1]),
        "blocks": sys.getallocatedblocks(),
        "objects": len(gc.get_objects()),
        "descriptors": len(os.listdir("/proc/self/fd")),  # noqa: PTH208 - only their number
    }


async def _read(subscription: Any) -> None:
    async for _ in subscription:
        pass


async def day(
    service: Service, hours: float, every_s: float, seed: int, say: Say, at_most_s: float
) -> dict[str, Any]:
    """Runs hours of axis time and returns the figures. ``say`` gets interim figures.

    It ends early after ``at_most_s`` of real time.
    """
    daemon = service.daemon
    accounts, told = Accounts(), Told()
    reader = daemon.memory.reader()
    rows: list[dict[str, float]] = []
    began_s = time.monotonic()
    with ExitStack() as stack:
        worker = stack.enter_context(ThreadPoolExecutor(1))
        async with service.ready() as bridge:
            observe = AdaptationSettings(mode="observe")
            following = [
                Following(index, axis, observe, service.folder / f"adapt{index}", worker)
                for index, axis in enumerate(bridge.axes.values())
            ]
            recorder = Recorder(service)
            for sink in (told, Journal([*bridge.axes]), Metrics(), recorder, *following):
                bridge.core.observer.add(sink)
            bridge.subscribe()  # a client that never reads
            reading = asyncio.create_task(_read(bridge.subscribe()))
            story = Story(service, bridge, seed)
            await story.fill()
            first_turn = daemon.controller.cycle.count
            begin_s = due_s = daemon.clock.now()
            end_s = begin_s + 3600.0 * hours
            while daemon.clock.now() < end_s and time.monotonic() < began_s + at_most_s:
                await story.step()
                accounts.take(*reader.read())
                for each in following:
                    await each.apply()
                if daemon.clock.now() >= due_s:
                    due_s += every_s
                    rows.append(look(daemon.clock.now() - begin_s, began_s))
                    say(rows[-1])
            reading.cancel()
            bridge.core.observer.poll()
            accounts.take(*reader.read())
            for each in following:
                each.close()
            recorded = recorder.close()
    cycle = daemon.controller.cycle
    return {
        "axis_h": (daemon.clock.now() - begin_s) / 3600.0,
        "wall_s": time.monotonic() - began_s,
        "turns": cycle.count - first_turn - accounts.skipped,
        "overruns": cycle.overruns,
        "skipped": cycle.skipped,
        "skipped told in events": told.skipped,
        "accounts": accounts.report(),
        "recorder": recorded,
        "recorded bytes": sum(each.stat().st_size for each in service.folder.rglob("*.mcap")),
        "happened": dict(story.done),
        "refused": dict(story.refused),
        "events": dict(told.kinds),
        "rows": rows,
    }


def run(hours: float, every_s: float, seed: int, say: Say, at_most_s: float = math.inf) -> dict[str, Any]:
    """Runs the day in a temporary folder."""
    warnings.simplefilter("ignore")
    log = logging.getLogger("hdbridge")
    log.addHandler(logging.NullHandler())
    log.propagate = False
    with (
        tempfile.TemporaryDirectory(prefix="endurance-") as folder,
        stepped_service(Path(folder), lease_s=60.0) as service,
    ):
        return asyncio.run(day(service, hours, every_s, seed, say, at_most_s))
