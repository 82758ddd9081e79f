"""An axis from unknown to moving and back, by commands through the memory and frames on the bus."""

import struct
from functools import partial

import numpy as np
import pytest
from support.bare_axis import truth
from support.daemon import PROFILE, SteppedDaemon, article_axes, stepped_daemon
from support.torque import check_torque, directed

from hdbridge.axis.model import TransmissionModel
from hdbridge.daemon.loop.states import AxisState
from hdbridge.daemon.machinefile import LoadLoopSettings
from hdbridge.daemon.memory import CommandKind, EventKind, Knot, SampleFlag
from hdbridge.drive.states import State
from hdbridge.enums import Scheme
from hdbridge.motion import MotionMode
from hdbridge.records.record import Record

S, K, E = AxisState, CommandKind, EventKind


def record(daemon: SteppedDaemon, axis: int = 0) -> np.ndarray:
    """Returns the axis's samples since the last call."""
    samples, lost = daemon.samples.read()
    assert lost == 0
    return samples["axes"][:, axis]


def rpdos(daemon: SteppedDaemon, node: int = 1) -> list[tuple[int, int]]:
    """Controlwords and targets that are sent from now on."""
    found: list[tuple[int, int]] = []
    daemon.bus.spy = lambda can_id, data: (
        found.append(struct.unpack("<Hi", data)) if can_id == 0x200 + node else None
    )
    return found


def test_nothing_is_sent_to_a_drive_that_is_not_verified(daemon: SteppedDaemon) -> None:
    sent = rpdos(daemon)
    daemon.run(0.5)
    assert sent == []
    assert daemon.states == [S.UNVERIFIED]
    for kind in (K.ENABLE, K.HOME, K.MOVE, K.DISABLE):
        answer = daemon.order(kind)
        assert answer.kind is E.REFUSED
        assert "has to be booted and verified first" in answer.text
    assert sent == []


def test_a_verified_axis_is_idle_at_its_position(daemon: SteppedDaemon) -> None:
    daemon.verify()
    sent = rpdos(daemon)
    daemon.run(0.2)
    assert daemon.states == [S.DISABLED]
    place = daemon.motor_counts()
    assert all(word == 0 and abs(target - place) <= 2 for word, target in sent)
    assert len(sent) == 50


def test_enabling_moves_nothing_and_a_move_arrives(daemon: SteppedDaemon) -> None:
    daemon.verify()
    sent = rpdos(daemon)
    daemon.enable()
    daemon.run(1.0)
    # Except for the compensation, which is faded in.
    assert max(abs(target - sent[0][1]) for _, target in sent) < 8000 * 50 * 300 / 3600 / 360
    record(daemon)
    id_ = daemon.move(12.5)
    daemon.until(lambda: daemon.ended(id_))
    daemon.run(0.2)
    moved = record(daemon)
    assert moved["load_target_deg"][-1] == 12.5
    assert abs(moved["load_position_deg"][-1] - 12.5) < 0.005
    assert set(moved["state"]) == {S.ENABLED}
    assert {MotionMode.HOLD, MotionMode.GOTO} == set(moved["mode"])
    assert (moved["velocity_deg_s"] <= 20.0 * (1 + 1e-9)).all()
    (end,) = [each for each in daemon.reported(E.MOTION_ENDED) if each.id == id_]
    assert end.code == MotionMode.GOTO


def test_samples_hold_the_sent_target_and_the_model_error(enabled: SteppedDaemon) -> None:
    enabled.run(1.0)
    sent = rpdos(enabled)
    record(enabled)
    id_ = enabled.move(3.0)
    enabled.until(lambda: enabled.ended(id_))
    axis = record(enabled)
    counts = [target for _, target in sent]
    assert np.allclose(axis["issued_deg"], np.array(counts) * 360 / 8000)
    # The motor's target is N times the load's, less the correction, to half a count.
    wanted = 50 * (axis["load_target_deg"] - axis["correction_arcsec"] / 3600)
    assert np.abs(axis["issued_deg"] - wanted).max() <= 0.5 * 360 / 8000 + 1e-9
    assert np.ptp(axis["correction_arcsec"]) > 5.0
    assert np.allclose(axis["predicted_arcsec"], axis["correction_arcsec"], atol=1e-3)
    assert (axis["weight"] == 1.0).all()
    assert (axis["flags"] & SampleFlag.COMPENSATING).all()
    assert (axis["power"] == list(State).index(State.OPERATION_ENABLED)).all()
    assert np.isnan(axis["reading0"]).all()


