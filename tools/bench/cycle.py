"""CPU time of one control cycle, compared with a bare exchange of the same frames and with canopen.

    python tools/bench/cycle.py [--interface virtual|socketcan]...

One run measures, in interleaved blocks, the CPU time of the thread (`time.thread_time`) per cycle of

  bare         python-can alone: SYNC, two TPDOs, RPDO (and the master's heartbeat as often as it is due),
               built and taken apart with struct; nothing is checked
  cycle        `hdbridge.control.cycle.Cycle` with the whole fault table, target held
  compensated  the same with the compensation of the article's model in every cycle
  filtered     the same with the filter of the response in motion
  canopen      the same loop on canopen's PDO objects (no compensation, nothing is checked)

and prints medians over the blocks, and their ratios to the bare exchange.

Nothing sleeps. On the virtual bus the answering node runs in the same thread; its cost is measured in
the same blocks and subtracted from each alike. On SocketCAN the kernel's own gateway (can-gw, set up with
cangw, as root) turns each SYNC into the two TPDOs, which costs no process any time; there wall time is
measured, because the CPU clock of user-mode-linux counts in steps of 4 ms.
Without --interface, all interfaces of this machine are measured.
"""

from __future__ import annotations

import math
import struct
import subprocess
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import can
import canopen
from can.interfaces.virtual import VirtualBus
from harness import CHANNEL, PROFILE, block_us, in_turn, medians, parser, undisturbed, verdict

from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.axis.model.response import LeadFilter, Response
from hdbridge.clock import Clock
from hdbridge.control.compensation import Compensation, CompensationLimits
from hdbridge.control.cycle import Cycle, Feedback
from hdbridge.drive.image import ProcessImage
from hdbridge.drive.link import Link
from hdbridge.drive.states import State
from hdbridge.drive.supervision import Supervision
from hdbridge.errors import SafetyStop

STATUS_ENABLED = 0x1237
ENABLE = 0x0F
TPDO1, TPDO2, RPDO1 = struct.Struct("<Hih"), struct.Struct("<ii"), struct.Struct("<Hi")
GOAL = 1.25
FILTERED_GOAL = 1.3
Result = tuple[str, dict[str, float]]


class NeverSleeping:
    """Real clock without waiting: every deadline counts as reached."""

    now = staticmethod(time.monotonic)

    def sleep_until(self, deadline_s: float) -> None:
        """Returns at once."""


def answers(*node_ids: int) -> tuple[can.Message, ...]:
    """Returns the two TPDOs of each drive, enabled and at position zero."""
    data = {0x180: TPDO1.pack(STATUS_ENABLED, 0, 0), 0x280: TPDO2.pack(0, 0)}
    return tuple(
        can.Message(arbitration_id=base + node_id, is_extended_id=False, data=data[base])
        for node_id in node_ids
        for base in data
    )


def heartbeats(*node_ids: int) -> tuple[can.Message, ...]:
    """Returns the heartbeats of these drives."""
    return tuple(
        can.Message(arbitration_id=0x700 + node_id, is_extended_id=False, data=b"\x05")
        for node_id in node_ids
    )


class AnsweringBus(VirtualBus):
    """Master's interface of a virtual bus on which the other nodes answer SYNC immediately."""

    def __init__(self, *node_ids: int) -> None:
        super().__init__(channel=self)
        self.listener = VirtualBus(channel=self)
        self.replies = answers(*node_ids)
        self.heartbeats = heartbeats(*node_ids)
        self.count = 0

    def answer(self) -> None:
        self.count += 1
        if self.count % 12 == 0:
            for heartbeat in self.heartbeats:
                self.queue.put(heartbeat)
        for reply in self.replies:
            self.queue.put(reply)
        self.listener.queue.queue.clear()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        super().send(msg, timeout)
        if msg.arbitration_id == 0x80:
            self.answer()

    def shutdown(self) -> None:
        self.listener.shutdown()
        super().shutdown()


@contextmanager
def answering_kernel(*node_ids: int) -> Iterator[can.BusABC]:
    """Opens a bus on which the kernel's CAN gateway answers.

    It answers SYNC with TPDOs, and the master's heartbeat with those of the drives.
    """
    rules = [("080", f"{reply.arbitration_id:X}.8.{reply.data.hex()}") for reply in answers(*node_ids)]
    rules += [("77F", f"{0x700 + node_id:X}.1.0500000000000000") for node_id in node_ids]
    commands = [
        ["-s", CHANNEL, "-d", CHANNEL, "-e", "-i", "-f", f"{can_id}:7FF", "-m", f"SET:ILD:{reply}"]
        for can_id, reply in rules
    ]
    done = []
    try:
        for command in commands:
            subprocess.run(["cangw", "-A", *command], check=True)
            done.append(command)
        with can.Bus(interface="socketcan", channel=CHANNEL, ignore_config=True) as bus:
            yield bus
    finally:
        for command in done:
            subprocess.run(["cangw", "-D", *command], check=False)


