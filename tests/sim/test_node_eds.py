"""The EDS: read without a complaint, complete in itself, and true of the node."""

from __future__ import annotations

import logging
from configparser import RawConfigParser
from pathlib import Path

import can
import canopen
import pytest
from canopen.objectdictionary import ODVariable

from hdbridge.errors import InputError
from hdbridge.sim.dictionary import Dictionary
from hdbridge.sim.lockstep import VirtualClock
from hdbridge.sim.node import SimulatedDrive

EDS = Path(__file__).parents[2] / "eds" / "hdbridge-402.eds"


@pytest.fixture(scope="module")
def sections() -> RawConfigParser:
    parser = RawConfigParser()
    parser.optionxform = str
    parser.read(EDS)
    return parser


@pytest.fixture(scope="module")
def declared() -> canopen.ObjectDictionary:
    return canopen.import_od(str(EDS), 5)


def variables(declared):
    for item in declared.values():
        yield from [item] if isinstance(item, ODVariable) else item.values()


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
    for name in sections.sections():
        if len(name) == 4 and "SubNumber" in sections[name]:
            subs = [other for other in sections.sections() if other.startswith(name + "sub")]
            assert int(sections[name]["SubNumber"]) == len(subs), name


def test_defaults_lie_within_their_limits(declared):
    for variable in variables(declared):
        if isinstance(variable.default, int):
            assert variable.min is None or variable.default >= variable.min, variable.name
            assert variable.max is None or variable.default <= variable.max, variable.name


def test_default_mappings_fit_and_name_mappable_objects(declared):
    for base in (0x1600, 0x1A00):
        for number in range(4):
            mapping = declared[base + number]
            words = [mapping[sub].default for sub in range(1, mapping[0].default + 1)]
            assert sum(word & 0xFF for word in words) <= 64
            for word in words:
                item = declared[word >> 16]
                variable = item if isinstance(item, ODVariable) else item[word >> 8 & 0xFF]
                assert variable.pdo_mappable
                assert len(variable) == word & 0xFF


def test_the_load_encoder_is_a_mappable_int32(declared):
    variable = declared[0x60E4][1]
    assert (variable.data_type, variable.pdo_mappable, variable.access_type) == (0x04, True, "ro")


def test_identifiers_follow_the_node_id(declared):
    assert declared[0x1400][1].default == 0x205
    assert declared[0x1801][1].default == 0x285
    assert declared[0x1014].default == 0x085


def test_every_declared_object_answers_on_the_bus(master, declared):
    """Each readable object can be uploaded; numbers that the EDS fixes are what it says."""
    for variable in variables(declared):
        head = variable.index.to_bytes(2, "little") + bytes([variable.subindex])
        answer = master.request(b"\x40" + head + bytes(4))
        assert answer[0] >> 5 == 2, variable.name
        if variable.access_type == "const" and isinstance(variable.default, int) and answer[0] & 2:
            size = 4 - (answer[0] >> 2 & 3)
            assert answer[4 : 4 + size] == variable.encode_raw(variable.default), variable.name


@pytest.mark.parametrize(
    "content", [None, b"", b"[1000]\n", b"\xff\xfe\x00", b"[1000]\nParameterName=x\nDataType=zz\n"]
)
def test_what_is_no_eds_is_refused_in_one_line(tmp_path, content):
    path = tmp_path / "bad.eds"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=r"bad\.eds") as caught:
        Dictionary(path, 1)
    assert "\n" not in str(caught.value)


def test_an_eds_without_an_object_that_the_drive_needs_is_refused(tmp_path, motor):
    path = tmp_path / "less.eds"
    path.write_text(EDS.read_text().replace("[6041]", "[5041]"))
    with (
        can.Bus(interface="virtual", channel="less", ignore_config=True) as bus,
        pytest.raises(InputError, match="no object 6041h:00, which the simulated drive needs"),
    ):
        SimulatedDrive(bus, motor, path, 1, VirtualClock())
