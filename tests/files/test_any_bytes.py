"""Any bytes in a file are read or refused in one line."""

# ruff: noqa: E501  (tables)

import re

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.errors import InputError
from hdbridge.files.edsfile import read_eds
from hdbridge.files.profile import bundled_folder
from hdbridge.files.yamlfile import load_yaml
from hdbridge.records.record import Record
from hdbridge.records.recording import RecordingFile

PIECES = [
    "schema: ", "hdbridge.axis/1", "hdbridge.model/1", "ratio: ", "effects:", "effect: ", "hysteresis", "\n", "\n  ",
    "\n  - ", "- ", ": ", "{", "}", "[", "]", ",", "'", '"', "#", "&a", "*a", "!!int ", "|", ">", "---", "...", "0x",
    "1e999", ".nan", "~", "9" * 30, "-", "?", "\t", "\x85", "\ufeff", "\ud7ff", "parameters:", "drive:", "gear:",
]  # fmt: skip
YAML = st.lists(st.sampled_from(PIECES) | st.text(max_size=3), max_size=25).map("".join).map(str.encode)
CSV_PIECES = ["time_s", "motor_position_deg", "load_position_deg", ",", ",", "\n", "\r\n", "\r", '"', "1", "2.5", "nan",
              "1e999", "_", " ", ";", "\x00", "\x1f\x8b", "\ufeff", "x"]  # fmt: skip
HEADER = b"time_s,motor_position_deg,load_position_deg"
CSV = st.lists(st.sampled_from(CSV_PIECES), max_size=40).map("".join).map(str.encode)
EDS_PIECES = [
    "[", "]", "=", "\n", "[6040]\n", "[60C2sub1]\n", "[1A00]\n", "[DeviceInfo]\n", "ObjectType=", "DataType=", "AccessType=",
    "DefaultValue=", "CompactSubObj=", "CompactPDO=", "NrOfTXPDO=", "LowLimit=", "$NODEID", "+", "0x", "7", "9" * 5000, "-", "ro",
    "const", "True", ";", "\r", "\x1a", "\ufeff", "\x00", "\u00fc", "%", "9", "A0",
]  # fmt: skip
EDS = st.lists(st.sampled_from(EDS_PIECES), max_size=60).map("".join).map(str.encode)
EDS_SECTIONS = re.split(
    r"^(?=\[)", (bundled_folder("eds") / "hdbridge-402.eds").read_text(), flags=re.MULTILINE
)
QUICK = settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])


def one_line_or_nothing(read, path, content: bytes) -> None:
    path.write_bytes(content)
    try:
        read(path)
    except InputError as problem:
        text = str(problem)
        assert text.startswith(str(path))
        assert len(text.splitlines()) == 1, text


@pytest.mark.parametrize(
    "read",
    [AxisConfig.load, TransmissionModel.load, lambda path: load_yaml(path, RecordingFile)],
    ids=["axis", "model", "recording"],
)
@QUICK
@example(b'"a\\nb": 1\n"a\\nb": 2\n')
@example("\x85\ufeff: ".encode())
@given(YAML | st.binary(max_size=60))
def test_any_yaml_is_read_or_refused_in_one_line(read, tmp_path, content):
    one_line_or_nothing(read, tmp_path / "file.yaml", content)


@QUICK
@example(b'"time_s\ntime_s')
@given(CSV | st.binary(max_size=60) | CSV.map(lambda rows: HEADER + b"\n" + rows))
def test_any_csv_is_read_or_refused_in_one_line(tmp_path, content):
    one_line_or_nothing(Record.read_csv, tmp_path / "file.csv", content)


@QUICK
@given(EDS | st.binary(max_size=200) | st.text(max_size=100).map(lambda text: text.encode("utf-16")))
def test_any_eds_is_read_or_refused_in_one_line(tmp_path, content):
    one_line_or_nothing(lambda path: read_eds(path, 1), tmp_path / "file.eds", content)


@QUICK
@given(
    removed=st.sets(st.integers(0, len(EDS_SECTIONS) - 1), max_size=5),
    at=st.floats(0, 1),
    length=st.integers(0, 60),
    inserted=st.sampled_from(EDS_PIECES) | st.text(max_size=5),
)
def test_any_section_of_an_eds_may_be_missing_and_any_piece_damaged(tmp_path, removed, at, length, inserted):
    text = "".join(each for place, each in enumerate(EDS_SECTIONS) if place not in removed)
    place = int(at * len(text))
    content = (text[:place] + inserted + text[place + length :]).encode("utf-8", "surrogatepass")
    one_line_or_nothing(lambda path: read_eds(path, 1), tmp_path / "file.eds", content)
