"""Gateway in simulated time: daemon, service, and outer bus with a PLC-like master, in one thread."""

import math
import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import can
from can.interfaces.virtual import VirtualBus

from hdbridge.axis import BusConfig
from hdbridge.daemon.gateway.slave import Gateway
from hdbridge.daemon.machinefile import GatewaySettings
from hdbridge.device.run import LONGEST_WAIT_S, Server
from support.service import Service, stepped_service
from support.spoilt import SpoiltVirtualBus

NODE = 5
COUNTS_PER_DEG = 12_960_000 / 360.0


class Plc:
    """PLC-like master, written from CiA 301 and CiA 402 alone; it has its own clock.

    ``plan`` returns the target of each cycle, or None to keep the last one. Controlword and target are sent
    in one synchronous RPDO before SYNC.
    """

    def __init__(
        self,
        channel: str,
        clock: Any,
        period_s: float = 0.004,
        drift_ppm: float = 0.0,
        node: int = NODE,
        *,
        syncs: bool = True,
    ) -> None:
        """``syncs`` is True if this master produces SYNC."""
        self.bus = VirtualBus(channel)
        self.node, self._syncs = node, syncs
        self._clock = clock
        self.period_s = period_s * (1.0 + 1e-6 * drift_ppm)
        self.controlword = 0
        self.target = 0
        self.plan: Callable[[int], int | None] = lambda cycle: None
        self.cycle = 0
        self.cycling = False
        self.sends_targets = True
        self.late_s: Callable[[int], float] = lambda cycle: 0.0
        self._next_s = 0.0
        self.statusword = self.position = 0
        self.emergencies: list[int] = []
        self.heartbeats: list[int] = []
        self.seen: list[tuple[float, int, int, int]] = []
        """Time of SYNC, statusword, position, and target sent before that SYNC, for each cycle."""
        self.answers: list[bytes] = []

    # ---------------------------------------------------------------- a node of the virtual clock

    def next_event_s(self) -> float:
        return self._next_s + self.late_s(self.cycle) if self.cycling else float("inf")

    def poll(self, now_s: float) -> None:
        self.listen()
        if self.cycling and now_s >= self.next_event_s():
            self._next_s += self.period_s
            self._turn(now_s)

    def listen(self) -> None:
        while (message := self.bus.recv(0)) is not None:
            data = bytes(message.data)
            if message.arbitration_id == 0x180 + self.node and len(data) >= 6:
                self.statusword, self.position = struct.unpack("<Hi", data[:6])
            elif message.arbitration_id == 0x080 + self.node:
                self.emergencies.append(struct.unpack_from("<H", data)[0])
            elif message.arbitration_id == 0x580 + self.node:
                self.answers.append(data)
            elif message.arbitration_id == 0x700 + self.node:
                self.heartbeats.append(data[0])

    def _turn(self, now_s: float) -> None:
        planned = self.plan(self.cycle)
        if planned is not None:
            self.target = planned
        if self.sends_targets:
            self.send(0x200 + self.node, struct.pack("<Hi", self.controlword, self.target))
        if self._syncs:
            self.send(0x080)
        self.seen.append((now_s, self.statusword, self.position, self.target))
        self.cycle += 1

    # ---------------------------------------------------------------- single frames

    def send(self, can_id: int, data: bytes = b"", **kind: Any) -> None:
        self.bus.send(can.Message(arbitration_id=can_id, data=data, **{"is_extended_id": False, **kind}))

    def begin(self) -> None:
        self._next_s = self._clock.now() + self.period_s
        self.cycling = True


class GatewayProcess:
    """The gateway process as a node of the virtual clock."""

    def __init__(self, bus: SpoiltVirtualBus, gateway: Gateway, clock: Any) -> None:
        self.gateway, self._clock = gateway, clock
        self._server, self._again_s = Server(bus, gateway, clock), 0.0

    def next_event_s(self) -> float:
        return max(self.gateway.next_event_s(), self._again_s)

    def poll(self, now_s: float) -> None:
        if now_s >= self._again_s and not self._server.poll():
            self._again_s = now_s + LONGEST_WAIT_S


