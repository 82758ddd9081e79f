"""EDS files as vendors ship them: encodings, letter case, unusual numbers, compact descriptions."""

# ruff: noqa: E501  (tables)

import re

import pytest

from hdbridge.errors import InputError
from hdbridge.files.edsfile import read_eds
from hdbridge.files.profile import bundled_folder

TEXT = (bundled_folder("eds") / "hdbridge-402.eds").read_text()
SECTIONS = re.split(r"^(?=\[)", TEXT, flags=re.MULTILINE)[1:]
COMPACT = """[DeviceInfo]
VendorNumber=5
[1003]
ParameterName=Pre-defined error field
ObjectType=0x8
DataType=0x0007
AccessType=ro
CompactSubObj=3
[1003Name]
NrOfEntries=1
2=The one before
[1A00]
ParameterName=Mapping
ObjectType=0x9
CompactSubObj=2
DataType=7
AccessType=rw
DefaultValue=0
[1A00sub0]
ParameterName=Number
DataType=5
AccessType=rw
DefaultValue=2
[1A00Value]
NrOfEntries=2
1=0x60410010
2=0x60640020
"""


def described(dictionary):
    """Returns the entries of a file for each object."""
    found = {}
    for entry in dictionary.values():
        for each in [entry] if hasattr(entry, "data_type") else entry.subindices.values():
            found[each.index, each.subindex] = (
                each.name, each.data_type, each.access_type, each.pdo_mappable, each.min, each.max, each.default,
            )  # fmt: skip
    return found


def read(tmp_path, content, node_id=1):
    path = tmp_path / "drive.eds"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_eds(path, node_id)


@pytest.fixture(scope="module")
def original():
    return described(read_eds(bundled_folder("eds") / "hdbridge-402.eds", 1).dictionary)


def keys_in(case):
    return re.sub(r"^([A-Za-z_]+)(?==)", lambda m: getattr(m[1], case)(), TEXT, flags=re.MULTILINE)


def sections_in(case):
    return re.sub(r"^\[.*\]", lambda m: getattr(m[0], case)(), TEXT, flags=re.MULTILINE)


@pytest.mark.parametrize(
    "content",
    [
        TEXT.replace("\n", "\r\n").encode(),
        TEXT.replace("\n", "\r").encode(),
        TEXT.encode() + b"\x1a",
        TEXT.encode() + b"\x1a[1000]\nDataType=zz\n",
        keys_in("lower"),
        keys_in("upper"),
        sections_in("lower"),
        sections_in("upper"),
        TEXT.replace("PDOMapping=1", "PDOMapping=True").replace("PDOMapping=0", "PDOMapping=FALSE"),
        TEXT.replace("PDOMapping=0", "PDOMapping="),
        re.sub("^", "  ", TEXT, flags=re.MULTILINE),
        TEXT.replace("=", " = "),
        TEXT.replace("AccessType=ro", "AccessType=RO ; read only"),
        re.sub(r"\[(DummyUsage|Comments)\][^[]*", "", TEXT),
        TEXT.replace("Lines=3", "Lines=many").replace("Dummy0001=0", "Dummy0001="),
        TEXT.replace("$NODEID+0x", "$NodeID + 0x"),
        re.sub(r"=\$NODEID\+(0x\w+)", r"=\1+$NODEID", TEXT),
        TEXT.replace("SubNumber=", "SubNumber=0"),
        TEXT + "[DeviceComissioning]\nNodeID=seven\nBaudrate=1 Mbit/s\n",
        "".join(sorted(SECTIONS, reverse=True)),
    ],
)  # fmt: skip
def test_equivalent_spellings_give_the_same_dictionary(tmp_path, original, content):
    found = read(tmp_path, content)
    assert described(found.dictionary) == original
    assert found.unread == ()


@pytest.mark.parametrize(
    ("mark", "encoding"),
    [
        *((b"", each) for each in ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "windows-1252")),
        (b"\xfe\xff", "utf-16-be"),
    ],
)
def test_names_are_read_in_any_encoding(tmp_path, original, mark, encoding):
    name = "Lageistwert f\u00fcr 25 \u00b0C"
    content = mark + TEXT.replace("Position actual value", name).encode(encoding)
    found = described(read(tmp_path, content).dictionary)
    assert found.pop((0x6064, 0))[0] == name
    assert found == {key: value for key, value in original.items() if key != (0x6064, 0)}


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("001", 1),
        ("0x00004844", 0x4844),
        ("", None),
        ("0x", None),
        ("none", None),
        (" 12 ", 12),
        ("0X1F", 31),
    ],
)
def test_the_vendor_number_is_read_or_missing(tmp_path, original, text, number):
    found = read(tmp_path, TEXT.replace("VendorNumber=0x00004844", f"VendorNumber={text}"))
    assert described(found.dictionary) == original
    assert found.dictionary.device_information.vendor_number == number
    odd = text in {"0x", "none"}
    assert [each.split(": ", 1)[0] for each in found.unread] == odd * [f"{tmp_path}/drive.eds:16"]
    assert all("[DeviceInfo] VendorNumber" in each for each in found.unread)


@pytest.mark.parametrize(
    ("key", "text", "value"),
    [
        ("LowLimit", "-0x3", -3),
        ("LowLimit", "0xFFFD", -3),
        ("HighLimit", "010", 10),
        ("DefaultValue", "0xFFFF", -1),
        ("DefaultValue", "007", 7),
    ],
)
def test_numbers_of_a_signed_object(tmp_path, key, text, value):
    eds = re.sub(rf"(\[605A\][^[]*?{key}=).*", rf"\g<1>{text}", TEXT)
    variable = read(tmp_path, eds).dictionary[0x605A]
    assert getattr(variable, {"LowLimit": "min", "HighLimit": "max", "DefaultValue": "default"}[key]) == value


