"""CPU time of one cycle of the daemon's control loop, compared with the bench's cycle on the same bus.

    python tools/bench/daemon_loop.py [--axes 1,2,6] [--blocks 21] [--cycles 500]

One run measures, in interleaved blocks, the CPU time of the thread (`time.thread_time`) of

  bench     `Cycle.tick` with the compensation of the article's model, as `Bench` runs it
  loop N    `Controller.turn` for N enabled axes: set-point, compensation, states, sample into shared memory
  follow 1  the same for one axis that follows the set-points of a gateway

all on the same path, and prints medians, the ratio to the bench, and the cost per axis. The answering nodes
run in the same thread; their cost is measured in the same blocks and subtracted. Nothing sleeps.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial

import can
from cycle import AnsweringBus, NeverSleeping
from harness import PROFILE, Busy, block_us, in_turn, medians, parser, undisturbed, verdict

from hdbridge.axis import AxisConfig
from hdbridge.axis.effects import Moment
from hdbridge.axis.model import TransmissionModel
from hdbridge.clock import Clock
from hdbridge.control.bench import axis_view, compensation_for
from hdbridge.control.buscycle import BusCycle
from hdbridge.control.channelstate import ChannelState
from hdbridge.control.cycle import Cycle
from hdbridge.daemon.loop.controller import Controller
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import CommandKind, Memory, OuterKnot
from hdbridge.daemon.setting import CompensationSetting
from hdbridge.drive.feedback import Feedback
from hdbridge.drive.image import ProcessImage
from hdbridge.drive.link import Link
from hdbridge.drive.states import State
from hdbridge.drive.supervision import Supervision
from hdbridge.enums import Scheme
from hdbridge.motion import SetPoint

GOAL = 1.3
STATUS_OFF = 0x0250


def configs_of(count: int, cycle_ms: float | None = None) -> list[AxisConfig]:
    """Returns several copies of the article's axis on one bus, by default with its cycle time."""
    first = AxisConfig.load(PROFILE)
    cycle = {} if cycle_ms is None else {"cycle_ms": cycle_ms}
    drives = [first.drive.model_copy(update={"node_id": node, **cycle}) for node in range(1, count + 1)]
    return [first.model_copy(update={"name": f"axis{drive.node_id}", "drive": drive}) for drive in drives]


def bench_cycle(
    bus: can.BusABC,
    model: TransmissionModel,
    axis: AxisConfig | None = None,
    clock: Clock | None = None,
    image: ProcessImage | None = None,
) -> tuple[Callable[[], None], Cycle]:
    """Returns the bench's cycle (`Bench._leg` without storing samples); by default it never sleeps.

    ``image`` is the process image of a drive that is ready to be enabled.
    """
    axis = axis or configs_of(1)[0]
    clock = clock or NeverSleeping()
    image = image or ProcessImage(axis)
    cycle = Cycle(Link(bus, clock), clock, image, Supervision(), axis.drive.cycle_s)
    compensation = compensation_for(axis, model.bound_to(axis))
    compensation.engage()
    sensed, needs, at_rest = ChannelState(axis), bool(compensation.needs), Moment()
    # Set-points of the same move as in the daemon's loop, so that both follow the same path.
    set_point = SetPoint(axis_view(axis).limits, axis.drive.cycle_s)
    goal = 300.0
    for _ in range(5):
        cycle.tick()
    image.power.go(State.OPERATION_ENABLED)
    target_deg = 0.0

    def answer(feedback: Feedback) -> int:
        moment = sensed.moment(feedback, target_deg, compensation) if needs else at_rest
        follow = compensation.command if feedback.fresh else compensation.hold
        return image.target_counts_for(follow(target_deg, moment))

    def turn() -> None:
        nonlocal target_deg, goal
        if set_point.at_rest:
            set_point.goto(goal, 2.0)
            goal = -goal
        target_deg = set_point.step()
        feedback = cycle.tick(answer)
        # Conversions that the bench makes in each cycle.
        image.motor_deg(feedback.demand_counts)
        image.motor_deg(feedback.motor_counts)
        image.load_deg(feedback.load_counts)

    return turn, cycle