class GatewayBench:
    """Complete chain from the outer masters to the simulated drives."""

    def __init__(
        self, service: Service, bus: SpoiltVirtualBus, gateway: Callable[[], Gateway], plcs: list[Plc]
    ) -> None:
        self.service, self.daemon, self.plcs = service, service.daemon, plcs
        self.plc = plcs[0]
        """Master of the axis on which the methods act."""
        self.bus, self._made = bus, gateway
        self.daemon.clock.nodes += reversed(plcs)  # before the gateway, so that frames arrive at once
        self.start_gateway()

    def start_gateway(self) -> None:
        """Starts the gateway process, as the keeper does."""
        self.gateway = self._made()
        self._process = GatewayProcess(self.bus, self.gateway, self.daemon.clock)
        self.daemon.clock.nodes.append(self._process)

    def kill_gateway(self) -> None:
        """Stops running the gateway process, as after a kill."""
        self.daemon.clock.nodes.remove(self._process)

    async def wait(self, duration_s: float) -> None:
        await self.service.timing.sleep(duration_s)

    async def until(self, done: Callable[[], bool], timeout_s: float = 5.0) -> float:
        """Lets time pass until ``done()`` is true; returns the elapsed time, s."""
        begun_s = self.now_s
        while not done():
            assert self.now_s < begun_s + timeout_s, (
                f"not within {timeout_s} s: {self.plc.statusword:04X}h, {self.daemon.states}, "
                f"{[hex(each) for each in self.plc.emergencies]}, {list(self.daemon.events)[-4:]}"
            )
            await self.wait(0.001)
        return self.now_s - begun_s

    @property
    def now_s(self) -> float:
        return self.daemon.clock.now()

    async def sdo(self, request: bytes) -> bytes:
        plc = self.plc
        plc.listen()
        plc.answers.clear()
        plc.send(0x600 + plc.node, request)

        def answered() -> bool:
            plc.listen()
            return bool(plc.answers)

        await self.until(answered, 1.0)
        return plc.answers[0]

    async def write(self, index: int, sub: int, value: int, size: int) -> None:
        data = value.to_bytes(size, "little", signed=value < 0)
        head = bytes((0x23 | (4 - size) << 2,)) + struct.pack("<HB", index, sub)
        answer = await self.sdo(head + data.ljust(4, b"\0"))
        assert answer[0] == 0x60, answer.hex()

    async def read(self, index: int, sub: int = 0, *, signed: bool = False) -> int:
        answer = await self.sdo(struct.pack("<BHB4x", 0x40, index, sub))
        assert answer[0] & 0xE0 == 0x40, answer.hex()
        return int.from_bytes(answer[4 : 8 - (answer[0] >> 2 & 3)], "little", signed=signed)

    async def configure(self, mode: int = 8) -> None:
        """Configures the slave as a PLC does before cyclic operation: PDO mapping, mode, NMT start."""
        plc = self.plc
        for first, cob, words in (
            (0x1400, 0x200, (0x60400010, 0x607A0020)),
            (0x1800, 0x180, (0x60410010, 0x60640020)),
        ):
            await self.write(first, 1, 0x8000_0000 | cob + plc.node, 4)
            await self.write(first + 0x200, 0, 0, 1)
            for sub, word in enumerate(words, start=1):
                await self.write(first + 0x200, sub, word, 4)
            await self.write(first + 0x200, 0, len(words), 1)
            await self.write(first, 2, 1, 1)
            await self.write(first, 1, cob + plc.node, 4)
        await self.write(0x6060, 0, mode, 1)
        plc.send(0, bytes((1, plc.node)))
        plc.target = await self.read(0x6064, signed=True)

    async def enable(self) -> float:
        """Enables the axis by controlword levels; returns the time from 'enable operation' to its effect."""
        plc = self.plc
        if not plc.cycling:
            plc.begin()
        for word, bits in ((0x06, 0x21), (0x07, 0x23)):
            plc.controlword = word
            await self.until(lambda bits=bits: plc.statusword & 0x6F == bits)
        plc.target = plc.position
        plc.controlword = 0x0F
        return await self.until(lambda: plc.statusword & 0x6F == 0x27)

    @property
    def load_deg(self) -> float:
        """True load angle, degrees."""
        return float(self.daemon.nodes[0].firmware.motion.machine.load_reading) / 2_880_000 * 360.0


async def swing(bench: GatewayBench, amplitude_deg: float = 2.0, period_s: float = 2.0) -> None:
    """Makes the PLC move the axis to and fro, starting at its current position."""
    plc, begun, centre = bench.plc, bench.plc.cycle, bench.plc.target

    def plan(cycle: int) -> int:
        share = (cycle - begun) * plc.period_s / period_s
        return centre + round(COUNTS_PER_DEG * amplitude_deg * 0.5 * (1.0 - math.cos(2.0 * math.pi * share)))

    plc.plan = plan


@contextmanager
def gateway_bench(
    folder: Path, period_s: float = 0.004, drift_ppm: float = 0.0, **options: Any
) -> Iterator[GatewayBench]:
    """Provides a stepped service with a gateway, no axis verified yet, and a silent PLC-like master."""
    channel = f"outer-{uuid4()}"
    with ExitStack() as stack:
        service = stack.enter_context(stepped_service(folder, **options))
        clock = service.daemon.clock
        bus = BusConfig(interface="virtual", channel=channel)
        nodes = {axis.name: NODE + place for place, axis in enumerate(service.machine.axes)}
        settings = GatewaySettings(bus=bus, nodes=nodes)
        service.machine = replace(service.machine, gateway=settings)
        axes = [(axis.config, axis.model()) for axis in service.machine.axes]

        outer = stack.enter_context(SpoiltVirtualBus(channel))

        def gateway() -> Gateway:
            return Gateway(outer, axes, settings, service.daemon.memory, clock, folder)

        plcs = [Plc(channel, clock, period_s, drift_ppm, node, syncs=node == NODE) for node in nodes.values()]
        for plc in plcs:
            stack.callback(plc.bus.shutdown)
        yield GatewayBench(service, outer, gateway, plcs)
