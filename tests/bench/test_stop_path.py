"""Stop path of a powered axis in each phase, for both users of the runner, over frames on the virtual bus."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from support.exercised import booted
from support.moves import Moves

from hdbridge.axis import AxisConfig
from hdbridge.commissioning.bringup.slow import SlowAxis
from hdbridge.control.bench import Bench
from hdbridge.device.node import DriveNode
from hdbridge.drive import Drive, State
from hdbridge.drive.states import decode
from hdbridge.errors import SafetyStop, TransitionError
from hdbridge.motion.procedures.moves import Dwell, MoveTo

PROFILE = Path(__file__).parents[2] / "profiles" / "article"
RPDO1 = 0x201
ENABLE_OPERATION = 0x0F
POWERED = (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE)
MOVING_COUNTS, ARRIVED_COUNTS = 500, 5550


class Stop:
    """One run that is stopped by ``act`` in the first cycle in which ``when`` is true."""

    def __init__(self, drive: Drive, node: DriveNode, when: Callable[["Stop"], bool], act: Any) -> None:
        self.drive, self.node, self.when, self.act = drive, node, when, act
        self.cycles = 0
        self.acted = False
        self.words: list[int] = []
        """Controlwords sent after the action."""
        self.on_word: dict[int, Callable[[], None]] = {}
        """Actions, by the number of these controlwords after which they run."""

    def interrupted(self) -> bool:
        self.cycles += 1
        if self.acted or not self.when(self):
            return False
        self.acted = True
        return bool(self.act(self.node))

    def run(self, runner: str) -> None:
        if runner == "bench":
            bench = Bench(self.drive, interrupted=self.interrupted)
            self._watch(bench)
            bench.run(Moves(MoveTo(5.0, velocity_deg_s=2.4), Dwell(0.2)))
        else:
            slow = SlowAxis(self.drive, 30.0, self.interrupted)
            self._watch(slow)
            with slow.enabled():
                slow.travel(250.0)
                slow.sit(0.2)

    def _watch(self, runner: Bench | SlowAxis) -> None:
        """Records the controlwords of the cycle's RPDOs."""
        send = runner.cycle._send

        def recorded(can_id: int, data: bytes) -> None:
            if can_id == RPDO1 and self.acted:
                self.words.append(int.from_bytes(data[:2], "little") & 0x8F)
                self.on_word.pop(len(self.words), lambda: None)()
            send(can_id, data)

        runner.cycle._send = recorded

    def check(self) -> None:
        """Asserts that power is off, that no frame enables the drive, and that nothing moves any more."""
        firmware = self.node.firmware
        assert self.acted
        assert decode(firmware.statusword()) not in POWERED
        assert ENABLE_OPERATION not in self.words[1:], "the reply of the cycle itself is the only one"
        assert abs(firmware.motion.machine.velocity_counts_s) < 100
        there = firmware.motion.motor_counts
        clock = self.drive.link.clock
        clock.sleep_until(clock.now() + 0.5)
        assert abs(firmware.motion.motor_counts - there) < 10


@pytest.fixture(params=["bench", "bring-up"])
def runner(request: pytest.FixtureRequest) -> str:
    return request.param


@contextmanager
def stop(when: Callable[[Stop], bool], act: Callable[[DriveNode], object]) -> Iterator[Stop]:
    with booted(AxisConfig.load(PROFILE / "axis.yaml"), PROFILE / "truth.yaml", 1) as (drive, node):
        yield Stop(drive, node, when, act)
        node.faults.silent = False  # plugged in again, so that the drive can be closed


def moving(run: Stop) -> bool:
    return run.node.firmware.motion.motor_counts > MOVING_COUNTS


def arrived(run: Stop) -> bool:
    return run.node.firmware.motion.motor_counts > ARRIVED_COUNTS


def ctrl_c(_: DriveNode) -> bool:
    raise KeyboardInterrupt


def request(_: DriveNode) -> bool:
    return True


def wrong(_: DriveNode) -> bool:
    raise ZeroDivisionError


@pytest.mark.parametrize("act", [request, ctrl_c, wrong])
@pytest.mark.parametrize("when", [moving, arrived])
def test_an_interrupt_under_power(runner: str, when: Any, act: Any) -> None:
    with stop(when, act) as run:
        with pytest.raises(ZeroDivisionError if act is wrong else KeyboardInterrupt):
            run.run(runner)
        run.check()


@pytest.mark.parametrize("act", [request, ctrl_c])
def test_an_interrupt_in_each_cycle_of_the_power_on(runner: str, act: Any) -> None:
    states = set()
    for cycle in range(1, 9):
        with stop(lambda run, cycle=cycle: run.cycles == cycle, act) as run:
            with pytest.raises(KeyboardInterrupt):
                run.run(runner)
            run.check()
            assert abs(run.node.firmware.motion.motor_counts) < 10
            states.add(run.words[0] if run.words else None)
    assert len(states) > 1  # several states of the walk


