"""A PLC-like master on the outer bus moves the load to its targets, and only on request."""

import errno
import shutil
import struct
from dataclasses import replace

import numpy as np
import pytest
from support.daemon import PROFILE
from support.gateway import COUNTS_PER_DEG, NODE, swing
from support.raised import without_load_encoder

from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.daemon.gateway.objects import rest_deg
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.memory import Cell, CommandKind
from hdbridge.motion import MotionMode

STATE, ENABLED, FAULT, OFF = 0x6F, 0x27, 0x08, 0x40


async def stands(bench, duration_s=0.3, within_deg=0.003):
    """Checks that the load does not move, whatever the PLC sends meanwhile."""
    place = bench.load_deg
    for _ in range(round(duration_s / 0.02)):
        await bench.wait(0.02)
        assert abs(bench.load_deg - place) < within_deg


async def faulted(bench, *codes, within_s=1.0):
    """Checks that the outer side reports FAULT with one of these codes, and that the drive then has no
    power.
    """
    plc = bench.plc
    await bench.until(lambda: plc.statusword & 0x4F == FAULT, within_s)
    assert set(plc.emergencies) & set(codes), [hex(each) for each in plc.emergencies]
    await bench.until(lambda: bench.daemon.nodes[0].firmware.state.name != "OPERATION_ENABLED", 2.0)


async def reset(bench):
    """Resets the fault by an edge, then requests motion."""
    plc = bench.plc
    plc.plan = lambda cycle: None
    plc.controlword = 0
    await bench.wait(0.05)
    plc.controlword = 0x80
    await bench.until(lambda: plc.statusword & STATE | 0x20 == OFF | 0x20, 5.0)
    await stands(bench, 0.1)
    await go(bench)


async def go(bench):
    """Leads the node to operation enabled, then requests motion."""
    bench.plc.plan = lambda cycle: None
    bench.plc.emergencies.clear()
    await bench.wait(1.0)  # meanwhile the inner drive is prepared again
    await bench.enable()
    await swing(bench)
    await bench.wait(0.5)
    assert bench.plc.statusword & STATE == ENABLED
    assert bench.plc.emergencies == []


@pytest.mark.parametrize(
    "bench",
    [
        {"period_s": 1e-3 * period_ms, "drift_ppm": drift_ppm}
        for period_ms, drift_ppm in ((1, 200), (2, -200), (4, 0), (5, 200), (20, -200))
    ],
    indirect=True,
)
async def test_the_set_point_is_that_of_a_drive_one_cycle_later(bench):
    """No set-point is lost, at any outer cycle and with 200 ppm of drift."""
    answered_s = await bench.enable()
    assert answered_s < 0.3  # python-canopen waits for 0.4 s
    plc = bench.plc
    await swing(bench)
    await bench.wait(0.5)
    reader = bench.daemon.memory.reader()
    await bench.wait(4.0)
    samples, lost = reader.read()
    assert not lost
    assert plc.emergencies == []
    # CiA 402: each target is reached one outer period after its SYNC, linearly.
    times = np.array([time_s for time_s, *_ in plc.seen]) + plc.period_s
    targets = np.array([target for *_, target in plc.seen]) / COUNTS_PER_DEG
    at = 1e-9 * samples["time_ns"]
    expected = np.interp(at - bench.daemon.period_s, times, targets)
    error = samples["axes"][:, 0]["load_target_deg"] - expected
    inside = at < times[-1]
    assert np.max(np.abs(error[inside])) < 0.5 / COUNTS_PER_DEG + 2e-6