def response_of_usual_length(cycle_ms: float) -> Response:
    """Returns a response with a filter of typical length: as many weights as for the article's axis."""
    return Response(
        cycle_ms=cycle_ms,
        following_lag_ms=10.0,
        known_to_hz=90.0,
        frequency_hz=(1.0, 90.0),
        gain=(1.0, 1.0),
        phase_deg=(0.0, 0.0),
        uncertainty=(0.1, 0.1),
        filter=LeadFilter(
            lead_cycles=8, per_cycle=2, full_speed_deg_s=1.0, weights=(0.01,) * 55, feedback=(-0.5, 0.05)
        ),
    )


class Variants:
    """The loops under test: each call is one cycle."""

    def __init__(
        self, bus: can.BusABC, axis: AxisConfig, model: TransmissionModel, clock: Clock | None = None
    ) -> None:
        self.bus, self.axis = bus, axis
        self.clock = clock if clock is not None else NeverSleeping()
        self.period_s = axis.drive.cycle_s
        self.heartbeat_s = axis.drive.heartbeat_ms / 2e3
        self.heartbeat_due_s = 0.0
        self.deadline_s = 0.0
        self.compensation = Compensation(model, CompensationLimits(), self.period_s)
        self.compensation.engage()
        response = replace(model, response=response_of_usual_length(1000.0 * self.period_s))
        self.in_motion = Compensation(response, CompensationLimits(), self.period_s)
        self.in_motion.engage()
        self.image = ProcessImage(axis)
        self.cycle = Cycle(Link(bus, self.clock), self.clock, self.image, Supervision(), self.period_s)
        self.network, self.node = self._canopen(axis)
        pdos = (self.node.tpdo[1], self.node.tpdo[2], self.node.rpdo[1])
        self.names = {pdo: [variable.name for variable in pdo.map] for pdo in pdos}

    def start(self) -> None:
        """Restarts the deadlines before a block."""
        while self.bus.recv(0.0) is not None:
            pass
        self.deadline_s = self.clock.now()
        # The answering process may be slow in its first cycles.
        for _ in range(20):
            self.cycle.restart()
            self.cycle.axes[0].supervision.reset()
            with suppress(SafetyStop):
                if self.cycle.tick().fresh:
                    break
        self.image.power.go(State.OPERATION_ENABLED)

    def _wait(self) -> bool:
        """Sleeps until the next deadline; returns True if the master's heartbeat is due."""
        self.deadline_s += self.period_s
        self.clock.sleep_until(self.deadline_s)
        now = self.clock.now()
        if now < self.heartbeat_due_s:
            return False
        self.heartbeat_due_s = now + self.heartbeat_s
        return True

    def bare(self) -> None:
        due = self._wait()
        bus, node_id = self.bus, 1
        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        seen = 0
        while seen < 2:
            message = bus.recv(0.1)
            assert message is not None
            if message.arbitration_id == 0x180 + node_id:
                TPDO1.unpack(message.data)
                seen += 1
            elif message.arbitration_id == 0x280 + node_id:
                TPDO2.unpack(message.data)
                seen += 1
        data = RPDO1.pack(ENABLE, 0)
        bus.send(can.Message(arbitration_id=0x200 + node_id, is_extended_id=False, data=data))
        if due:
            bus.send(can.Message(arbitration_id=0x77F, is_extended_id=False, data=b"\x05"))

    def plain(self) -> None:
        self.cycle.tick(0)

    def compensated(self) -> None:
        self.cycle.tick(self._command)

    def filtered(self) -> None:
        self.cycle.tick(self._command_in_motion)

    def _command(self, feedback: Feedback) -> int:
        # A slow sine of 2 deg at the load: steady motion with occasional reversals.
        load_deg = 2.0 * math.sin(feedback.time_s)
        return self.image.target_counts_for(self.compensation.command(load_deg))

    def _command_in_motion(self, feedback: Feedback) -> int:
        load_deg = 2.0 * math.sin(feedback.time_s)
        return self.image.target_counts_for(self.in_motion.command(load_deg))

    @staticmethod
    def _canopen(axis: AxisConfig) -> tuple[canopen.Network, canopen.RemoteNode]:
        network = canopen.Network()
        node = network.add_node(axis.drive.node_id, str(axis.eds_path))
        for pdo, cob_id, objects in (
            (node.tpdo[1], 0x180, (0x6041, 0x6064, 0x6077)),
            (node.tpdo[2], 0x280, (0x60E4, 0x6062)),
            (node.rpdo[1], 0x200, (0x6040, 0x607A)),
        ):
            pdo.clear()
            for index in objects:
                pdo.add_variable(index, int(index == 0x60E4))
            pdo.cob_id, pdo.enabled = cob_id + node.id, True
            pdo.subscribe()
        return network, node

    def with_canopen(self) -> None:
        due = self._wait()
        network, node, bus = self.network, self.node, self.bus
        network.bus = bus
        network.sync.transmit()
        seen = 0
        while seen < 2:
            message = bus.recv(0.1)
            assert message is not None
            network.notify(message.arbitration_id, message.data, message.timestamp)
            seen += message.arbitration_id in (0x180 + node.id, 0x280 + node.id)
        for pdo in (node.tpdo[1], node.tpdo[2]):
            for name in self.names[pdo]:
                pdo[name].raw  # noqa: B018 - reading is what is measured
        for name, value in zip(self.names[node.rpdo[1]], (ENABLE, 0), strict=True):
            node.rpdo[1][name].raw = value
        node.rpdo[1].transmit()
        if due:
            network.send_message(0x77F, b"\x05")


