"""The master and the simulated drive, which share no code, over real frames in lockstep."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from hdbridge.axis import AxisConfig
from hdbridge.drive import Drive, Mode, State
from hdbridge.errors import DriveError, InputError
from hdbridge.sim.lockstep import simulated_bench

PROFILE = Path(__file__).parents[2] / "profiles" / "article"


class Exchange:
    """The smallest cycle: SYNC, the TPDOs, a set-point, a heartbeat now and then. No supervision."""

    def __init__(self, drive: Drive, clock: Any) -> None:
        self.drive, self.clock = drive, clock
        self.due_s = clock.now()
        self.heartbeat_due_s = 0.0

    def __call__(self, target_counts: int | None = None, cycles: int = 1) -> None:
        image, link = self.drive.image, self.drive.link
        for _ in range(cycles):
            self.due_s += self.drive.axis.drive.cycle_s
            self.clock.sleep_until(self.due_s)
            link.send(image.sync_id, b"")
            waited = set(image.tpdo_ids)
            while waited and (frame := link.recv(self.due_s + 0.002)) is not None:
                if image.accept(frame.can_id, frame.data):
                    waited.discard(frame.can_id)
                else:
                    self.drive.monitor.dispatch(frame)
            assert not waited
            idle = target_counts is None
            for frame in image.pack_rpdo_idle() if idle else image.pack_rpdo(target_counts):
                link.send(*frame)
            if self.clock.now() >= self.heartbeat_due_s:
                link.send(image.heartbeat_id, b"\x05")
                self.heartbeat_due_s = self.clock.now() + image.heartbeat_period_s


@pytest.fixture
def axis() -> AxisConfig:
    return AxisConfig.load(PROFILE)


@pytest.fixture
def bench(axis: AxisConfig) -> Iterator[tuple[can.BusABC, Any]]:
    with simulated_bench(PROFILE / "truth.yaml", axis.eds_path, axis.drive.node_id, seed=1) as (
        bus,
        clock,
        _,
    ):
        yield bus, clock


@pytest.fixture
def drive(bench: tuple[can.BusABC, Any], axis: AxisConfig) -> Iterator[Drive]:
    bus, clock = bench
    with Drive(bus, axis, clock) as drive:
        drive.boot()
        yield drive


def state_of(drive: Drive) -> State:
    return drive.image.power.observe(drive.sdo.read(0x6041))


def test_it_boots_as_the_axis_file_says(drive: Drive) -> None:
    assert drive.report is not None
    assert drive.report.state is State.SWITCH_ON_DISABLED
    assert drive.report.modes == (Mode.PP, Mode.HM, Mode.IP, Mode.CSP)
    assert drive.report.notes == ()
    assert drive.monitor.nodes[1].boot_ups == 1


def test_profile_moves_and_homing(drive: Drive) -> None:
    start = drive.home(35, 2.0, 1.0)
    assert start.motor_counts == pytest.approx(0, abs=1)
    for target_deg in (1.0, -0.5):
        positions = drive.move_to(target_deg)
        assert positions.motor_deg == pytest.approx(target_deg * 50, abs=0.1)
        assert positions.load_deg == pytest.approx(target_deg, abs=0.05)
    drive.disable()
    assert state_of(drive) is State.SWITCH_ON_DISABLED


def test_an_enabled_drive_stays_so_while_the_master_waits_and_stops_while_it_sleeps(
    drive: Drive, bench: tuple[can.BusABC, Any]
) -> None:
    drive.move_to(0.2)
    drive.wait(1.0)
    assert state_of(drive) is State.OPERATION_ENABLED
    drive.move_to(0.1)
    bench[1].sleep_until(bench[1].now() + 0.2)
    assert state_of(drive) is not State.OPERATION_ENABLED


def test_csp_by_pdo(drive: Drive, bench: tuple[can.BusABC, Any]) -> None:
    drive.enable()
    exchange = Exchange(drive, bench[1])
    image = drive.image
    here = image.motor_counts
    exchange(cycles=12)
    assert image.power.state is State.OPERATION_ENABLED
    assert image.motor_counts == pytest.approx(here, abs=2)
    for step in range(1, 101):
        exchange(here + 10 * step)
    exchange(here + 1000, cycles=30)
    assert image.motor_counts == pytest.approx(here + 1000, abs=5)
    assert image.load_counts == pytest.approx((here + 1000) * 7.2, abs=400)
    image.power.quick_stop()
    exchange(here + 1000, cycles=30)
    assert image.power.state is State.SWITCH_ON_DISABLED
    assert drive.monitor.nodes[1].emergency_count == 0


def test_a_master_that_falls_silent_stops_the_drive_and_comes_back_to_it_disabled(
    drive: Drive, bench: tuple[can.BusABC, Any], axis: AxisConfig
) -> None:
    bus, clock = bench
    drive.enable()
    exchange = Exchange(drive, clock)
    exchange(cycles=12)
    assert drive.image.power.state is State.OPERATION_ENABLED
    clock.sleep_until(clock.now() + 0.1)
    assert state_of(drive) is not State.OPERATION_ENABLED
    with Drive(bus, axis, clock) as again:
        again.boot()
        if state_of(again) is State.FAULT:
            again.fault_reset()
        assert state_of(again) is State.SWITCH_ON_DISABLED
        again.move_to(0.2)


def test_a_following_error_is_a_fault_that_a_reset_clears(
    drive: Drive, bench: tuple[can.BusABC, Any]
) -> None:
    # So narrow that the lag at full speed is beyond it.
    drive.sdo.write(0x6065, 0, 10)
    drive.enable()
    exchange = Exchange(drive, bench[1])
    exchange(cycles=12)
    exchange(drive.image.motor_counts + 20_000, cycles=60)
    assert drive.image.power.state in (State.FAULT, State.FAULT_REACTION_ACTIVE)
    assert drive.monitor.nodes[1].last_error is not None
    exchange(cycles=100)
    assert drive.image.power.state is State.FAULT
    with pytest.raises(DriveError, match="fault before it was enabled"):
        drive.enable(Mode.PP)
    drive.fault_reset()
    assert state_of(drive) is State.SWITCH_ON_DISABLED


def test_what_is_no_target_never_moves_the_axis(drive: Drive, bench: tuple[can.BusABC, Any]) -> None:
    drive.enable(Mode.PP)
    before = drive.read_positions().motor_counts
    for target_deg in (float("nan"), float("inf"), 401.0):
        with pytest.raises(InputError):
            drive.move_to(target_deg)
    bench[1].sleep_until(bench[1].now() + 0.5)
    assert drive.read_positions().motor_counts == pytest.approx(before, abs=1)


def test_leaving_the_block_leaves_it_disabled(bench: tuple[can.BusABC, Any], axis: AxisConfig) -> None:
    bus, clock = bench
    with Drive(bus, axis, clock) as drive:
        drive.boot()
        drive.enable()
        Exchange(drive, clock)(cycles=12)
        assert drive.image.power.state is State.OPERATION_ENABLED
    assert state_of(drive) is State.SWITCH_ON_DISABLED
    assert drive.monitor.nodes[1].last_error is None
    # And a second session finds nothing to complain about.
    clock.sleep_until(clock.now() + 1.0)
    with Drive(bus, axis, clock) as again:
        assert again.boot().state is State.SWITCH_ON_DISABLED
        again.move_to(0.1)


def test_an_absent_node_is_told_with_who_is_there(bench: tuple[can.BusABC, Any], axis: AxisConfig) -> None:
    bus, clock = bench
    other = AxisConfig.model_validate(
        {**axis.model_dump(by_alias=True), "drive": {**axis.drive.model_dump(), "node_id": 9}}
    )
    drive = Drive(bus, other, clock, Drive(bus, axis, clock).sdo.od)
    started_s = clock.now()
    with pytest.raises(DriveError, match=r"node 9 on .* does not answer"), drive:
        drive.boot()
    assert clock.now() - started_s < 6.0