def test_unreadable_limits_are_ignored_and_reported(tmp_path):
    found = read(tmp_path, re.sub(r"(\[605A\][^[]*?HighLimit=).*", r"\g<1>eight", TEXT))
    line = 1 + found_line(re.sub(r"(\[605A\][^[]*?HighLimit=).*", r"\g<1>eight", TEXT), "HighLimit=eight")
    assert found.dictionary[0x605A].max is None
    place = f"{tmp_path}/drive.eds:{line}: [605A] HighLimit"
    assert found.unread == (f"{place}: 'eight' is not a number and counts as not given",)


def found_line(text, piece):
    return text[: text.index(piece)].count("\n")


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("[6064]\n", "[6064]\nDataType=long\n", "[6064] DataType: found 'long'; expected a number"),
        ("[6064]\n", "[6064]\nObjectType=VAR\n", "[6064] ObjectType: found 'VAR'; expected a number"),
        ("[6064]\n", "[6064]\nObjectType=0x3\n", "[6064] ObjectType: found '0x3'; expected 2, 5, 6, 7"),
        ("[6064]\n", "[6064]\nAccessType=yes\n", "[6064] AccessType: found 'yes'; expected ro, wo, rw"),
        ("[6064]\n", "[6064]\nPDOMapping=maybe\n", "[6064] PDOMapping: found 'maybe'; expected 0 or 1"),
        ("[6064]\n", "[6064]\nnonsense\n", "[6064]: found 'nonsense'; expected a key, '=' and a value"),
        ("[60C2sub1]\n", "[60C2sub1]\nDataType=u8\n", "[60C2sub1] DataType: found 'u8'; expected a number"),
        ("[1003]\n", "[1003]\nCompactSubObj=999\n", "[1003] CompactSubObj: found '999'; expected a number from"),
    ],
)  # fmt: skip
def test_unreadable_mandatory_keys_are_refused_with_their_location(tmp_path, old, new, place):
    content = TEXT.replace(old, new, 1)
    line = found_line(content, new) + 2
    with pytest.raises(InputError) as caught:
        read(tmp_path, content)
    assert str(caught.value).startswith(f"{tmp_path}/drive.eds:{line}: {place}")


def test_an_object_without_a_type_is_refused(tmp_path):
    content = re.sub(r"(\[6064\][^[]*?)DataType=.*\n", r"\1", TEXT)
    with pytest.raises(InputError, match=r"\[6064\] DataType: found nothing; expected a number"):
        read(tmp_path, content)


def test_the_first_of_duplicate_keys_or_sections_counts(tmp_path, original):
    found = read(tmp_path, TEXT + "[6064]\nParameterName=Another\nDataType=zz\n")
    assert described(found.dictionary) == original


def test_compact_objects_are_expanded(tmp_path):
    found = described(read(tmp_path, COMPACT).dictionary)
    assert [found[0x1003, sub][0] for sub in range(4)] == [
        "Number of entries",
        "Pre-defined error field1",
        "The one before",
        "Pre-defined error field3",
    ]
    assert found[0x1003, 0][6] == 3
    assert (0x1003, 4) not in found
    assert [found[0x1A00, sub][6] for sub in range(3)] == [2, 0x60410010, 0x60640020]
    assert found[0x1A00, 0][0] == "Number"


def test_compact_pdos_are_expanded_next_to_those_with_sections(tmp_path):
    lacking = re.sub(r"\[1(4|6|8|A)0[123](sub\d)?\][^[]*", "", TEXT).replace(
        "CompactPDO=0", "CompactPDO=0x13"
    )
    found = described(read(tmp_path, lacking, node_id=5).dictionary)
    for base, can_id in ((0x1400, 0x200), (0x1800, 0x180)):
        for number in range(4):
            assert found[base + number, 1][6] == can_id + 0x100 * number + 5
            assert found[base + number, 5][1] == 6
            assert found[base + 0x200 + number, 8][1] == 7
        assert (base + 4, 1) not in found
        assert (base, 3) in found
        assert (base + 1, 3) not in found


def test_members_without_their_object_describe_it(tmp_path, original):
    found = described(read(tmp_path, re.sub(r"\[60C2\][^[]*", "", TEXT)).dictionary)
    assert found == original


def test_a_type_of_the_files_own(tmp_path):
    own = "[A0]\nParameterName=x\n[A0sub1]\nDefaultValue=0x03\n[2500]\nDataType=0x00A0\nAccessType=rw\n"
    dictionary = read(tmp_path, TEXT + own + "[2501]\nDataType=0x00A1\n").dictionary
    assert (dictionary[0x2500].data_type, dictionary[0x2500].name) == (3, "2500")
    assert (dictionary[0x2501].data_type, dictionary[0x2501].access_type) == (0x0F, "rw")


@pytest.mark.parametrize(
    "content", [b"", b"\x1a", b"\xff\xfe", b"not an EDS", b"[FileInfo]\nFileName=x\n", b"\0" * 999]
)
def test_files_that_are_not_eds_are_refused(tmp_path, content):
    with pytest.raises(InputError, match=r"drive\.eds: cannot be read as an EDS"):
        read(tmp_path, content)


def test_a_huge_file_is_refused_before_it_is_read(tmp_path):
    with (tmp_path / "drive.eds").open("wb") as file:
        file.truncate(17 << 20)
    with pytest.raises(InputError, match="is larger than 16 MiB"):
        read_eds(tmp_path / "drive.eds", 1)
