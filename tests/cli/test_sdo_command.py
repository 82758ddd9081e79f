"""`hdbridge sdo`: objects by number or name, their values by the type that the EDS gives them."""

import json

import pytest
from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.drive.dictionary import INTEGER_TYPES
from hdbridge.drive.objects import IntegerType
from hdbridge.drive.values import Object, find_object
from hdbridge.errors import InputError


@pytest.mark.parametrize(
    ("object_", "line"),
    [
        ("6064h", "6064h:00 'Position actual value': 0 (0x0)  int32"),
        ("0x6064:0", "6064h:00 'Position actual value': 0 (0x0)  int32"),
        ("position actual value", "6064h:00 'Position actual value': 0 (0x0)  int32"),
        ("1018:01", "1018h:01 'Identity object.Vendor-ID': 18500 (0x4844)  uint32"),
        ("1008", "1008h:00 'Manufacturer device name': hdbridge simulated CiA-402 servo drive  text"),
    ],
)
def test_an_object_is_read_by_number_or_name(hdbridge, object_, line):
    done = hdbridge("sdo", "get", "article", object_, "--simulate")
    assert done.stdout.splitlines() == [line]


def test_an_object_is_written_and_read_back(hdbridge, tmp_path):
    hdbridge("sdo", "set", "article", "6065h", "0x4e20", "--simulate", "--json", "out.json")
    found = json.loads((tmp_path / "out.json").read_text())
    assert (found["value"], found["type"], found["name"]) == (20000, "uint32", "Following error window")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("get", "2345h"), "2345h:00: neither the EDS nor the profile has this object"),
        (("get", "1018h:9"), "it has the sub-indices 00, 01, 02, 03, 04"),
        (("get", "Position actual"), "did you mean 'Position actual value'?"),
        (("set", "6064h", "3"), "is read-only in the EDS; nothing was written"),
        (("set", "6065h", "-3"), "found '-3'; expected an integer from 0 to 4294967295 (uint32)"),
        (("set", "6065h", "few"), "found 'few'; expected an integer"),
    ],
)
def test_requests_forbidden_by_the_eds_are_not_sent(hdbridge, arguments, complaint):
    doing, *rest = arguments
    done = hdbridge("sdo", doing, "article", *rest, "--simulate", status=2)
    assert complaint in done.stderr


def object_of(data_type: int) -> Object:
    """Object 2000h of this type."""
    od = ObjectDictionary()
    variable = ODVariable("thing", 0x2000)
    variable.data_type = data_type
    od.add_object(variable)
    return find_object("2000h", od)


@given(st.sampled_from(IntegerType), st.data())
def test_an_integer_is_read_as_it_was_written(kind, data):
    value = data.draw(st.integers(kind.minimum, kind.maximum))
    one = object_of(next(number for number, each in INTEGER_TYPES.items() if each is kind))
    assert one.decode(one.encode(str(value))) == value
    for beyond in (kind.minimum - 1, kind.maximum + 1):
        with pytest.raises(InputError, match="nothing was written"):
            one.encode(str(beyond))


@pytest.mark.parametrize(
    ("data_type", "text", "data", "value"),
    [
        (datatypes.REAL32, "1.5", b"\x00\x00\xc0\x3f", 1.5),
        (datatypes.BOOLEAN, "true", b"\x01", True),
        (datatypes.VISIBLE_STRING, "abc", b"abc", "abc"),
        (datatypes.OCTET_STRING, "01 ff", b"\x01\xff", "01 ff"),
    ],
)
def test_other_types_are_read_as_they_were_written(data_type, text, data, value):
    one = object_of(data_type)
    assert one.encode(text) == data
    assert one.decode(data) == value


@pytest.mark.parametrize("data_type", [datatypes.REAL64, datatypes.BOOLEAN])
def test_an_answer_of_the_wrong_length_is_rejected(data_type):
    with pytest.raises(InputError, match="check that drive"):
        object_of(data_type).decode(b"\x01\x02\x03")