async def test_the_load_reaches_the_masters_target(bench):
    await bench.enable()
    await stands(bench, within_deg=0.05)  # the correction is faded in
    plc, begun, start = bench.plc, bench.plc.cycle, bench.plc.target
    plc.plan = lambda cycle: start + round(COUNTS_PER_DEG * min(0.02 * (cycle - begun), 3.0))
    await bench.wait(3.0)
    assert plc.statusword & STATE == ENABLED
    assert not plc.emergencies
    wanted_deg = plc.target / COUNTS_PER_DEG
    assert bench.load_deg == pytest.approx(wanted_deg, abs=10 / 3600)
    assert plc.position / COUNTS_PER_DEG == pytest.approx(wanted_deg, abs=10 / 3600)
    assert abs(await bench.read(0x2200, 1, signed=True)) < 1000
    assert await bench.read(0x2200, 5) & 1
    plc.controlword = 0
    await bench.until(lambda: bench.daemon.states[0].name == "DISABLED")
    assert plc.statusword & 0x4F == OFF


async def test_the_state_of_the_axis_has_period_and_jitter_of_the_outer_sync(bench):
    bench.plc.begin()
    await bench.wait(1.0)
    outer = bench.bridge.axes["axis1"].state().outer
    assert (outer.node_id, outer.nmt) == (NODE, 5)
    assert outer.period_s == pytest.approx(bench.plc.period_s, rel=1e-6)
    assert outer.jitter_s < 1e-6
    bench.plc.late_s = lambda cycle: 0.001 * (cycle % 2)
    await bench.wait(1.0)
    outer = bench.bridge.axes["axis1"].state().outer
    assert outer.jitter_s == pytest.approx(0.0005, rel=0.2)  # relative to the mean of early and late SYNCs
    bench.plc.cycling = False
    await bench.wait(0.5)
    outer = bench.bridge.axes["axis1"].state().outer
    assert (outer.period_s, outer.jitter_s) == (None, None)


async def test_a_jump_of_the_target_stays_within_the_limits(bench):
    await bench.enable()
    reader = bench.daemon.memory.reader()
    bench.plc.target += round(3.0 * COUNTS_PER_DEG)
    await bench.wait(1.0)
    samples, _ = reader.read()
    target = samples["axes"][:, 0]["load_target_deg"]
    speed = np.diff(target) / bench.daemon.period_s
    limits = bench.daemon.axes[0].config.limits
    assert np.max(np.abs(speed)) <= limits.velocity_deg_s * 1.001
    assert np.max(np.abs(np.diff(speed))) <= 2.001 * limits.acceleration_deg_s2 * bench.daemon.period_s
    assert target[-1] == pytest.approx(bench.plc.target / COUNTS_PER_DEG, abs=1e-6)


@pytest.mark.parametrize(
    ("happens", "codes"),
    [
        (lambda daemon: daemon.nodes[0].faults.raise_error(0x4310), (0xFF00,)),
        (lambda daemon: daemon.nodes[0].faults.boot_up(), (0x7500,)),
        (lambda daemon: setattr(daemon.nodes[0].faults, "drop_tpdos", 12), (0x7500,)),
        (lambda daemon: setattr(daemon.nodes[0].faults, "load_jump_counts", 100_000), (0x7305,)),
        (lambda daemon: setattr(daemon.bus, "down", errno.ENETDOWN), (0x7500,)),
        (lambda daemon: daemon.post(CommandKind.QUICK_STOP), (0xFF03,)),
        (lambda daemon: daemon.hang(0.6), (0x6010, 0x7500)),
    ],
    ids=[
        "drive fault",
        "drive restarts",
        "no TPDOs",
        "encoder jumps",
        "bus down",
        "quick stop",
        "loop stalls",
    ],
)
async def test_inner_failures_are_outer_faults_until_reset(bench, happens, codes):
    plc = bench.plc
    await bench.enable()
    await swing(bench)
    await bench.wait(0.6)
    happens(bench.daemon)
    await faulted(bench, *codes)
    bench.daemon.bus.down = None
    await bench.wait(1.0)
    bench.daemon.nodes[0].faults.load_jump_counts = 0
    await stands(bench)  # the PLC still sends 000Fh and its targets
    assert await bench.read(0x603F) in codes
    assert await bench.read(0x1001) & 1
    plc.controlword = 0x8F
    await bench.until(lambda: plc.statusword & 0x4F == OFF, 6.0)
    await stands(bench)  # and holds the fault reset high
    plc.controlword = 0x0F
    await stands(bench)
    assert plc.statusword & STATE != ENABLED
    await go(bench)


