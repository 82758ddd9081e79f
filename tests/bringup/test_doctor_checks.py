"""The doctor's checks on a simulated drive with one fault: each fault is found and its key named."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from hdbridge.axis.model import TransmissionModel
from hdbridge.axis.model.response import LeadFilter, Response
from hdbridge.commissioning.bringup.checks import Outcome, Verdict
from hdbridge.commissioning.bringup.doctor import CHECKS
from hdbridge.device.node import DriveNode
from hdbridge.drive.states import State, decode

PASS, FAIL, NOT_POSSIBLE = Outcome.PASS, Outcome.FAIL, Outcome.NOT_POSSIBLE


def failures(verdicts: dict[str, Verdict]) -> list[str]:
    return [name for name, verdict in verdicts.items() if verdict.outcome is FAIL]


def test_a_sound_axis_passes_every_check(case: Callable[..., Any]) -> None:
    examined = case()
    verdicts = examined.run()
    assert {name: each.measured for name, each in verdicts.items() if each.outcome is not PASS} == {}
    assert list(verdicts) == [check.name for check in CHECKS]
    turn = verdicts["turn"].figures
    assert turn["forward_motor_counts"] == pytest.approx(8000, abs=1)
    assert turn["backward_load_counts"] == pytest.approx(-57600, abs=10)
    assert turn["ratio_measured"] == pytest.approx(50, rel=1e-3)
    assert verdicts["quick_stop"].figures["distance_motor_deg"] > 0.5
    assert 0.025 < verdicts["heartbeat"].figures["time_s"] < 0.1
    assert 0.016 <= verdicts["set_points"].figures["time_s"] < 0.05
    assert decode(examined.node.firmware.statusword()) is State.SWITCH_ON_DISABLED
    # The motor has returned, except for the last stop.
    assert abs(examined.node.firmware.motion.motor_counts) < 4000


def test_test_motion_turns_toward_the_side_with_room(case: Callable[..., Any]) -> None:
    verdicts = case(axis={"position_max_deg: 400": "position_max_deg: 0.5"}).run(until="turn")
    assert failures(verdicts) == []
    assert verdicts["turn"].figures["forward_motor_counts"] == pytest.approx(-8000, abs=1)


@pytest.mark.parametrize(
    ("ratio", "counts", "turns"),
    [(160, 2_880_000, 3), (50, 4096, 1)],
    ids=["high ratio", "coarse load encoder"],
)
def test_other_gears_and_encoders_pass(case: Callable[..., Any], ratio: int, counts: int, turns: int) -> None:
    """In addition, the motor encoder counts in the opposite direction."""
    verdicts = case(
        axis={
            "  direction: 1\n\nload": "  direction: -1\n\nload",
            "counts_per_turn: 2880000 ": f"counts_per_turn: {counts} ",
            "ratio: 50\n": f"ratio: {ratio}\n",
            "flexspline: 100,": f"flexspline: {2 * ratio},",
            "circular_spline: 102": f"circular_spline: {2 * ratio + 2}",
        },
        truth={
            "{counts_per_turn: 8000, direction: 1,": "{counts_per_turn: 8000, direction: -1,",
            "counts_per_turn: 2880000\n": f"counts_per_turn: {counts}\n",
            "gear:\n  ratio: 50": f"gear:\n  ratio: {ratio}",
        },
        honest=True,
    ).run()
    assert failures(verdicts) == []
    assert verdicts["turn"].figures["motor_turns"] == pytest.approx(turns, abs=0.01)
    assert verdicts["turn"].figures["forward_motor_counts"] < 0


def test_an_axis_without_room_is_not_moved_far(case: Callable[..., Any]) -> None:
    limits = {
        "position_min_deg: -400": "position_min_deg: -0.2",
        "position_max_deg: 400": "position_max_deg: 0.2",
    }
    examined = case(axis=limits)
    verdicts = examined.run()
    assert verdicts["nudge"].outcome is FAIL
    assert "axis.yaml:43:3: limits.position_min_deg" in verdicts["nudge"].measured
    assert verdicts["turn"].outcome is NOT_POSSIBLE
    assert abs(examined.node.firmware.motion.motor_counts) < 10


WRONG: list[tuple[str, dict[str, Any], str, str]] = [
    (
        "load direction",
        {"truth": {"2880000\n    direction: 1": "2880000\n    direction: -1"}},
        "turn",
        r"axis.yaml:33:3: load_encoder.direction: found 1, expected -1",
    ),
    (
        "motor direction",
        {"truth": {"{counts_per_turn: 8000, direction: 1,": "{counts_per_turn: 8000, direction: -1,"}},
        "turn",
        r"motor_encoder.direction: found 1, expected -1",
    ),
    (
        "lines instead of counts at the load",
        {"truth": {"    counts_per_turn: 2880000": "    counts_per_turn: 11520000"}},
        "turn",
        "axis.yaml:32:3: load_encoder.counts_per_turn: found 2880000, expected 11520000 (lines",
    ),
    (
        "the other output of the gear",
        {"truth": {"gear:\n  ratio: 50": "gear:\n  ratio: 51"}},
        "turn",
        "axis.yaml:37:3: gear.ratio: found 50, expected 51 (the output is the other part",
    ),
    (
        "another gear, and the drive says so",
        {"truth": {"gear:\n  ratio: 50": "gear:\n  ratio: 80"}, "honest": True},
        "units",
        "a gear of 80, but",
    ),
    (
        "motor counts, and the drive says so",
        {"truth": {"{counts_per_turn: 8000,": "{counts_per_turn: 10000,"}, "honest": True},
        "units",
        "axis.yaml:28:3: motor_encoder.counts_per_turn is 8000",
    ),
    (
        "load counts, and the drive says so",
        {"truth": {"    counts_per_turn: 2880000": "    counts_per_turn: 720000"}, "honest": True},
        "units",
        "axis.yaml:32:3: load_encoder.counts_per_turn is 2880000",
    ),
    (
        "another drive",
        {"axis": {"product_code: 0x402": "product_code: 0x403"}},
        "identity",
        "axis.yaml:16:5: drive.identity.product_code is 403h",
    ),
    (
        "another node id",
        {"node_id": 5},
        "node",
        "axis.yaml:12:3: drive.node_id: found 1; the drive with this identity is node 5",
    ),
    (
        "the motor encoder in place of the load encoder",
        {"spoil": lambda node: node.dictionary[0x60E4, 1].bind(lambda: node.firmware.motion.motor_counts)},
        "turn",
        "reads the motor's encoder",
    ),
]


def _without(*keys: tuple[int, int]) -> Callable[[DriveNode], None]:
    def spoil(node: DriveNode) -> None:
        for key in keys:
            node.dictionary.remove(*key)

    return spoil


@pytest.mark.parametrize(("name", "parts", "check", "text"), WRONG, ids=[row[0] for row in WRONG])
def test_each_fault_is_found_and_its_key_named(case, name, parts, check, text):
    verdicts = case(**parts).run(until=check)
    assert failures(verdicts)[0] == check
    assert text in "".join(verdicts[check].remedies)
    assert all("\n" not in each for each in (verdicts[check].measured, *verdicts[check].remedies))


GAIN_EDS = {
    "[OptionalObjects]\nSupportedObjects=89\n": "[OptionalObjects]\nSupportedObjects=90\n90=0x60FB\n",
    "[6085]": """[60FB]
