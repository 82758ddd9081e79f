"""Check, boot-up and steps on simulated drives with dictionaries other than the project's own."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.eds import OWN, fixed, mapped, profile_with, section, stating, without

from hdbridge import AxisConfig, Bench, Drive, Stepping, simulated
from hdbridge.drive import plan
from hdbridge.drive.bootplan import left_to_drive, unrequested_objects
from hdbridge.drive.bootup import BootReport
from hdbridge.errors import DriveError, InputError
from hdbridge.files.profile import bundled_folder
from hdbridge.records.record import Record
from hdbridge.sim.lockstep import simulated_bench

NEEDED = {0x1000, 0x1001, 0x1018, 0x6040, 0x6041, 0x6060, 0x6061, 0x6064, 0x60E4}
TARGETS = {"csp": 0x607A, "ip": 0x60C1}
MODE = "\ndrive:\n"


DESCRIBED = re.findall(r"^\[(\w{4})(?:sub(\w))?\]$", OWN, flags=re.MULTILINE)
INDICES = {int(index, 16) for index, _ in DESCRIBED}
OPTIONAL = sorted({each for each in INDICES if not 0x1400 <= each <= 0x1BFF} - NEEDED)
MEMBERS = sorted(
    (int(index, 16), int(sub, 16)) for index, sub in DESCRIBED if sub and int(index, 16) in OPTIONAL
)
WRITTEN = {
    0x1016, 0x1017, 0x1029, 0x6007, 0x605A, 0x605B, 0x605C, 0x605D, 0x605E, 0x6065, 0x6066, 0x6072, 0x607D,
    0x6080, 0x6085, 0x60C2,
}  # fmt: skip
READ = {0x6062, 0x6077, 0x6502, 0x603F}


def stepped(axis: AxisConfig) -> tuple[BootReport, Record]:
    """Boots a simulated drive with the axis's EDS and steps the axis; returns boot report and record."""
    plan(axis)
    with simulated(axis) as drive:
        report = drive.boot()
        run = Bench(drive).run(Stepping(count=2))
    record = run.record
    assert np.ptp(record.columns["load_position_deg"]) > 1.5
    following = record.columns["motor_target_deg"] - record.columns["motor_position_deg"]
    assert np.max(np.abs(following)) < axis.drive.following_error_deg
    return report, record


@pytest.fixture(scope="module")
def usual(tmp_path_factory: pytest.TempPathFactory) -> Record:
    return stepped(profile_with(tmp_path_factory.mktemp("usual"), OWN))[1]


@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    absent=st.sets(st.sampled_from(OPTIONAL)) | st.just(set(OPTIONAL)),
    members=st.sets(st.sampled_from([*MEMBERS, (0x1400, 5), (0x1400, 3), (0x1802, 5)]), max_size=4),
    mode=st.sampled_from(["csp", "ip"]),
)
def test_any_optional_objects_may_be_absent(tmp_path, usual, absent, members, mode):
    absent = absent - {TARGETS[mode]}
    members = {each for each in members if each[0] not in absent and each != (0x60C1, 1)}
    eds = without(without(OWN, *sorted(absent)), *sorted(members))
    axis = profile_with(tmp_path, eds, (MODE, f"{MODE}  mode: {mode}\n"))
    used = {*WRITTEN, *READ, *({0x60C0} if mode == "ip" else set())}
    partly = {index for index, sub in members if (sub and index in WRITTEN) or (index, sub) == (0x1400, 5)}
    assert {each.index for each in left_to_drive(axis)} == (absent & used) | partly
    _, record = stepped(axis)
    assert ("motor_torque_nm" in record.columns) == (0x6077 not in absent)
    for name, column in record.columns.items():
        assert np.isfinite(column).all()
        if name != "motor_target_deg" and absent.isdisjoint({0x6080, 0x6085, 0x60C5, 0x60C6}):
            assert column == pytest.approx(usual.columns[name], abs=1e-9)
    if 0x6062 in absent:
        assert record.columns["motor_target_deg"] == pytest.approx(usual.columns["motor_target_deg"], abs=0.1)