@pytest.mark.parametrize("bench", [{"period_s": 0.01}], indirect=True)
async def test_a_lost_sync_is_the_cause_even_if_the_set_points_end_before_it_is_overdue(bench):
    await bench.enable()
    await swing(bench)
    await bench.wait(0.6)
    bench.plc.cycling = False
    nodes, process = bench.daemon.clock.nodes, bench._process
    nodes.remove(process)  # the gateway process gets no processor time
    await bench.until(lambda: bench.daemon.states[0].name == "STOPPING")
    nodes.append(process)
    assert await bench.read(0x603F) == 0x8700
    assert bench.plc.emergencies == [0x8700]
    assert bench.bridge.axes["axis1"].state().outer.error.startswith("8700h: SYNC ")


async def test_a_fault_of_the_gateway_is_reported_once_with_its_cause_and_recorded(bench):
    kept: list[tuple[str, str]] = []
    bench.bridge.core.log.record = lambda kind, text: kept.append((kind, text))
    await bench.enable()
    await swing(bench)
    await bench.wait(0.6)
    status = bench.daemon.memory.status
    pid = status[Cell.LOOP_PID]
    status[Cell.LOOP_PID] = 0  # as the keeper does when the control process has died
    await faulted(bench, 0x6010)
    status[Cell.LOOP_PID] = pid
    await bench.wait(0.2)
    notes = [each.text for each in bench.bridge.events().events if each.kind == "note"]
    assert notes[1:] == [fault := "gateway fault 6010h: the control process is dead, hung or late"]
    assert kept == [("MARK", f"axis1: {fault}")]


async def test_a_client_takes_the_axis_by_force_and_returns_it(bench):
    async def faulted_by_a_client(bench):
        await bench.until(lambda: bench.plc.statusword & 0x4F == FAULT, 1.0)
        assert 0xFF01 in bench.plc.emergencies

    plc, bridge = bench.plc, bench.bridge
    await bench.enable()
    await swing(bench)
    await bench.wait(0.6)
    token = bridge.lease.take("a person", force=True)
    await faulted_by_a_client(bench)
    await bridge.axes["axis1"].motion.move(token, 1.0)
    await stands(bench)
    assert bench.load_deg == pytest.approx(1.0, abs=0.01)
    plc.controlword = 0
    await bench.wait(0.05)
    plc.controlword = 0x80
    await bench.wait(0.5)
    plc.controlword = 0x06
    await bench.wait(0.1)
    plc.controlword = 0x0F
    await stands(bench)
    assert plc.statusword & STATE != ENABLED
    await bridge.axes["axis1"].disable(token)
    bridge.lease.release(token)
    await reset(bench)


async def test_early_targets_and_mode_changes_do_not_move_the_axis(bench):
    plc = bench.plc
    await bench.write(0x6060, 0, 1, 1)
    await bench.enable()
    await bench.wait(0.6)
    plc.sends_targets = False
    await bench.write(0x607A, 0, plc.target + 200_000, 4)
    await stands(bench)  # profile position without a new set-point
    await bench.write(0x6060, 0, 8, 1)
    await stands(bench)
    await bench.write(0x6060, 0, 6, 1)
    await stands(bench)
    await bench.write(0x607A, 0, plc.target - 200_000, 4)
    await bench.write(0x6060, 0, 1, 1)
    await stands(bench)
    await bench.write(0x607A, 0, plc.target - 200_000, 4)
    await stands(bench)
    await bench.write(0x6040, 0, 0x1F, 2)
    await bench.wait(0.02)
    await bench.write(0x6040, 0, 0x1F, 2)  # no edge
    await bench.wait(2.0)
    assert bench.load_deg == pytest.approx((plc.target - 200_000) / COUNTS_PER_DEG, abs=0.01)
    assert bench.gateway.nodes["axis1"].firmware.statusword() & 0x1400 == 0x1400


