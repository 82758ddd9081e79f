"""Runs the conformance suite on the nodes of docs/gateway.md, in simulated time.

    python tools/bench/conformance.py

`gateway` is the complete chain: outer bus, gateway, daemon, inner bus and a simulated axis with its model.
Prints a row for each node: checks, passed, failed, not applicable.
"""

from __future__ import annotations

import logging
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from threading import Semaphore
from typing import Any

import can
from can.interfaces.virtual import VirtualBus
from harness import parser
from support.conformance import EDS, gateway_slave, simulated_drive
from support.foreign_slaves import durand_drive, local_node
from support.gateway import NODE, GatewayBench, gateway_bench
from support.service import play

from hdbridge.conformance import Check, NodeTester, Result, Verdict, checks, run
from hdbridge.drive.link import Link
from hdbridge.files.edsfile import read_eds


class SteppedBus(VirtualBus):
    """Outer bus of a tester whose thread runs only while the clock of the bench polls this bus."""

    def __init__(self, bench: GatewayBench) -> None:
        super().__init__(bench.bus.channel_id)
        self._bench, self._wake_s = bench, 0.0
        self._turn, self._back = Semaphore(0), Semaphore(0)
        self.is_done = False

    def next_event_s(self) -> float:
        return self._wake_s

    def poll(self, now_s: float) -> None:
        if not self.is_done and (now_s >= self._wake_s or not self.queue.empty()):
            self._turn.release()
            self._back.acquire()

    def recv(self, timeout: float | None = None) -> can.Message | None:
        end_s = self._bench.now_s + (timeout or 0.0)
        while (message := super().recv(0)) is None and self._bench.now_s < end_s:
            self._wake_s = end_s
            self._back.release()
            self._turn.acquire()
        return message

    def run(self, wanted: list[Check], path: Path) -> list[Result]:
        """Runs the checks in the tester's thread."""
        self._turn.acquire()
        try:
            od = read_eds(path, NODE).dictionary
            return run(NodeTester(Link(self, self._bench.daemon.clock), NODE, od=od), wanted)
        finally:
            self._wake_s, self.is_done = float("inf"), True
            self._back.release()


def whole_gateway(wanted: list[Check], folder: Path) -> list[Result]:
    """Runs the checks on the complete chain from gateway to simulated axis."""
    found: list[Result] = []

    async def scenario(bench: GatewayBench) -> None:
        async with bench.service.ready():
            await bench.wait(1.0)
            (path,) = folder.glob("*.eds")
            nodes = bench.daemon.clock.nodes
            with SteppedBus(bench) as bus, ThreadPoolExecutor() as threads:
                tested = threads.submit(bus.run, wanted, path)
                nodes[nodes.index(bench.plc)] = bus
                while not bus.is_done:
                    await bench.wait(0.01)
                found.extend(tested.result())

    with gateway_bench(folder) as bench:
        play(scenario(bench))
    return found


@contextmanager
def foreign(name: str, folder: Path) -> Iterator[NodeTester]:
    """Yields a tester of a node built on a third-party stack."""
    with local_node(EDS) if name == "canopen" else durand_drive() as opened:
        bus: Any = opened if name == "canopen" else opened[0]
        path = EDS if name == "canopen" else folder / "durand.eds"
        if name == "durand":
            path.write_text(opened[1].node.eds.content, encoding="utf-8")
        yield NodeTester(Link(bus, bus._clock), 5, od=read_eds(path, 5).dictionary)


def results_of(name: str, folder: Path) -> list[Result]:
    if name == "gateway":
        return whole_gateway(checks(moves=True), folder)
    if name in ("durand", "canopen"):  # without CiA 402, which both lack
        with foreign(name, folder) as tester:
            return run(tester, [each for each in checks(stores=True) if not each.id.startswith("402")])
    every = checks(moves=True, stores=True)
    if name == "slave":
        with gateway_slave(folder) as (tester, _):
            return run(tester, every)
    with simulated_drive() as (tester, _, _):
        return run(tester, every)


def main() -> None:
    parser(__doc__).parse_args()
    logging.disable(logging.CRITICAL)
    for name in ("gateway", "slave", "drive", "durand", "canopen"):
        with tempfile.TemporaryDirectory(prefix="conformance-") as folder:
            results = results_of(name, Path(folder))
        counts = Counter(each.verdict for each in results)
        print(f"| {name} | {len(results)} | " + " | ".join(str(counts[each]) for each in Verdict) + " |")
        for each in results:
            if each.verdict is Verdict.FAIL:
                print(f"    {each.check.id}: found {each.found}, expected {each.expected}")


if __name__ == "__main__":
    main()