def run(
    variants: Variants,
    blocks: int,
    cycles: int,
    responder: Callable[[], object] | None,
    timer: Callable[[], float],
) -> dict[str, float]:
    """Returns the median time per cycle of each variant, us, without the cost of the answering node."""

    def block(loop: Callable[[], object]) -> float:
        variants.start()
        block_us(loop, 20)
        return block_us(loop, cycles, timer)

    loops: dict[str, Callable[[], object]] = {
        "bare": variants.bare,
        "cycle": variants.plain,
        "compensated": variants.compensated,
        "filtered": variants.filtered,
        "canopen": variants.with_canopen,
    }
    measured = {name: partial(undisturbed, partial(block, loop)) for name, loop in loops.items()}
    if responder is not None:
        measured["responder"] = partial(block_us, responder, cycles)
    result = {"responder": 0.0} | medians(in_turn(measured, blocks))
    cost = result.pop("responder")
    return {name: value - cost for name, value in result.items()} | {"responder": cost}


def report(result: dict[str, float], where: str) -> str:
    bare = result["bare"]
    lines = [f"CPU time of one cycle on {where}, medians:", ""]
    names = {
        "bare": "bare python-can exchange",
        "cycle": "hdbridge cycle",
        "compensated": "hdbridge cycle, compensated",
        "filtered": "hdbridge cycle, compensated and filtered",
        "canopen": "canopen's PDO objects",
    }
    for name, label in names.items():
        lines.append(f"  {label:<40} {result[name]:>8.1f} us   {result[name] / bare:>6.2f} x")
    lines += [
        "",
        verdict("compensated", result["compensated"] / bare, GOAL, "bare"),
        verdict("filtered", result["filtered"] / result["compensated"], FILTERED_GOAL, "compensated"),
    ]
    return "\n".join(lines)


def measure(interface: str, blocks: int, cycles: int) -> Result:
    """Returns a description of the interface, and the median of each variant."""
    axis, model = AxisConfig.load(PROFILE), TransmissionModel.load(PROFILE / "model.yaml")
    node_id = axis.drive.node_id
    if interface == "virtual":
        with AnsweringBus(node_id) as bus:
            result = run(Variants(bus, axis, model), blocks, cycles, bus.answer, time.thread_time)
            bus.queue.queue.clear()
        return "the virtual bus", result
    with answering_kernel(node_id) as bus:
        result = run(Variants(bus, axis, model), blocks, cycles, None, time.perf_counter)
    return f"SocketCAN ({CHANNEL})", result


def main() -> None:
    given = parser(__doc__, blocks=21, cycles=500)
    given.add_argument("--interface", choices=("virtual", "socketcan"), action="append")
    options = given.parse_args()
    warnings.simplefilter("ignore")
    interfaces = options.interface or ["virtual"]
    if not options.interface and Path(f"/sys/class/net/{CHANNEL}").exists():
        interfaces.append("socketcan")
    for interface in interfaces:
        where, result = measure(interface, options.blocks, options.cycles)
        print(report(result, where), end="\n\n")


if __name__ == "__main__":
    main()