def test_mandatory_objects_alone_are_sufficient(tmp_path: Path, usual: Record) -> None:
    axis = profile_with(tmp_path, without(OWN, *(each for each in OPTIONAL if each != 0x607A)))
    _, record = stepped(axis)
    assert record.columns["load_position_deg"] == pytest.approx(usual.columns["load_position_deg"], abs=1e-9)


def test_the_simulated_drive_has_this_dictionary(tmp_path: Path) -> None:
    axis = profile_with(tmp_path, without(OWN, 0x6085))
    with simulated(axis) as drive, pytest.raises(DriveError, match="06020000h"):
        drive.sdo.read(0x6085)


def test_fixed_mappings_in_another_order_on_other_pdos(tmp_path: Path, usual: Record) -> None:
    eds = mapped(OWN, 0x1800, 0x60410010, kind=255)  # not sent on every SYNC, so not usable
    eds = mapped(eds, 0x1801, 0x60640020, 0x60410010, can_id=0x281, kind=1)
    eds = mapped(eds, 0x1802, 0x60E40120, 0x60610008, 0x60770010, can_id=0x395)
    eds = mapped(eds, 0x1400, 0x60400010, 0x00050008, 0x60600008, kind=0)
    eds = mapped(eds, 0x1401, 0x607A0020, 0x60B00020)
    axis = profile_with(tmp_path, eds)
    report, record = stepped(axis)
    assert unrequested_objects(axis) == ["60B0h:00 = 0 in RPDO2"]
    assert not {0x1A01, 0x1A02, 0x1600, 0x1601} & {row.index for row in report.written}
    assert record.columns["load_position_deg"] == pytest.approx(usual.columns["load_position_deg"], abs=1e-9)


def test_a_fixed_mapping_wrong_in_the_eds_is_refused(tmp_path: Path) -> None:
    axis = profile_with(tmp_path, mapped(OWN, 0x1801, 0x60E40120, 0x60640020))
    with (
        simulated_bench(tmp_path / "truth.yaml", bundled_folder("eds") / "hdbridge-402.eds") as (
            bus,
            clock,
            node,
        ),
        Drive(bus, axis, clock) as drive,
    ):
        node.dictionary[0x1A01, 2].guard = None
        for sub in range(3):
            node.dictionary[0x1A01, sub].writable = False
        with pytest.raises(DriveError, match=r"1A01h:00 .*read-only.*TPDO2 maps nothing while it is changed"):
            drive.boot()


@pytest.mark.parametrize(
    ("name", "value", "cycle", "refused"),
    [
        ("60C2sub2", -3, 4, None),
        ("60C2sub2", -4, 4, None),  # 40 times 0.1 ms
        ("60C2sub1", 4, 4, None),
        ("60C2sub1", 8, 4, r"does not permit 4 ms in object 60C2h: 60C2h:01 is read-only \(8\)"),
        ("60C2sub2", -3, 2.5, r"does not permit 2.5 ms in object 60C2h: 60C2h:02 is read-only \(-3\)"),
        ("60C2sub2", -4, 50, r"does not permit 50 ms"),
    ],
)
def test_partly_fixed_interpolation_period(tmp_path, name, value, cycle, refused):
    edits = [("cycle_ms: 4 ", f"cycle_ms: {cycle} "), ("heartbeat_ms: 50", "heartbeat_ms: 200")]
    axis = profile_with(tmp_path, fixed(OWN, name, value), *edits)
    if refused:
        with pytest.raises(InputError, match=rf"axis\.yaml:\d+:3: drive\.cycle_ms: drive\.eds {refused}"):
            plan(axis)
        return
    report, _ = stepped(axis)
    assert name not in {section(row.index, row.sub) for row in report.written}


def test_a_period_without_an_exponent_is_in_milliseconds(tmp_path: Path) -> None:
    eds = without(OWN, (0x60C2, 2))
    stepped(profile_with(tmp_path, eds))
    with pytest.raises(InputError, match=r"does not permit 2\.5 ms"):
        plan(profile_with(tmp_path, eds, ("cycle_ms: 4 ", "cycle_ms: 2.5 ")))


