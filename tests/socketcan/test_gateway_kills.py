"""A daemon with a gateway on two real CAN buses; a process is killed while another master moves the axis.

That master keeps sending *enable operation* and targets. None of it may move the axis.
"""

import os
import signal
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import canopen
import pytest
from support.daemon_bench import OURS, STATE_TPDO, THEIRS, Cable, Witness
from support.daemon_faults import IN_ORDER
from support.running import Daemon, gone, running

from hdbridge.axis import AxisConfig
from hdbridge.daemon.gateway.objects import write_eds
from hdbridge.daemon.machine import Machine
from hdbridge.drive.states import State, decode
from tests.socketcan.conftest import CHANNEL, unhurried_profile

MACHINE = """
schema: hdbridge.machine/1
name: killed
axes: [{{profile: {profile}}}]
bus: {{interface: socketcan, channel: {inner}}}
gateway:
  bus: {{interface: socketcan, channel: {outer}}}
  nodes: {{{axis}: 5}}
"""
PERIOD_S = 0.02
STEP = 7200
"""Increments per period: 10 deg/s."""


class Plc(threading.Thread):
    """Sends a controlword and a target before each SYNC, whatever the answer."""

    def __init__(self) -> None:
        super().__init__()
        self.bus = can.Bus(interface="socketcan", channel=CHANNEL, ignore_config=True)
        self.word = self.step = self.target = 0
        self.status = self.position = self.boots = 0
        self.codes: list[int] = []
        self.ending = False

    def run(self) -> None:
        next_s = time.monotonic()
        while not self.ending:
            next_s += PERIOD_S
            while (left_s := next_s - time.monotonic()) > 0.0:
                if (message := self.bus.recv(left_s)) is not None:
                    self._take(message.arbitration_id, bytes(message.data))
            self.target += self.step
            for can_id, data in ((0x205, struct.pack("<Hi", self.word, self.target)), (0x080, b"")):
                self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def _take(self, can_id: int, data: bytes) -> None:
        if can_id == 0x185:
            self.status, self.position = struct.unpack_from("<Hi", data)
        elif can_id == 0x085:
            self.codes.append(struct.unpack_from("<H", data)[0])
        elif can_id == 0x705 and data == b"\0":
            self.boots += 1


def map_pdos(folder: Path, machine: Machine) -> None:
    """Configures and starts the gateway's node by python-canopen."""
    assert machine.gateway is not None
    path = write_eds(folder, machine.axes[0].config, machine.gateway)
    network = canopen.Network()
    network.connect(interface="socketcan", channel=CHANNEL)
    node = network.add_node(5, str(path))
    node.sdo.RESPONSE_TIMEOUT = 30.0
    for pdo, words in ((node.rpdo[1], (0x6040, 0x607A)), (node.tpdo[1], (0x6041, 0x6064))):
        pdo.read()
        pdo.clear()
        for index in words:
            pdo.add_variable(index)
        pdo.trans_type = 1
        pdo.save()
    node.sdo[0x6060].raw = 8
    node.nmt.state = "OPERATIONAL"
    network.disconnect()


@contextmanager
def master(folder: Path, machine: Machine) -> Iterator[Plc]:
    """Maps its PDOs, then cycles."""
    map_pdos(folder, machine)
    plc = Plc()
    plc.start()
    try:
        yield plc
    finally:
        plc.ending = True
        plc.join()
        plc.bus.shutdown()


@contextmanager
def under_way(folder: Path) -> Iterator[tuple[Daemon, Plc, Witness]]:
    """The master moves the axis at 10 deg/s."""
    profile = unhurried_profile()
    path = folder / "machine.yaml"
    names = {"profile": profile, "inner": OURS, "outer": CHANNEL, "axis": AxisConfig.load(profile).name}
    path.write_text(MACHINE.format(**names), encoding="utf-8")
    cable = Cable(profile)
    try:
        cable.plug()
        with running(folder, path, name="killed") as daemon:
            daemon.until_notified("READY=1")
            daemon.until_axis("disabled")
            with master(folder, Machine.load(path)) as plc:
                enable(daemon, plc)
                witness = Witness.on(THEIRS, PERIOD_S)
                try:
                    yield daemon, plc, witness
                finally:
                    witness.close()
    finally:
        cable.unplug()


def enable(daemon: Daemon, plc: Plc) -> None:
    for word, bits in ((0x06, 0x21), (0x07, 0x23), (0x0F, 0x27)):
        plc.target = plc.position
        plc.word = word
        daemon.until(lambda bits=bits: plc.status & 0x6F == bits, f"{bits:02X}h")
    plc.step = STEP
    daemon.until(lambda: daemon.axis()["velocity_deg_s"] > 9.0, "it moves")


def stays_without_power(plc: Plc, witness: Witness) -> None:
    """Checks that the drive has no power for a second in which the master still requests motion."""
    witness.begin()
    with pytest.raises(AssertionError, match="not within"):
        witness.cycles_until(powered, 50)
    assert (plc.word, plc.step) == (0x0F, STEP)


def powered(message: can.Message) -> bool:
    if message.arbitration_id != STATE_TPDO:
        return False
    return decode(struct.unpack_from("<H", message.data)[0]) is State.OPERATION_ENABLED


def killed(witness: Witness, pid: int) -> int:
    """Kills a process; returns the cycles of the inner bus until the drive has no power."""
    witness.begin()
    os.kill(pid, signal.SIGKILL)
    return witness.cycles_until(
        lambda each: each.arbitration_id == STATE_TPDO and not powered(each), IN_ORDER
    )


@pytest.mark.slow  # 34 s of CPU time; tests/gateway kills the processes in every run, without vcan
@pytest.mark.usefixtures("interface")
def test_a_killed_process_leads_to_no_motion_without_a_request(tmp_path: Path) -> None:
    with under_way(tmp_path) as (daemon, plc, witness):
        gateways, (control,) = daemon.pids("gateway"), daemon.pids("control")
        witness.begin()
        os.kill(control, signal.SIGKILL)
        witness.cycles_until(lambda each: each.arbitration_id == 0x081, IN_ORDER)  # the drive on its own
        daemon.until(lambda: plc.status & 0x4F == 0x08, "FAULT")
        assert set(plc.codes) <= {0x6010, 0x7500}
        daemon.until(lambda: len(daemon.pids("control")) == 2, "another control process")
        daemon.until_axis("disabled")
        stays_without_power(plc, witness)
        assert daemon.pids("gateway") == gateways

        plc.word = plc.step = 0
        time.sleep(5 * PERIOD_S)
        plc.word = 0x80
        daemon.until(lambda: plc.status & 0x4F == 0x40, "the fault is reset")
        enable(daemon, plc)
        plc.boots, controls = 0, daemon.pids("control")
        killed(witness, gateways[0])
        daemon.until(lambda: plc.boots and daemon.axis()["outer"]["alive"], "another gateway process")
        stays_without_power(plc, witness)
        assert daemon.pids("control") == controls

        plc.word = plc.step = 0
        map_pdos(tmp_path, Machine.load(tmp_path / "machine.yaml"))
        enable(daemon, plc)
        killed(witness, daemon.process.pid)  # the keeper
        daemon.process.wait()
        children = [pid for name in ("control", "service", "gateway") for pid in daemon.pids(name)]
        while not all(gone(pid) for pid in children):
            time.sleep(0.1)
        stays_without_power(plc, witness)