def test_disabling_in_motion_brakes_first(enabled: SteppedDaemon) -> None:
    enabled.move(100.0)
    enabled.run(1.0)
    record(enabled)
    enabled.done(K.DISABLE)
    assert enabled.states == [S.DISABLED]
    axis = record(enabled)
    driven = axis[axis["state"] == S.STOPPING]
    assert np.abs(np.diff(driven["velocity_deg_s"])).max() <= 200.0 * 0.004 * (1 + 1e-6)
    assert axis["power"][-1] == list(State).index(State.SWITCH_ON_DISABLED)
    place = axis["load_position_deg"][-1]
    enabled.run(0.5)
    assert abs(record(enabled)["load_position_deg"][-1] - place) < 0.01


@pytest.mark.parametrize("statusword", [0x0008, 0x0027, 0x0000, -1, 1 << 40])
def test_enabling_from_anything_but_power_off_is_refused(daemon: SteppedDaemon, statusword: int) -> None:
    daemon.verify()
    answer = daemon.order(K.ENABLE, i=0, j=0, k=statusword)
    assert answer.kind is E.REFUSED
    assert daemon.states == [S.DISABLED]


def test_a_drive_that_does_not_enable_is_given_up(daemon: SteppedDaemon) -> None:
    daemon.verify()
    fields = daemon.prepare()
    node = daemon.nodes[0]
    handle = node.handle

    def deaf(message, now_s) -> None:
        if message.arbitration_id != 0x201:
            handle(message, now_s)

    node.handle = deaf
    answer = daemon.order(K.ENABLE, timeout_s=10.0, **fields)
    assert answer.kind is E.REFUSED
    assert "did not reach 'operation enabled'" in answer.text
    daemon.until(lambda: daemon.states == [S.DISABLED])


def test_a_lent_axis_is_quick_stopped_by_the_loop(daemon: SteppedDaemon) -> None:
    daemon.verify()
    daemon.done(K.HOME)
    drive = daemon.drive(0)
    from hdbridge.drive.objects import Mode

    drive.enable(Mode.PP)
    daemon.done(K.QUICK_STOP)
    assert daemon.states == [S.QUICK_STOPPED]
    daemon.run(0.5)
    assert daemon.axes[0].image.power.state is State.SWITCH_ON_DISABLED


def test_quick_stop_is_latched_until_reset(enabled: SteppedDaemon) -> None:
    enabled.move(100.0)
    enabled.run(1.0)
    enabled.done(K.QUICK_STOP, -1)
    assert enabled.states == [S.QUICK_STOPPED]
    sent = rpdos(enabled)
    enabled.turn(2)
    assert enabled.axes[0].image.power.state is State.QUICK_STOP_ACTIVE
    assert "still stopping" in enabled.order(K.RESET).text
    assert enabled.reported(E.STOPPED) == []
    enabled.run(1.0)
    assert {word for word, _ in sent} == {0x02, 0x00}
    assert {word for word, _ in sent[-20:]} == {0x00}, "the drive is off"
    (stopped,) = enabled.reported(E.STOPPED)
    assert "quick stop by command" in stopped.text
    for kind in (K.ENABLE, K.MOVE, K.VERIFIED, K.HOME):
        assert enabled.order(kind).kind is E.REFUSED
    enabled.done(K.RESET)
    enabled.until(lambda: enabled.states == [S.DISABLED])
    enabled.enable()
    id_ = enabled.move(0.0)
    enabled.until(lambda: enabled.ended(id_), 10.0)


def quintic(duration_s: float, travel_deg: float, step_s: float = 0.02) -> list[tuple[float, float, float]]:
    """Knots of a smooth move from rest to rest."""
    times = np.linspace(0.0, duration_s, round(duration_s / step_s) + 1)
    s = times / duration_s
    place = travel_deg * (10 * s**3 - 15 * s**4 + 6 * s**5)
    speed = travel_deg / duration_s * (30 * s**2 - 60 * s**3 + 30 * s**4)
    return [(float(t), float(p), float(v)) for t, p, v in zip(times, place, speed, strict=True)]


def test_knots_of_an_earlier_stream_are_discarded(enabled: SteppedDaemon) -> None:
    begin = enabled.axes[0].set_point.position_deg
    enabled.memory.knots[0].put([Knot(0, 0.0, 300.0, 0.0)] * 200)
    enabled.stream({0: [(t, begin + p, v) for t, p, v in quintic(0.4, 1.0)]}, timeout_s=0.1)
    enabled.until(lambda: bool(enabled.reported(E.MOTION_ENDED)))
    assert enabled.reported(E.STREAM_REFUSED) == []
    assert enabled.axes[0].set_point.position_deg == pytest.approx(begin + 1.0)


