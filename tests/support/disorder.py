"""Random events on both buses of a gateway, and the invariants that must always hold.

The checks examine the control loop's samples and the frames of the outer master, not the gateway.
"""

import errno
import struct
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from hdbridge.daemon.loop.states import AxisState
from hdbridge.errors import HdbridgeError
from hdbridge.motion import MotionMode
from support.gateway import COUNTS_PER_DEG, NODE, GatewayBench, gateway_bench
from support.service import play

WORDS = (0x00, 0x02, 0x06, 0x07, 0x0F, 0x0F, 0x1F, 0x80, 0x8F, 0x10F)
HARMLESS = {"word", "walk", "target", "mode", "wait", "frame"}


def draw(rng: Random) -> tuple[str, Any]:
    """Draws a random event: kind and value."""
    kinds: tuple[tuple[str, Any], ...] = (
        ("word", rng.choice(WORDS)),
        *(("walk", 0),) * 4,
        *(("target", rng.uniform(-5.0, 5.0)),) * 4,
        ("target", rng.choice([-1e5, 401.0, -401.0, 2000.0])),
        ("mode", rng.choice([0, 1, 6, 7, 8, 8, 3])),
        ("nmt", rng.choice([1, 1, 2, 128, 129, 130])),
        ("pause", rng.randint(1, 200)),
        ("gateway", rng.randint(0, 100)),
        ("loop", rng.randint(0, 100)),
        ("drive", rng.choice(["error", "boot-up", "mute"])),
        ("down", rng.randint(1, 300)),
        ("force", rng.randint(0, 300)),
        ("frame", bytes(rng.randint(0, 255) for _ in range(rng.randint(0, 8)))),
        ("wait", rng.randint(1, 500)),
    )
    return rng.choice(kinds)


class Laws:
    """Checks of one axis's samples against the requests of the outer master."""

    def __init__(self, bench: GatewayBench) -> None:
        self.bench = bench
        config = bench.daemon.axes[0].config
        self.limits, self.period_s = config.limits, bench.daemon.period_s
        self.reader = bench.daemon.memory.reader()
        self.disturbed_s = self.asked_s = -1.0
        """Times of the last event that may stop the axis, and of the master's last change of controlword."""
        self.word = 0
        self.following = False
        self.mapped = self.operational = True
        """True while the master's PDO mapping is in force, so that RPDOs take effect at SYNC, not at once."""
        self.unasked = ""
        """Reason why a motion that follows the master would be unrequested; empty if it is requested."""
        self.lowest = self.highest = self.began_deg = 0.0
        self.periods = self.moved = self.enabled = 0
        """Number of cycles checked, of cycles with a moving set-point, and of enablings by the master."""
        self.before: tuple[int, float] | None = None

    def sent(self, word: int) -> None:
        """Records a changed controlword on the bus as a request."""
        if word != self.word:
            self.word, self.asked_s = word, self.bench.now_s

    def look(self) -> None:
        plc = self.bench.plc
        self.sent(plc.controlword)
        samples, _ = self.reader.read()
        target_deg = plc.target / COUNTS_PER_DEG
        self.lowest, self.highest = min(self.lowest, target_deg), max(self.highest, target_deg)
        for sample in samples:
            self._judge(sample["axes"][0], int(sample["cycle"]))

    def _judge(self, axis: np.void, cycle: int) -> None:
        self.periods += 1
        driven = axis["state"] in (AxisState.ENABLED, AxisState.STOPPING)
        place = float(axis["load_target_deg"])
        if not driven:
            self.before = None
            self.following = False
            return
        limits = self.limits
        assert limits.position_min_deg <= place <= limits.position_max_deg
        if self.before is not None and self.before[0] == cycle - 1:
            assert abs(place - self.before[1]) <= 1.0001 * limits.velocity_deg_s * self.period_s
            self.moved += place != self.before[1]
        self.before = cycle, place
        following = axis["mode"] == MotionMode.FOLLOW
        if following and not self.following:
            self.enabled += 1
            self.unasked = ""
            if self.word & 0x8F != 0x0F:
                self.unasked = "followed without 'enable operation'"
            elif self.asked_s <= self.disturbed_s:
                self.unasked = "followed without a new controlword"
            self.lowest = self.highest = self.began_deg = place
        self.following = following
        # A disturbance while the command to follow is in transit must not cause motion.
        assert not (following and self.unasked and place != self.began_deg), self.unasked
        # A stop from full speed overshoots by its braking distance.
        slack = limits.velocity_deg_s**2 / (2.0 * limits.acceleration_deg_s2) + limits.velocity_deg_s * 0.15
        assert self.lowest - slack <= place <= self.highest + slack