ParameterName=Position control parameter set
ObjectType=0x9
SubNumber=2

[60FBsub0]
ParameterName=Highest sub-index supported
ObjectType=0x7
DataType=0x0005
AccessType=ro
DefaultValue=1

[60FBsub1]
ParameterName=Position gain
ObjectType=0x7
DataType=0x0006
AccessType=rw
DefaultValue=200

[6085]""",
}


def test_gains_changed_since_the_response_measurement(case: Callable[..., Any], tmp_path: Path) -> None:
    examined = case(eds=GAIN_EDS, drive_has_eds=True)
    response = Response(
        cycle_ms=4.0,
        following_lag_ms=5.0,
        known_to_hz=80.0,
        frequency_hz=(10.0,),
        gain=(1.0,),
        phase_deg=(0.0,),
        uncertainty=(0.1,),
        filter=LeadFilter(lead_cycles=0, per_cycle=1, full_speed_deg_s=1.0, weights=(1.0,)),
        gain_objects={"60FBh:01": 200},
    )
    TransmissionModel(50.0, (), response=response).save(tmp_path / "model.yaml")
    assert failures(examined.run(until="identity")) == []
    examined.spoil = lambda node: setattr(node.dictionary[0x60FB, 1], "value", 110)
    verdicts = examined.run(until="identity")
    assert failures(verdicts) == ["identity"]
    assert "60FBh:01 is 110, was 200" in verdicts["identity"].remedies[0]
    assert "measure the response again" in verdicts["identity"].remedies[0]


def test_a_missing_load_encoder(case: Callable[..., Any]) -> None:
    verdicts = case(spoil=lambda node: node.dictionary[0x60E4, 1].bind(lambda: 17)).run(until="turn")
    assert failures(verdicts) == ["turn"]
    assert "load encoder does not move" in verdicts["turn"].measured
    assert "axis.yaml:34:3: load_encoder.source: object 60E4h:01" in verdicts["turn"].remedies[0]


def test_a_load_encoder_that_jitters_at_rest(case: Callable[..., Any]) -> None:
    verdicts = case(
        truth={"    direction: 1\n    coupling": "    direction: 1\n    noise_arcsec: 60\n    coupling"}
    ).run(until="hold")
    assert failures(verdicts) == ["rest"]
    assert "load_encoder.source" in verdicts["rest"].remedies[0]
    assert verdicts["hold"].outcome is NOT_POSSIBLE


CHANNELS = {
    "limits:": "load_torque:\n  source: {index: 0x2101, type: int32}\n  newton_metres_per_count: 0.001\n"
    "temperature: {source: {index: 0x2100, type: int16}, celsius_per_count: 0.1}\nlimits:"
}


def test_load_torque_and_temperature_readings_are_shown(case: Callable[..., Any]) -> None:
    verdicts = case(axis=CHANNELS).run(until="rest")
    assert failures(verdicts) == []
    assert "; load torque 0 Nm; temperature 22 \N{DEGREE SIGN}C" in verdicts["rest"].measured
    assert verdicts["rest"].figures["temperature_c"] == 22.0


def test_a_torque_sensor_that_is_not_connected(case: Callable[..., Any]) -> None:
    unplug = lambda node: node.dictionary[0x2101, 0].bind(lambda: -(2**31))  # noqa: E731
    verdicts = case(axis=CHANNELS, spoil=unplug).run(until="hold")
    assert failures(verdicts) == ["rest"]
    assert "; no load torque; temperature 22 \N{DEGREE SIGN}C" in verdicts["rest"].measured
    assert "axis.yaml:42:1: load_torque: no plausible reading arrives" in verdicts["rest"].remedies[0]
    assert verdicts["hold"].outcome is NOT_POSSIBLE


def test_a_torque_channel_that_the_drive_lacks(case: Callable[..., Any]) -> None:
    verdicts = case(axis=CHANNELS, spoil=_without((0x2101, 0))).run(until="eds")
    assert failures(verdicts)[0] == "eds"
    verdicts = case(axis=CHANNELS, eds={"[2101]": "[2111]"}).run()
    assert failures(verdicts) == ["files"]
    assert "2101h:00" in verdicts["files"].measured + " ".join(verdicts["files"].remedies)


def test_eds_of_another_drive(case: Callable[..., Any]) -> None:
    verdicts = case(spoil=_without((0x6085, 0), (0x6007, 0))).run(until="eds")
    assert failures(verdicts) == ["eds"]
    assert "axis.yaml:13:3: drive.eds: found hdbridge-402.eds" in verdicts["eds"].remedies[0]
    assert {"6085h", "6007h"} <= {
        word.strip(":").split(":")[0] for each in verdicts["eds"].remedies for word in each.split()
    }


def test_a_drive_that_ignores_a_lost_heartbeat(case: Callable[..., Any]) -> None:
    examined = case(spoil=lambda node: setattr(node.faults, "ignore_lost_heartbeat", True))
    verdicts = examined.run()
    assert failures(verdicts) == ["heartbeat"]
    assert "the drive continues" in verdicts["heartbeat"].measured
    assert "drive.heartbeat_ms (50 ms) was written to 1016h" in verdicts["heartbeat"].remedies[0]
    assert verdicts["set_points"].outcome is PASS
    assert decode(examined.node.firmware.statusword()) is State.SWITCH_ON_DISABLED


HOLDING = {"quick_stop_option: 2": "quick_stop_option: 6"}


def test_a_drive_that_only_reports_a_lost_heartbeat(case: Callable[..., Any]) -> None:
    def spoil(node: DriveNode) -> None:
        node.faults.only_report_lost_heartbeat = True

    verdict = case(axis=HOLDING, spoil=spoil).run(until="heartbeat")["heartbeat"]
    assert verdict.outcome is FAIL
    assert "it sent EMCY 8130h (a heartbeat that the drive watches was missing)" in verdict.measured
    assert "1016h" not in verdict.remedies[0]
    assert "neither stops (6007h) nor leaves OPERATIONAL (1029h)" in verdict.remedies[0]
    assert "transition 16" in verdict.remedies[0]
    assert ": drive.quick_stop_option: found 6; 1 to 4 prevent that" in verdict.remedies[0]


def test_a_drive_that_the_master_itself_takes_out_of_its_stop(case: Callable[..., Any]) -> None:
    def spoil(node: DriveNode) -> None:
        node.faults.stay_operational = True

    level = {"servo:": "firmware: {controlword: level}\nservo:"}
    verdict = case(axis=HOLDING, truth=level, spoil=spoil).run(until="heartbeat")["heartbeat"]
    assert verdict.outcome is PASS, verdict
    assert "(transition 16); it sent EMCY 8130h" in verdict.measured


def test_a_drive_that_ignores_missing_set_points(case: Callable[..., Any]) -> None:
    def deaf(node: DriveNode) -> None:
        node.faults.ignore_missing_set_points = True

    verdicts = case(spoil=deaf).run()
    assert failures(verdicts) == ["set_points"]
    assert "drive.cycle_ms" in verdicts["set_points"].remedies[0]
    assert verdicts["off"].outcome is PASS


def test_a_drive_that_hardly_brakes(case: Callable[..., Any]) -> None:
    def coast(node: DriveNode) -> None:
        node.faults.deceleration_counts_s2 = 2_000.0

    verdicts = case(spoil=coast).run(until="quick_stop")
    assert "quick_stop" in failures(verdicts)
    assert "drive.quick_stop_option" in verdicts["quick_stop"].remedies[0]


def test_a_blocked_axis_is_stopped_by_its_torque_limit(case: Callable[..., Any]) -> None:
    verdicts = case(truth={"coulomb_nm: 0.03": "coulomb_nm: 0.3"}).run()
    assert failures(verdicts)[0] == "nudge"
    assert (
        "--torque-percent" in "".join(verdicts["nudge"].remedies) or "following" in verdicts["nudge"].measured
    )
    assert verdicts["off"].outcome is PASS


def test_without_permission_nothing_moves(case: Callable[..., Any]) -> None:
    examined = case()
    verdicts = examined.run(permitted=lambda: "not now")
    assert failures(verdicts) == []
    assert (verdicts["hold"].outcome, verdicts["hold"].measured) == (NOT_POSSIBLE, "not now")
    assert verdicts["off"].outcome is PASS
    assert examined.node.firmware.motion.motor_counts == 0


def test_an_interrupt_stops_the_axis(case: Callable[..., Any]) -> None:
    asked = 0

    @contextmanager
    def impatient() -> Iterator[Callable[[], bool]]:
        def wish() -> bool:
            nonlocal asked
            asked += 1
            return asked > 900  # in the middle of the motor turn

        yield wish

    examined = case()
    with pytest.raises(KeyboardInterrupt):
        examined.run(interruptible=impatient)
    assert decode(examined.node.firmware.statusword()) is State.SWITCH_ON_DISABLED
    assert abs(examined.node.firmware.motion.machine.velocity_counts_s) < 50


def test_a_drive_in_fault_is_reset_and_checked(case: Callable[..., Any]) -> None:
    verdicts = case(spoil=lambda node: node.faults.raise_error(0x3210)).run(until="hold")
    assert failures(verdicts) == []