READ_ONLY = [
    (0x605A, 0), (0x605B, 0), (0x605D, 0), (0x6007, 0), (0x1029, 1), (0x6065, 0), (0x6066, 0), (0x6072, 0),
    (0x6080, 0), (0x6085, 0), (0x607D, 1), (0x1016, 1), (0x1400, 5),
]  # fmt: skip


@pytest.mark.parametrize("key", READ_ONLY)
def test_a_read_only_object_is_left_to_the_drive_unless_it_is_right(tmp_path, key):
    name = section(*key) if key in ((0x1029, 1), (0x607D, 1), (0x1016, 1), (0x1400, 5)) else section(key[0])
    wanted = next(row.value for row in plan(profile_with(tmp_path, OWN)) if (row.index, row.sub) == key)
    for value in (wanted, wanted + 100):
        axis = profile_with(tmp_path, stating(fixed(OWN, name, value), name, LowLimit=None, HighLimit=None))
        left = [(each.index, each.sub) for each in left_to_drive(axis)]
        assert left == ([] if value == wanted else [key])
        if value != wanted:
            assert f"is read-only in drive.eds ({value})" in str(left_to_drive(axis)[0])
    if key in ((0x605A, 0), (0x607D, 1)):
        stepped(axis)


def test_limits_of_the_eds_are_compared_beforehand(tmp_path: Path) -> None:
    """A value chosen by the user is refused with its line; a default is left to the drive."""
    eds = stating(OWN, "6007", LowLimit=0, HighLimit=1)
    (left,) = left_to_drive(profile_with(tmp_path, eds))
    assert str(left).startswith("6007h:00, for which drive.eds permits 0 to 1, not 3: what it does when")
    assert left.field == "drive.abort_connection_option"
    chosen = (MODE, f"{MODE}  abort_connection_option: 2\n")
    with pytest.raises(
        InputError, match=r"axis\.yaml:\d+:3: drive\.abort_connection_option: gives 2 .*0 to 1$"
    ):
        plan(profile_with(tmp_path, eds, chosen))
    axis = profile_with(tmp_path, eds, (MODE, f"{MODE}  abort_connection_option: 1\n"))
    assert left_to_drive(axis) == []
    report, _ = stepped(axis)
    assert 0x6007 in {row.index for row in report.held}
    with pytest.raises(
        InputError, match=r"limits\.torque_percent: gives 1000 for object 6072h:00; .*0 to 900"
    ):
        plan(profile_with(tmp_path, stating(OWN, "6072", LowLimit=0, HighLimit=900)))


def test_limits_of_a_part_of_a_value_are_not_those_of_the_value(tmp_path: Path) -> None:
    """The limits apply to the time in the lower 16 bits of 1016h:01; the node id is in the bits above. Elmo's
    Gold drives state 0 to 65535.
    """
    axis = profile_with(tmp_path, stating(OWN, "1016sub1", LowLimit=0, HighLimit=65535))
    assert left_to_drive(axis) == []
    assert [row.value for row in plan(axis) if row.index == 0x1016] == [127 << 16 | 50]


def test_equal_limits_count_as_no_limits(tmp_path: Path) -> None:
    eds = stating(stating(OWN, "6007", LowLimit=0, HighLimit=0), "6072", LowLimit="", HighLimit="none")
    assert left_to_drive(profile_with(tmp_path, eds)) == []


@pytest.mark.parametrize(
    ("limits", "mode", "refused"),
    [
        ((-128, 10), "csp", None),
        ((0, 0), "csp", None),
        ((-1, 7), "csp", r"drive\.mode: csp is not among .*6060h permits -1 to 7\); 'mode: ip' is supported"),
        ((-9, 6), "ip", r"drive\.mode: ip is not among .*6060h permits -9 to 6\); this drive cannot be used"),
    ],
)
def test_the_limits_of_6060h_count_if_6502h_gives_no_value(tmp_path, limits, mode, refused):
    low, high = limits
    limited = stating(OWN, "6060", LowLimit=low, HighLimit=high)
    plan(profile_with(tmp_path, limited))  # 6502h reports both modes
    edit = (MODE, f"{MODE}  mode: {mode}\n")
    for eds in (without(limited, 0x6502), stating(limited, "6502", DefaultValue="")):
        axis = profile_with(tmp_path, eds, edit)
        if refused:
            with pytest.raises(InputError, match=refused):
                plan(axis)
        else:
            assert [each.index for each in left_to_drive(axis)] == [0x6502]