async def happen(bench: GatewayBench, laws: Laws, kind: str, value) -> None:
    plc, daemon, drive = bench.plc, bench.daemon, bench.daemon.nodes[0]
    (node,) = bench.gateway.nodes.values()
    needs_sync = node.dictionary.value(0x6061) in (7, 8)
    leaves_cycle = kind == "pause" or (kind, value) == ("nmt", 128)
    harmless = kind in HARMLESS or (kind, value) == ("nmt", 1) or (leaves_cycle and not needs_sync)
    if not harmless and kind != "gateway":
        laws.disturbed_s = bench.now_s
    if kind == "word":
        plc.controlword = value
    elif kind == "walk":
        plc.controlword = 0
        plc.send(0, bytes((128, NODE)))
        laws.disturbed_s = bench.now_s
        await bench.configure()  # an earlier reset may have removed the configuration
        laws.look()
        laws.mapped = laws.operational = True
        for word, wait_s in ((0x00, 0.1), (0x80, 1.5), (0x06, 0.05), (0x07, 0.05), (0x0F, 0.2)):
            plc.controlword = word
            plc.target = plc.position
            await rest(bench, laws, wait_s)  # a reset verifies and prepares the drive
    elif kind == "target":
        plc.target = max(min(plc.position + round(value * COUNTS_PER_DEG), 2**31 - 1), -(2**31))
        await rest(bench, laws, 0.1)
    elif kind == "mode":
        plc.send(0x600 + NODE, struct.pack("<BHBb3x", 0x2F, 0x6060, 0, value))
    elif kind == "nmt":
        plc.send(0, bytes((value, NODE)))
        laws.operational = value == 1
        laws.mapped &= value not in (129, 130)
    elif kind == "pause":
        plc.cycling = False
        await rest(bench, laws, 1e-3 * value)
        plc.begin()
    elif kind == "gateway":
        bench.kill_gateway()
        await rest(bench, laws, 1e-3 * value)
        bench.start_gateway()
        laws.mapped, laws.operational = False, True
        laws.disturbed_s = bench.now_s  # the loop cannot detect it earlier
        plc.send(0, bytes((1, NODE)))
    elif kind == "loop":
        daemon.hang(1e-3 * value)
        daemon.begin_again()
    elif kind == "drive":
        if value == "error":
            drive.faults.raise_error(0x4310)
        elif value == "boot-up":
            drive.faults.boot_up()
        else:
            drive.faults.drop_tpdos = 9
    elif kind == "down":
        daemon.bus.down = errno.ENETDOWN
        await rest(bench, laws, 1e-3 * value)
        daemon.bus.down = None
    elif kind == "force":
        token = bench.bridge.lease.take("a person", force=True)
        await rest(bench, laws, 1e-3 * value)
        laws.disturbed_s = bench.now_s
        with suppress(HdbridgeError):
            bench.bridge.lease.release(token)
    elif kind == "frame":
        if laws.operational and not laws.mapped and len(value) >= 2:
            laws.sent(int.from_bytes(value[:2], "little"))
        plc.send(0x200 + NODE, value)
    elif kind == "wait":
        await rest(bench, laws, 1e-3 * value)
    await rest(bench, laws, 0.02)


async def rest(bench: GatewayBench, laws: Laws, duration_s: float) -> None:
    end_s = bench.now_s + duration_s
    while bench.now_s < end_s:
        await bench.wait(0.012)
        laws.look()


def play_story(folder: Path, story: Sequence[tuple[str, Any]]) -> Laws:
    """Plays events on a gateway with an enabled axis; AssertionError if an invariant is violated."""

    async def scenario(bench: GatewayBench) -> Laws:
        async with bench.service.ready() as bridge:
            bench.bridge = bridge
            await bench.configure()
            await bench.wait(0.5)
            laws = Laws(bench)
            bench.plc.begin()
            await happen(bench, laws, "walk", 0)
            assert laws.enabled == 1
            for kind, value in story:
                await happen(bench, laws, kind, value)
            return laws

    with gateway_bench(folder) as bench:
        return play(scenario(bench))