async def test_target_reached_means_that_the_load_rests_there(bench):
    """The window is the capability of the axis, so the load stays within it from then on."""
    plc = bench.plc
    await bench.write(0x6060, 0, 1, 1)
    await bench.enable()
    await bench.wait(0.6)
    plc.sends_targets = False
    goal = plc.target + 200_000
    await bench.write(0x607A, 0, goal, 4)
    await bench.write(0x6040, 0, 0x1F, 2)
    await bench.until(lambda: not plc.statusword & 0x400, 1.0)
    await bench.until(lambda: plc.statusword & 0x400 != 0)
    window = await bench.read(0x6067)
    axis = bench.service.machine.axes[0].config
    count = abs(axis.motor_encoder.degrees(1)) / axis.gear.ratio * COUNTS_PER_DEG
    assert count < window < 2.0 * count  # the model is exact, so only the motor's count and rounding remain
    for _ in range(50):
        assert abs(bench.load_deg * COUNTS_PER_DEG - goal) < window + 0.5 * count
        assert plc.statusword & 0x400
        await bench.wait(0.01)


@pytest.mark.parametrize(
    ("held_out", "arcsec"),
    [
        ({"after_arcsec": 4.0}, 3.24 + 12.32),
        ({"after_arcsec": None}, 3.24 + 2.83),
        ("too short", 3.24 + 2.83),
        (None, 3.24 + 300.0),
    ],
)
def test_the_position_window_grows_with_the_residual_of_the_model(held_out, arcsec):
    axis = AxisConfig.load(PROFILE)
    model = TransmissionModel.load(PROFILE / "model.yaml")
    model = replace(model, provenance={"held_out": held_out}) if held_out else model.only(())
    assert 3600.0 * rest_deg(axis, model) == pytest.approx(arcsec, abs=0.01)


async def test_homing_makes_the_present_position_zero(bench):
    plc = bench.plc
    await bench.write(0x6060, 0, 6, 1)
    await bench.write(0x6098, 0, 37, 1)
    await bench.enable()
    await bench.wait(0.6)
    await bench.write(0x607C, 0, 36_000, 4)
    plc.controlword = 0x1F
    await bench.until(lambda: plc.statusword & 0x1400 == 0x1400)
    assert abs(await bench.read(0x6064, signed=True) - 36_000) < 500
    answer = await bench.sdo(struct.pack("<BHBb3x", 0x2F, 0x6098, 0, 33))
    assert answer[0] == 0x80  # there is no index pulse at the load


async def test_power_that_the_inner_drive_refuses_is_a_fault_until_it_is_reset(bench):
    plc = bench.plc
    bench.daemon.nodes[0].faults.raise_error(0x4310)  # without power, so the loop does not stop anything
    await bench.wait(0.5)
    plc.begin()
    for word in (0x06, 0x07, 0x0F):
        plc.controlword = word
        await bench.wait(0.05)
    await bench.until(lambda: plc.statusword & 0x4F == FAULT, 6.0)
    assert set(plc.emergencies) <= {0xFF02, 0xFF00}
    assert plc.emergencies
    await reset(bench)


def nmt_stop(bench):
    bench.plc.send(0, bytes((2, NODE)))


def disable_voltage(bench):
    bench.plc.controlword = 0x00


def lost_sync(bench):
    bench.plc.cycling = False


def client_by_force(bench):
    bench.bridge.lease.take("a person", force=True)


def client_for_a_moment(bench):
    """A client takes the lease by force and releases it before the service notices."""
    lease = bench.bridge.lease
    lease.release(lease.take("a person", force=True))


async def test_a_client_that_takes_the_axis_for_a_moment_ends_the_motion_of_the_gateway(bench):
    await bench.enable()
    await swing(bench)
    await bench.wait(0.6)
    client_for_a_moment(bench)
    await faulted(bench, 0xFF01)
    await stands(bench)
    await reset(bench)


