"""The EDS is valid, complete, and consistent with the node."""

import logging
import re
import struct
from configparser import RawConfigParser
from contextlib import contextmanager
from pathlib import Path

import canopen
import pytest

from hdbridge.errors import InputError
from hdbridge.sim.lockstep import lockstep_bench
from tests.device.conftest import RawMaster

EDS = Path(__file__).parents[2] / "eds" / "hdbridge-402.eds"


@pytest.fixture(scope="module")
def sections() -> RawConfigParser:
    parser = RawConfigParser()
    parser.optionxform = str
    parser.read(EDS)
    return parser


def test_canopen_reads_it_without_a_complaint(caplog):
    with caplog.at_level(logging.DEBUG):
        canopen.import_od(str(EDS), 1)
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []


def test_the_lists_name_every_object_once(sections):
    listed = []
    for name in ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects"):
        count = int(sections[name]["SupportedObjects"])
        assert set(sections[name]) == {"SupportedObjects", *(str(k) for k in range(1, count + 1))}
        listed += [int(sections[name][str(k)], 16) for k in range(1, count + 1)]
    described = [int(name, 16) for name in sections.sections() if len(name) == 4]
    assert sorted(listed) == sorted(described)


def test_sub_numbers_are_right(sections):
    compound = [name for name in sections.sections() if len(name) == 4 and "SubNumber" in sections[name]]
    assert {"1018", "1A00"} <= set(compound)
    for name in compound:
        subs = [other for other in sections.sections() if other.startswith(name + "sub")]
        assert int(sections[name]["SubNumber"]) == len(subs), name


NO_OBJECT, NO_SUBINDEX, READ_ONLY = 0x06020000, 0x06090011, 0x06010002


@pytest.fixture
def bench(tmp_path, motor):
    """A master of raw frames, and a drive with an edited EDS: ``bench(edit)`` is a context manager."""

    @contextmanager
    def make(*edits):
        text = EDS.read_text()
        for pattern, new in edits:
            text, count = re.subn(pattern, new, text)
            assert count, pattern
        path = tmp_path / "own.eds"
        path.write_text(text)
        with lockstep_bench(motor, path) as (bus, clock, node):
            yield RawMaster(bus, clock, node, motor)

    return make


def test_objects_missing_in_the_eds_are_absent_and_the_drive_still_works(bench, motor):
    with bench((r"\[6085\][^[]*", ""), (r"\[60C2(sub\d)?\][^[]*", ""), (r"\[607Dsub2\][^[]*", "")) as master:
        assert master.abort_of_read(0x6085) == NO_OBJECT
        assert master.write(0x60C2, 1, 4, 1) == NO_OBJECT
        assert master.abort_of_read(0x607D, 2) == NO_SUBINDEX
        master.enable_csp()
        target = master.cruise(40, 25)
        master.cycle(0x0F, target)
        assert motor.motor_counts == target  # its period is that of SYNC
        for _ in range(3):
            master.cycle(0x02, target)
        assert master.state == "disabled"


def test_a_period_of_zero_is_that_of_sync(bench, motor):
    """The EDS of Elmo's SimplIQ drives describes 60C2h in this way."""
    with bench(
        (r"(\[60C2sub1\][^[]*?)DefaultValue=.*\n(?:LowLimit=.*\n)?", r"\g<1>DefaultValue=0\n")
    ) as master:
        assert master.read(0x60C2, 1) == 0
        master.wait(0.05)
        master.enable_csp()
        target = master.cruise(40, 25)
        master.cycle(0x0F, target)
        assert motor.motor_counts == target


def test_a_vendor_object_may_reuse_a_number_of_the_simulated_drive(bench, motor):
    with bench(
        (r"(\[2000\][^[]*DataType=)0x0009(\n[^[]*DefaultValue=).*", r"\g<1>0x0005\g<2>7"),
        (r"(\[2100\][^[]*DataType=)0x0003", r"\g<1>0x0009"),
        (r"(\[2101\][^[]*DataType=)0x\w+", r"\g<1>0x0006"),
    ) as master:
        motor.load_torque_nm = 3.0
        assert master.read(0x2000) == 7
        assert master.read(0x2101) == 0
        assert master.request(b"\x40\x00\x21\x00" + bytes(4))[0] >> 5 == 2


def test_objects_have_the_type_that_the_eds_gives_them(bench, motor):
    with bench((r"(\[6064\][^[]*DataType=)0x0004", r"\g<1>0x0003")) as master:
        motor.position = 40_000.0
        master.wait(0.1)
        assert master.read(0x6064) == 40_000 - 65_536


def test_a_number_declared_as_text_cannot_be_simulated(bench):
    with (
        pytest.raises(InputError, match=r"own\.eds: 6064h:00 .* data type 0009h"),
        bench((r"(\[6064\][^[]*DataType=)0x0004", r"\g<1>0x0009")),
    ):
        pass


def test_a_fixed_mapping_with_a_gap_in_it(bench, motor):
    words = "ro\nDefaultValue=3", "ro\nDefaultValue=0x00050008", "ro\nDefaultValue=0x60400010"
    fixed = [(rf"(\[1600sub{sub}\][^[]*AccessType=).*\n.*", rf"\g<1>{new}") for sub, new in enumerate(words)]
    with bench(*fixed, (r"(\[1600sub3\][^[]*DefaultValue=).*", r"\g<1>0x607A0020")) as master:
        assert master.write(0x1600, 0, 0, 1) == READ_ONLY
        master.nmt(1)
        master.send(0x201, struct.pack("<BHi", 0xFF, 0x06, 77))
        master.send(0x080)
        assert (master.state, master.read(0x607A)) == ("ready", 77)


def test_a_default_mapping_of_a_missing_object_disables_the_pdo(bench):
    with bench((r"\[6062\][^[]*", "")) as master:
        assert (master.read(0x1A01, 0), master.read(0x1A00, 0)) == (0, 3)
        master.nmt(1)
        master.take()
        master.send(0x080)
        assert [can_id for can_id, _ in master.take()] == [0x181]


def test_there_are_as_many_pdos_as_the_eds_describes(bench):
    with bench((r"\[(1[8A])03(sub\d)?\]", r"[\g<1>04\g<2>]"), (r"\[1[46]0[23](sub\d)?\][^[]*", "")) as master:
        assert master.abort_of_read(0x1803, 1) == NO_OBJECT
        assert master.abort_of_read(0x1402, 1) == NO_OBJECT
        master.map(0x1800, 5, 0x481, 0x60410010)
        master.nmt(1)
        master.take()
        master.send(0x080)
        assert 0x481 in [can_id for can_id, _ in master.take()]
