"""Faults on the outer master's bus and of the processes between it and the axis, with the time to stop.

Each happens while the axis follows the master at half its maximum speed. The true load is observed.
"""

import errno
import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path

from support.gateway import COUNTS_PER_DEG, NODE, GatewayBench, gateway_bench
from support.service import play

SPEED_DEG_S = 10.0
STANDING_DEG = 0.005
"""Maximum movement of a load that counts as standing, degrees. It allows for ringing; at 10 deg/s, the load
would move by 0.04 deg in each cycle."""
OBSERVED_S = 0.7
STANDS_S = 0.3


@dataclass(frozen=True)
class OuterFault:
    """One fault; without ``within_s`` the axis must continue to follow the master."""

    name: str
    happens: Callable[[GatewayBench], Awaitable[None] | None]
    codes: tuple[int, ...] = ()
    """EMCY codes, one of which the master must receive; empty if it must receive none."""
    within_s: float | None = None
    """Maximum time until the load is at rest, s."""
    prepares: Callable[[GatewayBench], Awaitable[None]] | None = None
    """Additional configuration by the master before it enables the axis."""
    ends: Callable[[GatewayBench], None] = lambda bench: None
    """Removes the fault; nothing may move then, although the master continues to send targets."""


@dataclass(frozen=True)
class Seen:
    """Reaction of the axis; times are since the fault, s."""

    codes: tuple[int, ...]
    stands_s: float
    """Time until the load is at rest; infinite if it continues to move."""
    unpowered_s: float
    """Time until the drive switches power off; infinite if power stays on."""


def pause(duration_s: float) -> Callable[[GatewayBench], None]:
    def happens(bench: GatewayBench) -> None:
        bench.plc._next_s += duration_s

    return happens


def jitter(bench: GatewayBench) -> None:
    bench.plc.late_s = lambda cycle: 0.3 * bench.plc.period_s * (cycle % 3)


def nmt(command: int) -> Callable[[GatewayBench], None]:
    return lambda bench: bench.plc.send(0, bytes((command, NODE)))


def writes(*objects: tuple[int, int, int, int]) -> Callable[[GatewayBench], Awaitable[None]]:
    """Returns a configuration that writes objects: index, sub-index, value and size."""

    async def prepares(bench: GatewayBench) -> None:
        for each in objects:
            await bench.write(*each)

    return prepares


def rpdos_of(length: int) -> Callable[[GatewayBench], None]:
    """Returns a fault that changes the length of the master's RPDOs."""

    def happens(bench: GatewayBench) -> None:
        send, own = bench.plc.send, 0x200 + NODE

        def wrong(can_id: int, data: bytes = b"") -> None:
            send(can_id, data.ljust(length, b"\0")[:length] if can_id == own else data)

        bench.plc.send = wrong  # type: ignore[method-assign]

    return happens


class Babbler:
    """Node that sends frames without a pause, as fast as 1 Mbit/s permits, for 0.3 s."""

    FRAME_S = 125e-6
    """Duration of a frame with 8 bytes."""

    def __init__(self, bench: GatewayBench, can_id: int, data: bytes) -> None:
        self._send = lambda: bench.plc.send(can_id, data)
        self._next_s, self._end_s = bench.now_s, bench.now_s + 0.3
        bench.daemon.clock.nodes.insert(0, self)

    def next_event_s(self) -> float:
        return self._next_s if self._next_s < self._end_s else math.inf

    def poll(self, now_s: float) -> None:
        if now_s >= self.next_event_s():
            self._next_s += self.FRAME_S
            self._send()


def babble(can_id: int, data: bytes = b"") -> Callable[[GatewayBench], None]:
    def happens(bench: GatewayBench) -> None:
        Babbler(bench, can_id, data)

    return happens


def interfaces(down: int | None, *, both: bool = False) -> Callable[[GatewayBench], None]:
    """Takes the outer interface, or both, down with this error number; up without one."""

    def happens(bench: GatewayBench) -> None:
        for bus in (bench.bus, bench.daemon.bus) if both else (bench.bus,):
            bus.down = down

    return happens


def start_gateway(bench: GatewayBench) -> None:
    bench.start_gateway()
    nmt(1)(bench)


async def kill_control(bench: GatewayBench) -> None:
    await stall(bench, 0.5)
    bench.daemon.begin_again()


async def kill_daemon(bench: GatewayBench) -> None:
    bench.kill_gateway()
    await stall(bench, 0.5)
    bench.daemon.begin_again()


def kill_keeper(bench: GatewayBench) -> None:
    """Ends the keeper's processes by SIGTERM."""
    bench.kill_gateway()
    bench.daemon.controller.end()


def start_daemon(bench: GatewayBench) -> None:
    bench.daemon.begin_again()
    start_gateway(bench)


async def stall(bench: GatewayBench, duration_s: float) -> None:
    """Stalls the control process while the drives and the gateway run, and observes the load."""
    for _ in range(round(duration_s / bench.daemon.period_s)):
        bench.daemon.hang(bench.daemon.period_s)
        bench.observe()  # type: ignore[attr-defined]