@pytest.mark.parametrize("seen", ["ENABLING", "ENABLED"])
@pytest.mark.parametrize(
    "withdraw", [nmt_stop, disable_voltage, lost_sync, client_by_force, client_for_a_moment]
)
async def test_a_withdrawn_power_request_is_not_executed(bench, withdraw, seen):
    plc = bench.plc
    plc.begin()
    for word, bits in ((0x06, 0x21), (0x07, 0x23)):
        plc.controlword = word
        await bench.until(lambda bits=bits: plc.statusword & STATE == bits)
    reader = bench.daemon.memory.reader()
    plc.controlword = 0x0F
    plc.target += round(COUNTS_PER_DEG)
    await bench.until(lambda: bench.daemon.states[0].name == seen)
    withdraw(bench)
    await bench.wait(1.0)
    axis = reader.read()[0]["axes"][:, 0]
    if seen == "ENABLING":
        assert not any(axis["mode"] == MotionMode.FOLLOW)
    driven = axis["load_target_deg"][axis["state"] == AxisState.ENABLED]
    assert np.ptp(driven) < 0.01  # the target begins at the load encoder; 1 degree was requested
    await stands(bench)
    if withdraw is not client_by_force:  # the current holder withdraws, at rest
        assert bench.daemon.states[0].name == "DISABLED"


async def both_enabled(bench):
    """Configures and enables two axes with one SYNC, each by its own master, and moves both to and fro."""
    for plc in reversed(bench.plcs):
        bench.plc = plc
        await bench.configure()
    for plc in bench.plcs:
        plc.begin()
    for plc in bench.plcs:
        bench.plc = plc
        await bench.enable()
        await swing(bench)


def load_of(bench, axis):
    return float(bench.daemon.nodes[axis].firmware.motion.machine.load_reading) / 2_880_000 * 360.0


@pytest.mark.parametrize("bench", [{"axes": 2}], indirect=True)
async def test_each_axis_is_a_node_of_its_own_and_follows_its_own_targets(bench):
    await both_enabled(bench)
    first, second = bench.plcs
    second.plan = lambda cycle: second.target  # the second axis stands still
    place, swung = load_of(bench, 1), []
    for _ in range(40):
        await bench.wait(0.05)
        swung.append(load_of(bench, 0))
        assert abs(load_of(bench, 1) - place) < 0.02
    assert max(swung) - min(swung) > 1.9
    assert [plc.statusword & STATE for plc in bench.plcs] == [ENABLED, ENABLED]
    assert (first.emergencies, second.emergencies) == ([], [])


@pytest.mark.parametrize("bench", [{"axes": 2}], indirect=True)
async def test_a_fault_of_one_axis_leaves_the_other_in_motion(bench):
    await both_enabled(bench)
    first, second = bench.plcs
    bench.daemon.nodes[1].faults.raise_error(0x4310)
    await bench.until(lambda: second.statusword & 0x4F == FAULT, 1.0)
    assert second.emergencies == [0xFF00]
    swung = []
    for _ in range(40):
        await bench.wait(0.05)
        swung.append(load_of(bench, 0))
    assert max(swung) - min(swung) > 1.9
    assert first.statusword & STATE == ENABLED
    assert first.emergencies == []
    second.send(0, bytes((2, second.node)))  # an NMT stop of one node does not affect the other
    await bench.wait(0.2)
    assert first.statusword & STATE == ENABLED


@pytest.mark.parametrize(
    "bench",
    [lambda folder: {"profile": without_load_encoder(shutil.copytree(PROFILE, folder / "profile"))}],
    indirect=True,
    ids=["blind"],
)
async def test_without_a_load_encoder_it_reports_the_predicted_load_angle(bench):
    await bench.enable()
    await swing(bench, amplitude_deg=10.0)
    await bench.wait(3.0)
    bench.plc.plan = lambda cycle: None
    await bench.wait(0.5)
    await stands(bench)
    off_deg = bench.plc.position / COUNTS_PER_DEG - bench.load_deg
    assert abs(off_deg * 3600.0) < 5.0  # the motor's angle alone would be off by 40 arcsec
