"""The simulated drive driven by canopen's own client, with its notifier thread, in real time.

No test asserts a duration; events are awaited with generous time-outs.
"""

import threading
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import can
import canopen
import pytest
from support.patience import PATIENCE_S, until

from hdbridge.clock import MonotonicClock
from hdbridge.device.node import DriveNode
from hdbridge.device.run import run
from hdbridge.errors import BusError
from hdbridge.sim.lockstep import VirtualClock

EDS = Path(__file__).parents[2] / "eds" / "hdbridge-402.eds"


@pytest.fixture
def channel() -> str:
    return f"interop-{uuid4()}"


@pytest.fixture
def drive(channel: str, motor) -> Iterator[DriveNode]:
    """A drive in a thread of its own."""
    stop = threading.Event()
    with can.Bus(interface="virtual", channel=channel, ignore_config=True) as bus:
        node = DriveNode(bus, motor, EDS, 5, MonotonicClock())
        thread = threading.Thread(target=run, args=(bus, node, MonotonicClock(), stop.is_set))
        thread.start()
        try:
            yield node
        finally:
            stop.set()
            thread.join()


@pytest.fixture
def network(channel: str) -> Iterator[canopen.Network]:
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.05
    network.connect(interface="virtual", channel=channel, ignore_config=True)
    try:
        yield network
    finally:
        network.disconnect()


@pytest.fixture
def remote(network: canopen.Network, drive: DriveNode) -> canopen.RemoteNode:
    remote = network.add_node(5, str(EDS))
    remote.sdo.RESPONSE_TIMEOUT = PATIENCE_S
    return remote


def test_pdo_configuration_by_canopen(network, remote):
    remote.tpdo.read()
    remote.tpdo[1].clear()
    remote.tpdo[1].add_variable(0x6041)
    remote.tpdo[1].add_variable(0x60E4, 1)
    remote.tpdo[1].trans_type = 1
    remote.tpdo[1].enabled = True
    remote.tpdo.save()
    received = []
    network.subscribe(0x185, lambda can_id, data, timestamp: received.append(bytes(data)))
    remote.nmt.state = "OPERATIONAL"
    until(lambda: network.sync.transmit() or bool(received))
    assert received[0] == b"\x50\x02" + bytes(4)


class BrokenBus(can.BusABC):
    """An interface that was unplugged."""

    def __init__(self) -> None:
        super().__init__(channel="gone")
        self.channel_info = "gone"

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise can.CanOperationError("network is down")

    def _recv_internal(self, timeout: float | None):
        raise can.CanOperationError("network is down")


def test_a_drive_without_its_bus_runs_on_and_finally_gives_up(motor):
    clock = VirtualClock()
    with BrokenBus() as bus:
        node = DriveNode(bus, motor, EDS, 1, clock)
        with pytest.raises(BusError, match="gone: cannot be read"):
            run(bus, node, clock, lambda: False)
    assert motor.elapsed_s > 4.0


def test_frames_that_cannot_be_sent_are_dropped(motor):
    with BrokenBus() as bus:
        bus.recv = lambda timeout: None
        node = DriveNode(bus, motor, EDS, 1, VirtualClock())
        node.poll(0.0)
        assert node.lost_frames == 1