BRAKING_S = 0.13
"""Braking from 10 deg/s at 200 deg/s2 and 4000 deg/s3 takes 0.1 s; the rest is for messages and ringing."""
ROWS = (
    OuterFault("one SYNC lost", pause(0.004)),
    OuterFault("two SYNCs lost", pause(0.008)),
    OuterFault("SYNC late by up to 0.6 periods", jitter),
    OuterFault(
        "SYNC and targets end",
        lambda bench: setattr(bench.plc, "cycling", False),
        (0x8700,),
        0.016 + BRAKING_S,
        ends=lambda bench: bench.plc.begin(),
    ),
    OuterFault(
        "only the targets end (1400h:05 = 20 ms)",
        lambda bench: setattr(bench.plc, "sends_targets", False),
        (0x8250,),
        0.02 + BRAKING_S,
        writes((0x1400, 5, 20, 2)),
    ),
    OuterFault(
        "heartbeat of the master lost (1016h: 100 ms)",
        lambda bench: bench.plc.send(0x77F, b"\x05"),
        (0x8130,),
        0.1 + BRAKING_S,
        writes((0x1016, 1, 127 << 16 | 100, 4)),
        nmt(1),
    ),
    OuterFault(
        "node guarding lost (life time 100 ms)",
        lambda bench: bench.plc.send(0x700 + NODE, is_remote_frame=True),
        (0x8130,),
        0.1 + BRAKING_S,
        writes((0x100C, 0, 50, 2), (0x100D, 0, 2, 1)),
        nmt(1),
    ),
    OuterFault("RPDOs one byte too short: the last target remains", rpdos_of(5), (0x8210,), 2 * BRAKING_S),
    OuterFault("RPDOs one byte too long", rpdos_of(7), (0x8220,)),
    OuterFault("NMT stop", nmt(2), (0x8100,), BRAKING_S, ends=nmt(1)),
    OuterFault("NMT pre-operational", nmt(128), (0x8100,), BRAKING_S, ends=nmt(1)),
    OuterFault("NMT reset node", nmt(129), (), BRAKING_S, ends=nmt(1)),
    OuterFault("NMT reset communication", nmt(130), (0x8100,), BRAKING_S, ends=nmt(1)),
    OuterFault("a node floods the bus: 0.3 s of frames without a pause", babble(0x001, bytes(8))),
    OuterFault("a node floods the bus with SYNC for 0.3 s", babble(0x080)),
    OuterFault(
        "outer interface down or bus off", interfaces(errno.ENETDOWN), (), BRAKING_S, ends=interfaces(None)
    ),
    OuterFault(
        "both interfaces down",
        interfaces(errno.ENETDOWN, both=True),
        (),
        0.06,
        ends=interfaces(None, both=True),
    ),
    OuterFault("gateway process killed", GatewayBench.kill_gateway, (), BRAKING_S, ends=start_gateway),
    OuterFault("control process killed", kill_control, (0x6010, 0x7500), 0.06),
    OuterFault("keeper killed", kill_keeper, (), BRAKING_S, ends=start_daemon),
    OuterFault("all processes killed", kill_daemon, (), 0.06, ends=start_gateway),
)


def measure(folder: Path, row: OuterFault) -> Seen:
    """Makes one fault; AssertionError if anything moves after its end without a new request."""

    async def scenario(bench: GatewayBench) -> Seen:
        async with bench.service.ready() as bench.bridge:  # type: ignore[attr-defined]
            await bench.configure()
            if row.prepares is not None:
                await row.prepares(bench)
            await bench.wait(0.5)
            await bench.enable()
            await bench.wait(0.5)  # until the correction is ramped in
            ramp(bench)
            await bench.wait(0.6)
            return await observe(bench, row)

    with gateway_bench(folder) as bench:
        return play(scenario(bench))


def ramp(bench: GatewayBench) -> None:
    """Has the master move the axis at a constant speed."""
    plc, begun, start = bench.plc, bench.plc.cycle, bench.plc.target
    step = SPEED_DEG_S * COUNTS_PER_DEG * plc.period_s
    plc.plan = lambda cycle: start + round(step * (cycle - begun))


async def observe(bench: GatewayBench, row: OuterFault) -> Seen:
    drive, plc = bench.daemon.nodes[0], bench.plc
    moved_s, powered_s, place_deg, seen_s = bench.now_s, math.inf, bench.load_deg, bench.now_s
    begun_s = bench.now_s

    def look() -> None:
        nonlocal moved_s, powered_s, place_deg, seen_s
        here_deg = bench.load_deg
        if abs(here_deg - place_deg) > STANDING_DEG:
            moved_s, place_deg = bench.now_s, here_deg
        if drive.firmware.state.name == "OPERATION_ENABLED":
            powered_s = bench.now_s
        seen_s = bench.now_s

    bench.observe = look  # type: ignore[attr-defined]
    powered_s = begun_s
    if (happening := row.happens(bench)) is not None:
        await happening
    while bench.now_s < begun_s + OBSERVED_S:
        await bench.wait(bench.daemon.period_s)
        look()
    plc.listen()
    codes = tuple(dict.fromkeys(plc.emergencies))
    standing_s = seen_s - STANDS_S
    stands_s = moved_s - begun_s if moved_s < standing_s else math.inf
    unpowered_s = powered_s - begun_s if powered_s < standing_s else math.inf
    row.ends(bench)
    if math.isfinite(unpowered_s):
        for _ in range(10):
            await bench.wait(0.05)
            assert abs(bench.load_deg - place_deg) <= STANDING_DEG, "it moves again without a request"
            assert drive.firmware.state.name != "OPERATION_ENABLED"
    return Seen(codes, stands_s, unpowered_s)
