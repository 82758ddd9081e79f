"""The conformance suite: correct verdicts, restored settings, power off."""

import json
import logging

import pytest
from support.command import run_here
from support.conformance import EDS, gateway_slave, simulated_drive
from support.foreign_slaves import durand_drive, local_node

from hdbridge.conformance import NodeTester, Verdict, checks, run
from hdbridge.device.behaviour import Behaviour
from hdbridge.device.powerstate import State
from hdbridge.drive.link import Link
from hdbridge.errors import DriveError
from hdbridge.files.edsfile import read_eds

EVERY = checks(moves=True, stores=True)


def failed(results):
    return {
        each.check.id: f"{each.found}, not {each.expected}"
        for each in results
        if each.verdict is Verdict.FAIL
    }


def not_applicable(results):
    return {each.check.id for each in results if each.verdict is Verdict.NOT_APPLICABLE}


def test_the_table_is_large_and_its_names_are_unique():
    assert len({each.id for each in EVERY}) == len(EVERY) > 350
    assert len(checks()) > 250
    assert not any(each.moves or each.stores for each in checks())


@pytest.mark.parametrize(
    "behaviour",
    [
        {},
        {"controlword": "level", "sync_timeout_periods": 3.0, "measures_period": True},
        {"rpdo_before_tpdo": True, "status_delay_ms": 12.0, "sdo_delay_s": 0.6},
    ],
    ids=["friendly", "levels", "late"],
)
def test_the_simulated_drive_conforms(behaviour):
    with simulated_drive(Behaviour.model_validate(behaviour)) as (tester, _, _):
        results = run(tester, EVERY)
    assert failed(results) == {}
    assert not_applicable(results) == {"sdo.abort.write-only", "402.following-error.fault"}


def test_the_slave_of_a_gateway_conforms(tmp_path):
    with gateway_slave(tmp_path) as (tester, _):
        results = run(tester, EVERY)
    assert failed(results) == {}
    assert not_applicable(results) == {"sdo.abort.write-only", "402.following-error.fault"}


def test_a_node_of_durand(tmp_path):
    """The deviations of a different CANopen stack are found, and its correct behaviour passes."""
    with durand_drive() as (bus, drive):
        path = tmp_path / "durand.eds"
        path.write_text(drive.node.eds.content, encoding="utf-8")
        tester = NodeTester(Link(bus, bus._clock), 5, od=read_eds(path, 5).dictionary)
        results = run(tester, [each for each in checks() if not each.id.startswith("402")])
    wrong = failed(results)
    assert {"nmt.ignores.extended", "tpdo.sync.2", "sync.identifier.zero", "rpdo.type.241"} <= set(wrong)
    right = {each.check.id for each in results if each.verdict is Verdict.PASS}
    assert {
        "nmt.start",
        "nmt.boot-up.frame",
        "heartbeat.period",
        "sdo.download.segmented",
        "tpdo.sync.1",
    } <= right


def test_a_local_node_of_canopen(caplog):
    caplog.set_level(logging.CRITICAL)
    with local_node(EDS) as bus:
        tester = NodeTester(Link(bus, bus._clock), 5, od=read_eds(EDS, 5).dictionary)
        results = run(
            tester, [each for each in checks() if each.id.split(".")[0] in ("nmt", "sdo", "heartbeat")]
        )
    wrong = failed(results)
    assert {"nmt.reset-node", "nmt.sdo.stopped", "sdo.block.upload", "sdo.upload.no-initiate"} <= set(wrong)
    right = {each.check.id for each in results if each.verdict is Verdict.PASS}
    assert {"nmt.start", "sdo.upload.segmented.toggle", "sdo.download.text", "heartbeat.period"} <= right