def test_a_missing_mode_is_reported_before_its_objects(tmp_path: Path) -> None:
    """A load encoder, or an EDS with 60C1h, does not help a drive that lacks the mode."""
    eds = stating(without(OWN, 0x60E4, 0x60C1), "6502", DefaultValue="0x25")
    for mode in ("csp", "ip"):
        with pytest.raises(InputError, match=rf"drive\.mode: {mode} is not among the modes"):
            plan(profile_with(tmp_path, eds, (MODE, f"{MODE}  mode: {mode}\n")))


@pytest.mark.parametrize(
    ("modes", "mode", "refused"),
    [
        ("0x000003E1", "csp", None),
        ("0x00000043", "ip", None),
        ("0", "csp", None),
        ("", "csp", None),
        ("0x00000043", "csp", r"drive\.mode: csp is not among .*6502h is 00000043h.*'mode: ip' is supported"),
        ("0x000000A1", "ip", r"drive\.mode: ip is not among .*'mode: csp' is supported"),
        ("0x00000003", "csp", r"this drive cannot be used: choose one with cyclic synchronous"),
    ],
)
def test_check_reports_a_missing_mode(tmp_path: Path, modes: str, mode: str, refused: str | None) -> None:
    axis = profile_with(tmp_path, stating(OWN, "6502", DefaultValue=modes), (MODE, f"{MODE}  mode: {mode}\n"))
    if refused:
        with pytest.raises(InputError, match=refused):
            plan(axis)
    else:
        stepped(axis)


def test_interpolated_position_mode_as_the_only_mode(tmp_path: Path, usual: Record) -> None:
    """The dictionary is like that of several drives in robot arms: no 607Ah in an RPDO, no option codes, and
    6502h lists PP, VL and IP.
    """
    eds = without(
        OWN, 0x6007, 0x605A, 0x605B, 0x605C, 0x605D, 0x605E, 0x6066, 0x6072, 0x6080, 0x6085, 0x1029, 0x6099
    )
    eds = stating(without(eds, (0x1400, 5)), "6502", DefaultValue="0x00000043")
    eds = mapped(eds, 0x1400, 0x60400010, 0x60C10120)
    axis = profile_with(tmp_path, eds, (MODE, f"{MODE}  mode: ip\n"))
    _, record = stepped(axis)
    assert record.columns["load_position_deg"] == pytest.approx(usual.columns["load_position_deg"], abs=0.02)


def test_the_load_encoder_in_an_object_of_the_vendors(tmp_path: Path, usual: Record) -> None:
    own = "[2030]\nParameterName=Second feedback\nDataType=0x0006\nAccessType=ro\nPDOMapping=1\n"
    source = ("source: {index: 0x60E4, subindex: 1, type: int32, via: tpdo}",
              "source: {index: 0x2030, subindex: 0, type: uint16}")  # fmt: skip
    _, record = stepped(profile_with(tmp_path, without(OWN, 0x60E4) + own, source))
    offset_deg = record.columns["load_position_deg"] - usual.columns["load_position_deg"]
    # The position is negative at the start.
    assert offset_deg == pytest.approx(0x10000 * 360 / 2_880_000, abs=1e-9)


def test_identity_from_the_device_info_section(tmp_path: Path) -> None:
    eds = OWN
    for sub in (1, 2, 3):
        eds = stating(eds, f"1018sub{sub}", DefaultValue=None)
    identity = ("vendor_id: 0x4844", "vendor_id: 0x77")
    report, _ = stepped(
        profile_with(tmp_path, eds.replace("VendorNumber=0x00004844", "VendorNumber=119"), identity)
    )
    assert report.identity["vendor_id"] == 119


def test_an_axis_without_a_heartbeat_still_stops_when_its_drive_falls_silent(tmp_path: Path) -> None:
    axis = profile_with(tmp_path, without(OWN, 0x1017))
    with simulated(axis) as drive:
        drive.boot()
        assert drive.image.heartbeat_timeout_s == math.inf
        Bench(drive).run(Stepping(count=2))