def test_early_knots_of_the_next_stream_are_kept(enabled: SteppedDaemon) -> None:
    """The end of a leg is reported and the next leg handed over within the same period."""
    begin = enabled.axes[0].set_point.position_deg
    enabled.stream({0: [(t, begin + p, v) for t, p, v in quintic(0.4, 1.0)]}, timeout_s=10.0)
    enabled.until(lambda: enabled.axes[0].set_point.position_deg == pytest.approx(begin + 1.0))
    enabled.order(K.STREAM_END, 0)
    onward = [Knot(2, t, begin + 1.0 + p, v) for t, p, v in quintic(0.4, 1.0)]
    enabled.memory.knots[0].put(onward)
    enabled.run(0.1)
    assert enabled.axes[0].set_point.mode is MotionMode.HOLD
    assert enabled.order(K.STREAM_BEGIN, 0, a=0.1, j=2).kind is E.DONE
    enabled.until(lambda: len(enabled.reported(E.MOTION_ENDED)) == 2)
    assert enabled.axes[0].set_point.position_deg == pytest.approx(begin + 2.0)
    assert enabled.order(K.STREAM_BEGIN, 0, a=0.1, j=2).kind is E.REFUSED


def test_axes_stream_together_or_not_at_all(pair: SteppedDaemon) -> None:
    begins = [axis.set_point.position_deg for axis in pair.axes]
    paths = {
        index: [(t, begins[index] + p, v) for t, p, v in quintic(1.0, 2.0 * (1 + index))] for index in (0, 1)
    }
    pair.move(5.0, 1)
    pair.run(0.1)
    assert "stop the axis first" in pair.stream(paths).text
    assert pair.axes[0].set_point.mode is MotionMode.HOLD
    pair.done(K.STOP, 1)
    pair.until(lambda: pair.axes[1].set_point.at_rest)
    begins[1] = pair.axes[1].set_point.position_deg
    paths[1] = [(t, begins[1] + p, v) for t, p, v in quintic(1.0, 4.0)]
    pair.samples.read()
    assert pair.stream(paths).kind is E.DONE
    pair.until(lambda: len(pair.reported(E.MOTION_ENDED)) >= 3)
    samples, _ = pair.samples.read()
    both = samples["axes"]["load_target_deg"]
    moving = (samples["axes"]["mode"] == MotionMode.STREAM).all(axis=1)
    assert np.allclose(2 * (both[moving, 0] - begins[0]), both[moving, 1] - begins[1], atol=1e-9)


@pytest.mark.parametrize("direction", [1, -1])
def test_samples_have_the_torque_that_accelerates_the_motor(direction: int) -> None:
    known = truth(motor__encoder__direction=direction)
    with stepped_daemon([directed(article_axes()[0], direction)], truth=known) as daemon:
        daemon.verify()
        daemon.enable()
        record(daemon)
        for target_deg in (20.0, -20.0):
            moved = daemon.move(target_deg)
            daemon.until(partial(daemon.ended, moved))
        samples = record(daemon)
    names = ("motor_position_deg", "load_position_deg", "motor_torque_nm")
    columns = {name: samples[name] for name in names}
    check_torque(known, Record({"time_s": daemon.period_s * np.arange(len(samples)), **columns}))


def test_a_fault_stops_coordinated_axes_in_order(pair: SteppedDaemon) -> None:
    begins = [axis.set_point.position_deg for axis in pair.axes]
    pair.stream({
        index: [(t, begins[index] + p, v) for t, p, v in quintic(3.0, 20.0)] for index in (0, 1)
    })  # fmt: skip
    pair.run(1.0)
    pair.samples.read()
    pair.nodes[0].faults.raise_error(0x3210)
    pair.until(lambda: pair.states[0] is S.QUICK_STOPPED)
    pair.until(lambda: pair.axes[1].set_point.at_rest)
    assert pair.states == [S.QUICK_STOPPED, S.ENABLED]
    samples, _ = pair.samples.read()
    velocity = samples["axes"]["velocity_deg_s"][:, 1]
    assert np.abs(np.diff(velocity)).max() <= 200.0 * 0.004 * 1.06
    assert not pair.reported(E.UNDERRUN)


def test_a_model_of_another_axis_is_refused(enabled: SteppedDaemon) -> None:
    other = article_axes(2)[1]
    model = TransmissionModel.load(PROFILE / "model.yaml").bound_to(other)
    slot = enabled.memory.settings[0]
    enabled.use(enabled.setting())
    number = slot.in_use
    answer = enabled.order(K.CHANGE, i=slot.put(enabled.setting(model=model).to_json()))
    assert answer.kind is E.REFUSED
    assert "made for 'axis2'" in answer.text
    for data in (b"", b"none", b"[]", b"{}", b"[" * 100_000, enabled.setting().to_json()[:-1]):
        assert enabled.order(K.CHANGE, i=slot.put(data)).kind is E.REFUSED
    assert enabled.order(K.CHANGE, i=slot.number + 1).kind is E.REFUSED
    assert slot.in_use == number


