"""Whatever bytes a file holds, it is read or refused in one line; nothing else ever comes out."""

# ruff: noqa: E501  (tables)

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from hdbridge.axis import AxisConfig
from hdbridge.errors import InputError
from hdbridge.files.yamlfile import load_yaml
from hdbridge.model import TransmissionModel
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