@pytest.mark.parametrize("when", [moving, arrived])
def test_a_fault_of_the_drive(runner: str, when: Any) -> None:
    with stop(when, lambda node: node.faults.raise_error(0x3210)) as run:
        with pytest.raises(SafetyStop, match="3210h"):
            run.run(runner)
        run.check()


def test_a_fault_of_the_drive_during_the_power_on(runner: str) -> None:
    with stop(lambda run: run.cycles == 2, lambda node: node.faults.raise_error(0x3210)) as run:
        with pytest.raises(SafetyStop, match="the drive reports a fault"):
            run.run(runner)
        assert ENABLE_OPERATION not in run.words[1:]
        run.check()


@pytest.mark.parametrize("when", [lambda run: run.cycles == 2, moving, arrived])
def test_a_silent_drive_is_stopped_by_its_own_watchdogs(runner: str, when: Any) -> None:
    def silence(node: DriveNode) -> None:
        node.faults.silent = True

    with stop(when, silence) as run:
        with pytest.raises(SafetyStop, match=r"a TPDO is missing|heartbeat"):
            run.run(runner)
        run.drive.link.clock.sleep_until(run.drive.link.clock.now() + 1.0)
        run.check()


def test_a_drive_that_falls_silent_during_the_stop(runner: str) -> None:
    def silence(node: DriveNode) -> bool:
        node.faults.silent = True
        return True

    with stop(moving, silence) as run:
        with pytest.raises(KeyboardInterrupt):
            run.run(runner)
        run.drive.link.clock.sleep_until(run.drive.link.clock.now() + 1.0)
        run.check()


def test_a_drive_that_can_no_longer_send_is_switched_off(runner: str) -> None:
    """It still receives, so it stops and loses its power without an answer."""

    def mute(node: DriveNode) -> None:
        node.faults.muted_ids = frozenset({0x181, 0x281, 0x581, 0x701})

    with stop(moving, mute) as run:
        begin_s = run.drive.link.now()
        with pytest.raises(SafetyStop, match="the drive did not confirm it"):
            run.run(runner)
        assert run.drive.link.now() - begin_s < 3.5
        assert decode(run.node.firmware.statusword()) is State.SWITCH_ON_DISABLED
        run.check()
        run.node.faults.muted_ids = frozenset()


def test_a_fault_during_the_stop(runner: str) -> None:
    def fail(node: DriveNode) -> bool:
        node.faults.raise_error(0x3210)
        return True

    with stop(moving, fail) as run:
        with pytest.raises(KeyboardInterrupt):
            run.run(runner)
        run.check()


@pytest.mark.parametrize("act", [request, lambda node: node.faults.raise_error(0x3210)])
def test_a_drive_that_ignores_the_quick_stop_is_disabled(runner, act, monkeypatch):
    with stop(moving, act) as run:
        monkeypatch.setattr(run.node.firmware, "_quick_stop", lambda: None)
        with pytest.raises((KeyboardInterrupt, SafetyStop)):
            run.run(runner)
        run.check()


def test_a_drive_that_does_not_power_up(runner: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with stop(lambda run: run.cycles == 100, lambda node: None) as run:
        monkeypatch.setattr(run.node.firmware, "_finish_power_up", lambda: None)
        with pytest.raises(TransitionError, match="did not reach 'operation enabled' within 2 s"):
            run.run(runner)
        assert decode(run.node.firmware.statusword()) is State.SWITCH_ON_DISABLED
        monkeypatch.undo()
        run.words.clear()
        run.check()


def test_the_normal_end_switches_power_off_at_standstill(runner: str) -> None:
    with stop(arrived, lambda node: None) as run:
        run.run(runner)
        firmware = run.node.firmware
        assert decode(firmware.statusword()) is State.SWITCH_ON_DISABLED
        assert run.words[-1] != ENABLE_OPERATION
        assert firmware.motion.motor_counts == pytest.approx(5556, abs=20)


def test_one_repeated_position_is_not_a_standstill(runner: str) -> None:
    """The drive brakes slowly, and a TPDO is lost meanwhile."""

    def brake_slowly(node: DriveNode) -> bool:
        node.faults.deceleration_counts_s2 = 2_000.0
        return True

    with stop(moving, brake_slowly) as run:
        run.on_word[20] = lambda: setattr(run.node.faults, "drop_tpdos", 1)
        with pytest.raises(KeyboardInterrupt):
            run.run(runner)
        run.check()
        assert len(run.words) > 100