def test_the_compensation_may_begin_switched_off() -> None:
    with stepped_daemon(setup=lambda axis: axis.follower.engage(False)) as daemon:
        daemon.verify()
        daemon.enable()
        daemon.run(1.0)
        assert record(daemon)["weight"].max() == 0.0


def test_a_new_loop_ignores_earlier_commands(enabled: SteppedDaemon) -> None:
    enabled.post(K.ENABLE)
    enabled.memory.knots[0].put([Knot(1, 0.0, 0.0, 0.0)])
    enabled.begin_again()
    assert len(enabled.memory.commands) == 0
    assert len(enabled.memory.knots[0]) == 0
    enabled.run(0.2)
    assert enabled.states == [S.UNVERIFIED]


def test_the_load_loop_removes_the_remaining_error_and_fades_out() -> None:
    without = TransmissionModel(50.0)
    settings = LoadLoopSettings(gain_1_s=2.0, maximum_arcsec=40.0, slew_arcsec_s=40.0)
    with stepped_daemon(model=without, load_loop=settings) as daemon:
        daemon.verify()
        daemon.enable()
        id_ = daemon.move(7.3)
        daemon.until(lambda: daemon.ended(id_))
        daemon.run(0.2)
        left = 7.3 - record(daemon)["load_position_deg"][-1]
        daemon.run(8.0)
        axis = record(daemon)
        assert abs(7.3 - axis["load_position_deg"][-20:].mean()) < 0.3 * abs(left)
        assert axis["loop_arcsec"][-1] * left > 0.0
        assert axis["load_target_deg"][-1] == 7.3
        assert np.abs(np.diff(axis["loop_arcsec"])).max() <= 40.0 * 0.004 * (1 + 1e-9)
        daemon.use(daemon.setting(model=without))
        daemon.run(3.0)
        assert record(daemon)["loop_arcsec"][-1] == 0.0
        daemon.use(daemon.setting(model=without, load_loop=True))
        daemon.run(4.0)
        assert record(daemon)["loop_arcsec"][-1] != 0.0
        # The encoder slips by 19 arcsec, and comes back.
        daemon.nodes[0].faults.load_jump_counts = 150
        daemon.run(3.0)
        axis = record(daemon)
        assert axis["flags"][-1] & SampleFlag.LOOP_DOUBTED
        assert axis["loop_arcsec"][-1] == 0.0
        (event,) = daemon.reported(E.LOAD_LOOP)
        assert (event.code, event.axis) == (1, 0)
        assert "moved by" in event.text
        daemon.nodes[0].faults.load_jump_counts = 0
        daemon.run(9.0)
        axis = record(daemon)
        assert not axis["flags"][-1] & SampleFlag.LOOP_DOUBTED
        assert [each.code for each in daemon.reported(E.LOAD_LOOP)] == [1, 0]
        assert abs(7.3 - axis["load_position_deg"][-20:].mean()) < 0.3 * abs(left)
        assert np.abs(np.diff(axis["loop_arcsec"])).max() <= 40.0 * 0.004 * (1 + 1e-9)
        assert daemon.states == [S.ENABLED]


def test_a_sound_load_encoder_raises_no_doubt() -> None:
    """Reversals at rest, by one count and more, and in motion; the load loop corrects all hysteresis."""
    maximum_arcsec = 60.0
    settings = LoadLoopSettings(gain_1_s=0.5, maximum_arcsec=maximum_arcsec)
    with stepped_daemon(load_loop=settings) as daemon:
        daemon.verify()
        daemon.enable()
        daemon.use(daemon.setting(scheme=Scheme.SYNCHRONOUS, load_loop=True))
        for target in (2.0, 6.0, 3.0, 3.001, 2.999, 3.0, 2.9):
            id_ = daemon.move(target)
            daemon.until(lambda id_=id_: daemon.ended(id_))
            daemon.run(3.0)
        for speed in (4.0, -4.0, 4.0, -1.0, 0.05, -0.05):
            daemon.done(K.JOG, a=speed, b=5.0)
            daemon.run(0.7)
        daemon.done(K.STOP)
        daemon.run(6.0)
        assert daemon.reported(E.LOAD_LOOP) == []
        axis = record(daemon)
        assert not np.any(axis["flags"] & SampleFlag.LOOP_DOUBTED)
        assert 1.0 < np.abs(axis["loop_arcsec"]).max() <= maximum_arcsec
        left = 3600.0 * (axis["load_target_deg"] - axis["load_position_deg"])[-20:].mean()
        assert abs(left) < 0.5 * maximum_arcsec