def controller_of(
    bus: can.BusABC, memory: Memory, model: TransmissionModel, *, followed: int = 0
) -> Controller:
    """Returns a control loop whose axes are enabled and in motion; with ``followed`` above 0, the first axis
    follows that many set-points of a gateway.
    """
    configs = configs_of(memory.axes)
    cycle = BusCycle(Link(bus, NeverSleeping()), NeverSleeping(), memory.period_s, bitrate_bps=1_000_000)
    controller = Controller(cycle, [(each, None) for each in configs], memory)
    for each in controller.axes:
        setting = CompensationSetting(model.bound_to(each.config), Scheme.EXTENDED)
        each.follower.use(setting, moving=False)
    for axis in range(memory.axes):
        memory.commands.post(CommandKind.VERIFIED, axis, k=STATUS_OFF)
        memory.commands.post(CommandKind.ENABLE, axis, k=STATUS_OFF)
        for _ in range(5):
            controller.turn()
    if followed:
        follow(controller, memory, followed)
        return controller
    for axis in range(memory.axes):
        memory.commands.post(CommandKind.MOVE, axis, a=300.0, b=2.0, c=float("nan"))
        controller.turn()
    return controller


def follow(controller: Controller, memory: Memory, turns: int) -> None:
    """Makes the axis follow a ramp of set-points in the gateway's ring, which normally the gateway fills."""
    memory.commands.post(CommandKind.FOLLOW, 0, a=1.0, j=1)
    begin_s, begin_deg = controller.cycle.due_s, controller.axes[0].set_point.position_deg
    for turn in range(turns):
        way_deg = 0.004 * min(turn * turn * 0.004, 2.0 * turn)  # 2 deg/s, within the limit of acceleration
        due_s = begin_s + 0.004 * turn
        memory.followed[0].add(OuterKnot(1, due_s, begin_deg + way_deg, due_s))
    controller.turn()


def loop_block(count: int, model: TransmissionModel, cycles: int, *, followed: bool = False) -> float:
    """Returns the CPU time of a cycle of the loop with several axes, us."""
    with AnsweringBus(*range(1, count + 1)) as bus, Memory.create(count, 0.004) as memory:
        controller = controller_of(bus, memory, model, followed=cycles + 100 if followed else 0)
        block_us(controller.turn, 50)
        own = block_us(controller.turn, cycles)
        if any(axis.state is not AxisState.ENABLED for axis in controller.axes):
            raise Busy
        return own - block_us(bus.answer, cycles)


def bench_block(model: TransmissionModel, cycles: int) -> float:
    """Returns the CPU time of the bench's cycle, us."""
    with AnsweringBus(1) as bus:
        turn, _ = bench_cycle(bus, model)
        block_us(turn, 50)
        own = block_us(turn, cycles)
        return own - block_us(bus.answer, cycles)


def measure(counts: list[int], blocks: int, cycles: int) -> dict[str, float]:
    """Returns the median CPU time per cycle of each variant, us, without that of the answering nodes."""
    model = TransmissionModel.load(PROFILE / "model.yaml")
    variants = {
        "bench": partial(bench_block, model, cycles),
        **{f"loop {count}": partial(loop_block, count, model, cycles) for count in counts},
        "follow 1": partial(loop_block, 1, model, cycles, followed=True),
    }
    return medians(in_turn({name: partial(undisturbed, each) for name, each in variants.items()}, blocks))


def report(result: dict[str, float]) -> str:
    bench = result["bench"]
    lines = ["CPU time of one cycle on the virtual bus, medians:", ""]
    for name, value in result.items():
        axes = int(name.split()[1]) if name != "bench" else 1
        lines.append(
            f"  {name:<8} {value:>8.1f} us  {value / bench:>6.2f} x bench  {value / axes:>8.1f} us/axis"
        )
    ratio = result.get("loop 1", 0.0) / bench
    return "\n".join([*lines, "", verdict("one axis", ratio, GOAL, "the bench's own cycle")])


def main() -> None:
    given = parser(__doc__, blocks=21, cycles=500)
    given.add_argument("--axes", default="1,2,6", help="numbers of axes, comma-separated")
    options = given.parse_args()
    warnings.simplefilter("ignore")
    counts = [int(each) for each in options.axes.split(",")]
    print(report(measure(counts, options.blocks, options.cycles)))


if __name__ == "__main__":
    main()
