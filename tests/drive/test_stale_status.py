"""A status from before a command is not taken for its answer, on drives that show it for a while."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.exercised import booted

from hdbridge.axis import AxisConfig
from hdbridge.device.behaviour import Behaviour
from hdbridge.device.node import DriveNode
from hdbridge.drive import Drive, Mode, State
from hdbridge.errors import DriveError, TransitionError
from hdbridge.sim.truth import Truth

PROFILE = Path(__file__).parents[2] / "profiles" / "article"
AXIS = AxisConfig.load(PROFILE)
DELAYS_MS = (0.0, 8.0, 50.0)


@contextmanager
def drive_that_shows_late(delay_ms: float) -> Iterator[tuple[Drive, DriveNode]]:
    truth = Truth.load(PROFILE).model_copy(update={"firmware": Behaviour(status_delay_ms=delay_ms)})
    with booted(AXIS, truth) as (drive, node):
        yield drive, node


@pytest.mark.parametrize("delay_ms", DELAYS_MS)
@pytest.mark.parametrize("first", [35, 34])
def test_repeated_homing_ends_only_when_complete(delay_ms: float, first: int) -> None:
    with drive_that_shows_late(delay_ms) as (drive, node):
        drive.home(first, 2.0, 1.0)
        away = drive.move_to(0.5)
        for method, turns in ((34, 1), (33, -1), (34, 1)):
            before = node.firmware.motion.motor_counts
            homed = drive.home(method, 2.0, 1.0)
            assert homed.motor_counts == pytest.approx(0, abs=1)
            moved = node.firmware.motion.motor_counts - before
            assert 0 < moved * turns <= 8000, "to the next index pulse in the direction of the method"
        assert away.motor_counts != 0


@pytest.mark.parametrize("delay_ms", DELAYS_MS)
def test_immediately_finished_homing_is_noticed(delay_ms: float) -> None:
    with drive_that_shows_late(delay_ms) as (drive, _):
        for place_deg in (0.3, 0.6):
            drive.move_to(place_deg)
            drive.home(37, 2.0, 1.0)
            assert drive.home(35, 2.0, 1.0).motor_counts == pytest.approx(0, abs=1)


@pytest.mark.parametrize("delay_ms", DELAYS_MS)
def test_an_error_of_the_previous_homing_is_ignored(delay_ms: float) -> None:
    with drive_that_shows_late(delay_ms) as (drive, node):
        drive.enable(Mode.HM)
        node.firmware._modes[6]._failed = True  # type: ignore[attr-defined]
        assert drive.home(34, 2.0, 1.0).motor_counts == pytest.approx(0, abs=1)


@settings(max_examples=15)
@given(
    st.sampled_from(DELAYS_MS),
    st.lists(st.floats(-2.0, 2.0).map(lambda deg: round(deg, 3)), min_size=1, max_size=4),
)
def test_a_move_ends_only_on_arrival(delay_ms: float, places_deg: list[float]) -> None:
    with drive_that_shows_late(delay_ms) as (drive, _):
        for place_deg in (*places_deg, places_deg[-1]):
            assert drive.move_to(place_deg).motor_deg == pytest.approx(50.0 * place_deg, abs=0.1)


def test_a_drive_that_has_always_reached_its_target_has_not_arrived() -> None:
    with drive_that_shows_late(0.0) as (drive, node):
        node.dictionary[0x6041, 0].bind(lambda: node.firmware.statusword() | 0x0400)
        assert drive.move_to(0.0).motor_counts == pytest.approx(0, abs=2)
        with pytest.raises(TransitionError, match="the start of moving to 30 deg"):
            drive.move_to(30.0)
        assert drive.state() is not State.OPERATION_ENABLED


@pytest.mark.parametrize("delay_ms", DELAYS_MS)
def test_power_and_modes_are_the_current_ones(delay_ms: float) -> None:
    with drive_that_shows_late(delay_ms) as (drive, node):
        for mode in (Mode.PP, Mode.HM, Mode.PP):
            drive.enable(mode)
            assert node.firmware._mode.number == mode
            assert node.firmware.state.name == "OPERATION_ENABLED"
            drive.disable()
            assert node.firmware.state.name == "SWITCH_ON_DISABLED"
        node.faults.raise_error(0x3210)
        drive.wait(0.1)
        drive.fault_reset()
        assert drive.state() is State.SWITCH_ON_DISABLED
        drive.enable(Mode.PP)


def test_an_enabled_drive_stays_so_while_the_master_waits_and_stops_while_it_sleeps() -> None:
    with drive_that_shows_late(0.0) as (drive, _):
        drive.move_to(0.2)
        drive.wait(1.0)
        assert drive.state() is State.OPERATION_ENABLED
        drive.link.clock.sleep_until(drive.link.clock.now() + 0.2)
        assert drive.state() is not State.OPERATION_ENABLED


@pytest.mark.parametrize("delay_ms", DELAYS_MS)
def test_a_drive_that_stops_in_a_move_is_not_set_in_motion_again(delay_ms: float) -> None:
    holding = AXIS.model_copy(update={"drive": AXIS.drive.model_copy(update={"quick_stop_option": 6})})
    truth = Truth.load(PROFILE).model_copy(update={"firmware": Behaviour(status_delay_ms=delay_ms)})
    with booted(holding, truth) as (drive, node):
        clock = drive.link.clock
        drive.enable(Mode.PP)
        moving = node.firmware._mode
        step = moving.step

        def stops_on_the_way(period_s: float) -> tuple[float, float]:
            if node.firmware.motion.motor_counts > 4000:
                node.faults.lose_master(0x8130)
            return step(period_s)

        moving.step = stops_on_the_way  # type: ignore[method-assign]
        with pytest.raises(DriveError, match="left 'operation enabled' moving to 30 deg"):
            drive.move_to(30.0)
        clock.sleep_until(clock.now() + 0.5)
        assert abs(node.firmware.motion.motor_counts) < 12000
