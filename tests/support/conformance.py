"""Nodes on the virtual bus for the conformance suite, in simulated time."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hdbridge.axis import AxisConfig, BusConfig
from hdbridge.conformance import NodeTester
from hdbridge.daemon.gateway.ideal import IdealAxis
from hdbridge.daemon.gateway.objects import nameplate, write_eds
from hdbridge.daemon.gateway.slave import BEHAVIOUR
from hdbridge.daemon.machinefile import GatewaySettings
from hdbridge.device.node import DriveNode
from hdbridge.drive.link import Link
from hdbridge.files.edsfile import shared_eds
from hdbridge.sim.lockstep import LockstepBus, VirtualClock, lockstep_bench
from support.ideal_motor import IdealMotor

ROOT = Path(__file__).parents[2]
EDS = ROOT / "eds" / "hdbridge-402.eds"


@contextmanager
def simulated_drive(
    behaviour: Any = None, **options: Any
) -> Iterator[tuple[NodeTester, DriveNode, IdealMotor]]:
    """Provides a tester, the simulated drive and its motor, which follows the demand exactly."""
    motor = IdealMotor(100_000)
    with lockstep_bench(motor, EDS, behaviour=behaviour) as (bus, clock, node):
        yield NodeTester(Link(bus, clock), 1, od=shared_eds(EDS, 1).dictionary, **options), node, motor


@contextmanager
def gateway_bus(folder: Path) -> Iterator[tuple[LockstepBus, VirtualClock, DriveNode]]:
    """Provides the master's interface, the clock, and the slave of a gateway with an ideal axis."""
    axis = AxisConfig.load(ROOT / "profiles" / "article" / "axis.yaml")
    settings = GatewaySettings(bus=BusConfig(interface="virtual", channel="outer"), nodes={axis.name: 5})
    path = write_eds(folder, axis, settings)
    plate, plant = nameplate(axis, settings), IdealAxis(axis.gear.ratio)
    plant.motor_counts = 1_000_000
    with lockstep_bench(plant, path, 5, nameplate=plate, behaviour=BEHAVIOUR) as bench:
        yield bench


@contextmanager
def gateway_slave(folder: Path) -> Iterator[tuple[NodeTester, DriveNode]]:
    """Provides a tester on the bus of `gateway_bus`, and the slave of the gateway."""
    with gateway_bus(folder) as (bus, clock, node):
        yield NodeTester(Link(bus, clock), 5, od=shared_eds(folder / "article.eds", 5).dictionary), node
