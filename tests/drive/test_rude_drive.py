"""A drive that restarts, stops on its own or gets no power does not move afterwards, by SDO or on a bench."""

from collections.abc import Iterator
from contextlib import contextmanager
from uuid import uuid4

import pytest
from support.daemon import article_axis
from support.rude import ENABLED, OFF, RudeDrive, Ways
from support.spoilt import SpoiltBus

from hdbridge.control.bench import Bench
from hdbridge.drive import Drive, Mode
from hdbridge.drive.sdo import SdoAbortError
from hdbridge.drive.states import State
from hdbridge.errors import DriveError, SafetyStop, SdoError, TransitionError
from hdbridge.motion.procedures.stepping import Stepping
from hdbridge.sim.lockstep import VirtualClock


@contextmanager
def booted(**ways: bool | float) -> Iterator[tuple[Drive, RudeDrive]]:
    axis, channel, clock = article_axis(1), str(uuid4()), VirtualClock()
    node = RudeDrive(channel, axis, clock)
    node.ways = Ways(**ways)  # type: ignore[arg-type]
    clock.nodes.append(node)
    with SpoiltBus(channel, clock) as bus:
        bus.private = True
        with Drive(bus, axis, clock) as drive:
            drive.boot()
            yield drive, node
    node.close()


@pytest.mark.parametrize("mode", [Mode.PP, Mode.HM, None])
def test_a_drive_that_restarted_is_not_enabled_before_it_is_booted_again(mode: Mode | None) -> None:
    with booted(starts_itself=True) as (drive, node):
        node.restart(lasts=False)
        drive.wait(0.05)
        with pytest.raises(TransitionError, match="run the command again"):
            drive.enable(mode)
        assert node.powered == 0
        drive.boot()
        drive.enable(Mode.PP)
        assert node.state == ENABLED


def test_a_drive_that_stopped_while_its_answer_was_lost_is_not_enabled_again() -> None:
    with booted(mode_delay_s=0.1) as (drive, node):
        node._values[0x605A, 0] = 6  # it stays in quick stop active
        drive.enable(Mode.HM)
        drive.wait(0.05)
        reply = node._reply

        def lost(answer: bytes) -> None:
            if answer[0] == 0x60:  # the controlword was obeyed
                node._reply = reply  # type: ignore[method-assign]
                node.miss_master()
            else:
                reply(answer)

        node._reply = lost  # type: ignore[method-assign]
        with pytest.raises(SdoError, match="one attempt"):
            drive._commander.control(0x000F)
        assert node.state != ENABLED
        assert node.powered == 1


def test_enable_operation_is_not_sent_to_a_drive_that_stopped_by_itself() -> None:
    with booted() as (drive, node):
        node._values[0x605A, 0] = 6
        drive.enable(Mode.HM)
        node.miss_master()
        with pytest.raises(DriveError, match="quick stop active"):
            drive._commander.control(0x001F)
        assert node.powered == 1


@pytest.mark.parametrize("mode", [Mode.PP, Mode.HM, None])
def test_a_refused_transfer_while_enabling_leaves_no_power(mode: Mode | None) -> None:
    for answers in range(30):
        with booted() as (drive, node):
            node.ways.mangles_sdo.extend(
                [
                    "",
                ]
                * answers
                + ["abort"]
            )
            try:
                drive.enable(mode)
            except SdoAbortError:
                assert node.state == OFF
                assert drive.image.power.aim is not State.OPERATION_ENABLED
            else:
                break
            finally:
                node.ways.mangles_sdo.clear()
    assert answers > 8


def test_a_drive_hears_its_master_while_an_answer_is_awaited() -> None:
    with booted() as (drive, node):
        drive.enable(Mode.PP)
        drive.wait(0.05)
        node.ways.mute_sdo.append(True)
        drive.state()
        assert node.state == ENABLED


@pytest.mark.parametrize(
    ("method", "counts", "starts"), [(34, 0, False), (35, 5000, False), (35, 0, True), (37, 0, True)]
)
def test_homing_is_over_only_if_the_drive_shows_its_start(method: int, counts: int, starts: bool) -> None:
    """Statusword bits 10 and 12 are always set."""
    with booted() as (drive, node):
        node.ways.reached, node.motor_counts = 0x1400, counts
        if starts:
            assert drive.home(method).motor_counts == 0
        else:
            with pytest.raises(TransitionError, match="the start of homing by method"):
                drive.home(method)
            assert node.state != ENABLED


def test_a_move_is_over_only_where_it_ends() -> None:
    """The drive reports its target as reached and stands still."""
    with booted() as (drive, _):
        drive.move_to(0.0)
    with booted() as (drive, node):
        with pytest.raises(TransitionError, match="arrival at 5 deg did not occur"):
            drive.move_to(5.0)
        assert node.state != ENABLED


def test_a_drive_that_restarts_under_power_is_switched_off_first() -> None:
    with booted() as (drive, node):
        drive.enable(Mode.PP)
        node.ways = Ways(keeps_power=True, starts_itself=True)
        resets: list[int] = []
        restart = node.restart

        def reset(**how: bool) -> None:
            resets.append(node.state)
            restart(**how)

        node.restart = reset  # type: ignore[method-assign]
        drive.boot()
        assert resets == [OFF]


@pytest.mark.parametrize("recovers", [False, True])
@pytest.mark.parametrize("frame", [0x080, 0x201, 0x77F])
def test_bus_off_on_the_bench_leaves_no_motion(frame: int, recovers: bool) -> None:
    axis, channel, clock = article_axis(1), str(uuid4()), VirtualClock()
    node = RudeDrive(channel, axis, clock)
    clock.nodes.append(node)
    with SpoiltBus(channel, clock) as bus:
        bus.private, bus.channel_info = True, "socketcan channel 'can0'"

        def interrupted() -> bool:
            if node.motor_counts > 1000 and bus.unsent is None:
                bus.bus_off_at = frame
            return False

        def step() -> None:
            with Drive(bus, axis, clock) as drive:
                drive.boot()
                Bench(drive, interrupted=interrupted).run(Stepping(count=4, step_deg=400.0))

        with pytest.raises(SafetyStop, match="bus-off"):
            step()
        if recovers:
            bus.recover()
        clock.sleep_until(clock.now() + 0.5)
        stopped = node.motor_counts
        clock.sleep_until(clock.now() + 0.5)
        assert node.motor_counts == stopped > 1000
        assert node.state != ENABLED
        assert node.powered == 1
    node.close()


def test_a_drive_that_is_not_enabled_in_time_has_no_power_on_the_bench() -> None:
    with booted(ignores_enable=True) as (drive, node):
        bench = Bench(drive)
        with pytest.raises(TransitionError, match="did not reach"):
            bench.run(Stepping())
        assert node.state == OFF
        node.ways.ignores_enable = False
        for _ in range(20):
            bench.cycle.exchange()
        assert node.powered == 0
