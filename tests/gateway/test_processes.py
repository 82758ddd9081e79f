"""The whole daemon with a gateway, in processes of its own, and python-canopen as the foreign master."""

import os
import signal
from pathlib import Path

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402
from support import patience
from support.running import running

from hdbridge.daemon.gateway.objects import write_eds
from hdbridge.daemon.machine import Machine

MACHINE = """
schema: hdbridge.machine/1
name: between
axes:
  - profile: article
gateway:
  bus: {{interface: udp_multicast, channel: 239.74.163.9, options: {{port: {port}}}}}
  nodes: {{article: 5}}
  timeout_ms: 2000
"""
COUNTS_PER_DEG = 36_000


class Patient(BaseNode402):
    """Only extends the time-outs, for busy machines."""

    TIMEOUT_SWITCH_STATE_FINAL = 60.0
    TIMEOUT_SWITCH_STATE_SINGLE = 30.0
    TIMEOUT_CHECK_TPDO = 30.0
    TIMEOUT_SWITCH_OP_MODE = 30.0


@pytest.mark.filterwarnings("ignore")
def test_a_foreign_master_moves_the_axis_and_a_dead_gateway_does_not(tmp_path: Path) -> None:
    path = tmp_path / "machine.yaml"
    path.write_text(MACHINE.format(port=20_000 + os.getpid() % 20_000), encoding="utf-8")
    machine = Machine.load(path)
    gateway = machine.gateway
    assert gateway is not None
    path_of_eds = write_eds(tmp_path, machine.axes[0].config, gateway)
    with running(tmp_path, path, "--simulate", name="between") as daemon:
        daemon.until_notified("READY=1")
        daemon.until_axis("disabled")
        network = canopen.Network()
        options = {"port": gateway.bus.options["port"]}
        network.connect(interface="udp_multicast", channel=gateway.bus.channel, **options)
        try:
            node = Patient(5, str(path_of_eds))
            node.sdo.RESPONSE_TIMEOUT = 30.0
            network.add_node(node)
            node.nmt.state = "PRE-OPERATIONAL"
            node.rpdo.read()
            node.rpdo[1].enabled = False  # multicast returns a program's own frames
            node.rpdo[1].save()
            node.setup_402_state_machine()
            node.op_mode = "PROFILED POSITION"
            node.nmt.state = "OPERATIONAL"
            for state in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED"):
                node.state = state
            assert daemon.axis()["mode"] == "follow"
            assert daemon.axis()["outer"]["node_id"] == 5
            node.sdo[0x607A].raw = 3 * COUNTS_PER_DEG
            node.sdo[0x6040].raw = 0x1F
            patience.until(lambda: node.sdo[0x6041].raw & 0x1400 == 0x1400, lambda: daemon.events[-12:])
            window = node.sdo[0x6067].raw
            assert node.sdo[0x6064].raw == pytest.approx(3 * COUNTS_PER_DEG, abs=window)
            patience.until(lambda: abs(daemon.axis()["load_target_deg"] - 3.0) < 1e-6)
            patience.until(lambda: abs(node.sdo[0x6064].raw - 3 * COUNTS_PER_DEG) < 100)

            os.kill(daemon.pids("control")[-1], signal.SIGKILL)
            patience.until(lambda: node.sdo[0x6041].raw & 0x4F == 0x08, lambda: daemon.events[-12:])
            assert node.sdo[0x603F].raw == 0x6010
            daemon.until_axis("disabled")
            node.state = "OPERATION ENABLED"

            (process,) = daemon.pids("gateway")
            os.kill(process, signal.SIGKILL)
            patience.until(lambda: daemon.axis()["state"] == "disabled", lambda: daemon.events[-12:])
            patience.until(lambda: len(daemon.pids("gateway")) == 2, lambda: daemon.events[-12:])
            patience.until(lambda: daemon.axis()["outer"]["alive"], lambda: daemon.events[-12:])
            patience.until(lambda: node.sdo[0x6041].raw & 0x4F == 0x40, lambda: daemon.events[-12:])
            assert daemon.axis()["state"] == "disabled"
        finally:
            network.disconnect()