def test_power_stays_off_without_permission_and_nothing_remains_changed():
    with simulated_drive() as (tester, node, motor):
        before = {(each.index, each.sub): each.value for each in node.dictionary}
        results = run(tester, checks(stores=True))
        assert failed(results) == {}
        assert not motor.powered
        assert motor.motor_counts == 100_000
        changed = {
            f"{each.index:04X}h:{each.sub:02X}"
            for each in node.dictionary
            if each.value != before[each.index, each.sub] and each.index != 0x6040
        }
        assert changed == set()


def test_a_powered_drive_is_left_alone():
    with simulated_drive() as (tester, node, _):
        for word in (0x06, 0x07, 0x0F):
            node.firmware.control(word)
        with pytest.raises(DriveError, match="found in operation enabled; expected a drive without power"):
            run(tester, EVERY)
        assert node.firmware.state is State.OPERATION_ENABLED


def test_an_absent_node_is_one_clear_error():
    with simulated_drive() as (tester, _, _):
        absent = NodeTester(tester.link, 9)
        with pytest.raises(DriveError, match=r"node 9 .* no answer to SDO requests in 10 s"):
            run(absent, EVERY)


def test_an_interrupted_move_is_stopped_and_everything_restored():
    moving = [each for each in EVERY if each.id == "402.pp.velocity"] * 2
    with simulated_drive(stopped=lambda: motor.powered and motor.velocity_counts_s != 0.0) as (
        tester,
        node,
        motor,
    ):
        speed = node.dictionary.value(0x6081)
        assert len(run(tester, moving)) < 2
        assert node.firmware.state is State.SWITCH_ON_DISABLED
        assert motor.velocity_counts_s == 0.0
        assert node.dictionary.value(0x6081) == speed


@pytest.mark.parametrize("name", ["lss.node-id.used", "lss.fast-scan"])
def test_an_interrupted_run_restores_the_node_id(name):
    renumbered = [each for each in EVERY if each.id == name]
    with simulated_drive(stopped=lambda: node.node_id != 1) as (tester, node, _):
        run(tester, renumbered)
        assert node.node_id == 1


# ---------------------------------------------------------------- the command


def test_the_command_on_the_simulated_axis(tmp_path):
    run_here(tmp_path, "conform", "article", "--simulate", "--motion", "--json", "result.json")
    document = json.loads((tmp_path / "result.json").read_text())
    assert document["schema"] == "hdbridge.conform/1"
    assert document["summary"]["fail"] == 0
    assert document["summary"]["pass"] > 350
    by_id = {each["id"]: each for each in document["checks"]}
    assert by_id["402.following-error.fault"]["result"] == "pass"


def test_a_failed_check_is_exit_status_4_with_found_and_expected(tmp_path):
    text = EDS.read_text(encoding="utf-8").replace("ProductNumber=0x00000402", "ProductNumber=0x00000999")
    (tmp_path / "other.eds").write_text(text, encoding="utf-8")
    done = run_here(
        tmp_path, "conform", "article", "--simulate", "--eds", "other.eds", "--only", "identity", status=4
    )
    assert "1 of 7 checks failed: identity.eds.product" in done.stderr
    assert "00000402h" in done.stdout
    assert "00000999h" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "give a PROFILE, or --channel (can0) and --node"),
        (("--channel", "can0"), "give a PROFILE, or --channel (can0) and --node"),
        (("article", "--simulate", "--only", "sdp"), "--only sdp: no check has such an id"),
        (
            ("article", "--simulate", "--only", "402.pp"),
            "--only 402.pp: these checks need --motion or --store",
        ),
        (("--channel", "can0", "--node", "5", "--interface", "sockan"), "did you mean 'socketcan'"),
        (("--channel", "can0", "--node", "5", "--eds", "none.eds"), "none.eds"),
    ],
)
def test_bad_input_is_refused_before_anything_is_sent(tmp_path, arguments, words):
    done = run_here(tmp_path, "conform", *arguments, status=2)
    assert words in done.stderr


def test_the_list_names_every_check_with_its_clause(tmp_path):
    done = run_here(tmp_path, "conform", "--list", "--motion", "--store")
    assert all(each.id in done.stdout for each in EVERY)
