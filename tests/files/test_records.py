"""Records: exact round trip, one exact line for bad input, ratio check, several as one."""

# ruff: noqa: E501  (the table of complaints shows each on one line)

import gzip
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.axis.effects import Channel
from hdbridge.axis.model import TransmissionModel
from hdbridge.errors import InputError
from hdbridge.records.record import OPTIONAL, REQUIRED, Record, concatenate

HEAD = "time_s,motor_position_deg,load_position_deg"


def record(samples: int = 101, ratio: float = 50.0, travel_deg: float = 400.0, **more) -> Record:
    motor = np.linspace(0.0, travel_deg * ratio, samples)
    return Record(
        {
            "time_s": np.arange(samples) * 0.004,
            "motor_position_deg": motor,
            "load_position_deg": motor / ratio,
            **more,
        }
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (b"", ": the file is empty; expected a header line and one row per sample"),
        (b"\n\n", ": the file is empty; expected a header line and one row per sample"),
        (b"time_s,motor_position_deg\n0,1\n", ":1: column 'load_position_deg' is missing; found time_s, motor_position_deg; pass --columns load=COLUMN"),
        (b"time_s,motor_position_deg,load_pos_deg\n0,1,2\n", ":1: column 'load_position_deg' is missing; found time_s, motor_position_deg, load_pos_deg; pass --columns load=load_pos_deg"),
        (b"time_s;motor_position_deg;load_position_deg\n0;1;2\n1;1;x\n", ":3: load_position_deg: 'x' is not a number; expected a number"),
        (b"0,1,2\n1,2,3\n", ": the first line holds numbers and columns 'time_s', 'motor_position_deg', 'load_position_deg' are missing; name the columns by their numbers, 1 to 3: --columns time=N,motor=N,load=N"),
        (f"{HEAD},time_s\n0,1,2,3\n".encode(), ":1: two columns are called 'time_s'; expected each name once: name the column by its number, as in 1"),
        (f"{HEAD}\n0,1,2\n1,abc,2\n".encode(), ":3: motor_position_deg: 'abc' is not a number; expected a number"),
        (f"{HEAD}\n0,1,2\n1,,2\n".encode(), ":3: motor_position_deg: no value; expected a number"),
        (f"{HEAD}\n0,1,2\n1,1_0,2\n".encode(), ":3: motor_position_deg: '1_0' is not a number; expected a number"),
        (f"{HEAD}\n0,1,2\n\n1,1,nan\n".encode(), ":4: load_position_deg: nan; expected a finite number"),
        (f"{HEAD}\n0,1,2\n1,1,-inf\n".encode(), ":3: load_position_deg: -inf; expected a finite number"),
        (f'{HEAD}\n0,1,2\n\n1,"1,2\n2,1,2\n'.encode(), ":4: not CSV: unexpected end of data; expected quotes in pairs"),
        (f'{HEAD}\n0,1,2\n\n1,"1,2\n{"2,1,2{nl}" * 30000}'.replace("{nl}", chr(10)).encode(), ":4: not CSV: field larger than field limit (131072); expected quotes in pairs"),
        (f"{HEAD},temperature_c\n0,1,2,20\n1,1,2,nan\n".encode(), ":3: temperature_c: nan; expected a finite number"),
        (f"{HEAD},temperature_c\n0,1,2,20\n1,1,2,\n".encode(), ":3: temperature_c: no value; expected a number"),
        (f"\n{HEAD}\r\n0,1,2\r\n1,1,x\r\n".encode(), ":4: load_position_deg: 'x' is not a number; expected a number"),
        (f"{HEAD}\n0,1,2\n2,1,2\n\n1.5,1,2\n".encode(), ":5: time_s: 1.5 after 2; expected times that do not decrease: sort the samples, or split the record"),
        (f"{HEAD}\n0,1,2\n1,1\n".encode(), ":3: 2 values; expected 3, one for each column"),
        (f"{HEAD}\n0,1,2\n1,1,2,3\n".encode(), ":3: 4 values; expected 3, one for each column"),
        (f"{HEAD}\n0,1,2,3\n1,1,2,3\n".encode(), ":2: 4 values; expected 3, one for each column"),
        (f"{HEAD}\n0,1,2\n".encode(), ": 1 sample; expected at least 2"),
        (f"{HEAD}\n".encode(), ": 0 samples; expected at least 2"),
        (f"{HEAD},note\n0,1,2,\x81\n".encode("latin-1"), ":2: neither UTF-8 nor Windows-1252 text; expected CSV in UTF-8"),
        (b"PK\x03\x04\x14\x00\x06\x00\x08\x90", ": a ZIP archive, such as an Excel workbook; expected CSV: export the samples as CSV"),
        (b"\0" * 4096, ":1: a null byte; expected CSV in UTF-8: the file is binary, or its writer lost power: then delete the lines from this one on"),
        (f"{HEAD}\n0,1,2\n1,1,2\n1,1".encode() + b"\0" * 512, ":4: a null byte; expected CSV in UTF-8: the file is binary, or its writer lost power: then delete the lines from this one on"),
        (b"PAR1\x15\x04\x15\x00\x90", ": a Parquet file; expected CSV: export the samples as CSV"),
        (gzip.compress(f"{HEAD}\n0,1,2\n".encode(), mtime=0)[:-9], ": gzip data are damaged or cut off (Compressed file ended before the end-of-stream marker was reached)"),
    ],
)  # fmt: skip
def test_bad_input_gets_one_line_with_file_and_row(tmp_path, text, expected):
    path = tmp_path / "record.csv"
    path.write_bytes(text)
    with pytest.raises(InputError) as caught:
        Record.read_csv(path)
    assert str(caught.value) == f"{path}{expected}"


@pytest.mark.parametrize("cell", ["nan", "1e308"])
def test_a_value_without_a_meaning_is_named_by_the_column_of_the_file(tmp_path, cell):
    path = tmp_path / "record.csv"
    path.write_text(f"t,theta,{HEAD.rpartition(',')[2]}\n0,1,2\n1,{cell},2\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"record\.csv:3: theta: (nan|inf); expected a finite number$"):
        Record.read_csv(path, columns="time=t,motor=theta", units="motor=turns")


def test_files_that_cannot_be_read_at_all(tmp_path):
    (tmp_path / "plain.csv.gz").write_text(HEAD)
    with pytest.raises(InputError, match=r"absent\.csv: no such file$"):
        Record.read_csv(tmp_path / "absent.csv")
    with pytest.raises(InputError, match=r": cannot be read: Is a directory$"):
        Record.read_csv(tmp_path)
    with pytest.raises(
        InputError,
        match=r"plain\.csv\.gz: not gzip data; expected a compressed file, or a name without \.gz$",
    ):
        Record.read_csv(tmp_path / "plain.csv.gz")


COLUMN = st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=4, max_size=4)
KNOWN = {"words", *REQUIRED, *OPTIONAL}
NAMES = st.text(min_size=1, max_size=8).filter(
    lambda name: name == name.strip() and name.isprintable() and name not in KNOWN
)


@given(
    st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=4, max_size=4).map(sorted),
    COLUMN,
    COLUMN,
    st.dictionaries(NAMES, COLUMN | st.lists(st.floats(), min_size=4, max_size=4), max_size=2),
    st.lists(st.text(alphabet='a",\n x', max_size=4).map(lambda text: "t" + text + "t"), min_size=4, max_size=4),
    st.sampled_from(["record.csv", "record.csv.gz"]),
)  # fmt: skip
def test_every_number_reads_back_to_the_last_bit(tmp_path_factory, time, motor, load, more, words, name):
    path = tmp_path_factory.mktemp("records") / name
    columns = {"time_s": time, "motor_position_deg": motor, "load_position_deg": load, **more}
    columns["words"] = words  # type: ignore[assignment]
    written = Record({name: np.array(values) for name, values in columns.items()})
    written.write_csv(path)
    assert Record.read_csv(path) == written


def test_the_same_record_gives_the_same_bytes(tmp_path):
    for name in ("a.csv.gz", "b.csv.gz", "a.csv"):
        record(temperature_c=np.full(101, 20.1)).write_csv(tmp_path / name)
    assert (tmp_path / "a.csv.gz").read_bytes() == (tmp_path / "b.csv.gz").read_bytes()
    assert gzip.decompress((tmp_path / "a.csv.gz").read_bytes()) == (tmp_path / "a.csv").read_bytes()
    assert (tmp_path / "a.csv").read_text().startswith(f"{HEAD},temperature_c\n0.0,0.0,0.0,20.1\n")


def test_files_of_other_tools_are_read(tmp_path):
    path = tmp_path / "theirs.csv"
    path.write_bytes(
        b'\xef\xbb\xbf"time_s", motor_position_deg,load_position_deg,mode,rare\r\n'
        b"0,100,2,hold,\r\n\r\n1e-2, 1.01e2 ,+2.02,hold,7\r\n0.01,.5,2.,move,\r\n"
    )
    theirs = Record.read_csv(path)
    assert theirs.time_s.tolist() == [0.0, 0.01, 0.01]
    assert theirs.motor_position_deg.tolist() == [100.0, 101.0, 0.5]
    assert theirs.columns["mode"].tolist() == ["hold", "hold", "move"]
    assert np.array_equal(theirs.columns["rare"], [np.nan, 7.0, np.nan], equal_nan=True)
    assert theirs.source == str(path)


def test_a_record_cannot_be_changed():
    one = record()
    with pytest.raises(ValueError, match="read-only"):
        one.time_s[0] = 1.0
    with pytest.raises(TypeError):
        one.columns["more"] = one.time_s  # type: ignore[index]


def test_columns_must_be_there_and_of_one_length():
    with pytest.raises(ValueError, match="needs the columns load_position_deg"):
        Record({"time_s": np.zeros(2), "motor_position_deg": np.zeros(2)})
    with pytest.raises(ValueError, match="of one length"):
        Record({"time_s": np.zeros(2), "motor_position_deg": np.zeros(2), "load_position_deg": np.zeros(3)})


def test_the_transmission_error_is_positive_for_a_leading_load():
    one = Record(
        {
            "time_s": np.arange(2.0),
            "motor_position_deg": np.array([0.0, 50.0]),
            "load_position_deg": np.array([0.0, 1.0 + 1 / 3600]),
        }
    )
    assert one.transmission_error_arcsec(50.0) == pytest.approx([0.0, 1.0])


def test_a_model_follows_the_commanded_angle_if_recorded():
    target = np.linspace(0.0, 1.0, 101)
    assert record(motor_target_deg=target).motion().motor_deg.tolist() == target.tolist()
    one = record(load_torque_nm=np.ones(101))
    assert one.motion().motor_deg.tolist() == one.motor_position_deg.tolist()
    assert Channel.LOAD_TORQUE in one.motion().measured
    assert Channel.TEMPERATURE not in one.motion().measured


@pytest.mark.parametrize(
    ("one", "ratio", "expected"),
    [
        (record(ratio=40.0), 50.0, "the motor makes 40 turns per turn of the load (measured over 320 deg of the load); expected a ratio of 50: correct the ratio, or the counts per turn of an encoder"),
        (record(ratio=160.0), 161.0, "the motor makes 160 turns per turn of the load (measured over 398 deg of the load); expected a ratio of 161: correct the ratio, or the counts per turn of an encoder"),
        (record(ratio=-50.0), 50.0, "the motor makes 50 turns per turn of the load, in the opposite direction (measured over 400 deg of the load); expected a ratio of 50: reverse the direction of one encoder"),
        (Record({**record().columns, "load_position_deg": np.zeros(101)}), 50.0, "the load stands still while the motor turns (measured over 400 deg of the load); expected a ratio of 50: look at the load encoder's column"),
    ],
)  # fmt: skip
def test_a_wrong_ratio_is_refused_with_the_measured_one(one, ratio, expected):
    with pytest.raises(InputError) as caught:
        one.check_ratio(ratio)
    assert str(caught.value) == expected


@given(
    st.floats(1, 320),
    st.floats(0.0, 400.0),
    st.floats(-180, 180),
    st.integers(0, 12),
    st.floats(0, 200),
    st.floats(-0.001, 0.001),
)
def test_a_right_ratio_is_accepted_whatever_the_gear_does(ratio, travel, zero, order, amplitude, creep):
    one = record(ratio=ratio, travel_deg=travel)
    error = amplitude * np.cos(np.radians(order * one.motor_position_deg)) / 3600
    moved = one.load_position_deg * (1 + creep) + error + zero
    Record({**one.columns, "load_position_deg": moved}).check_ratio(ratio)


def test_a_resting_axis_does_not_contradict_the_ratio():
    record(travel_deg=0.0).check_ratio(50.0)
    record(samples=0).check_ratio(50.0)


def test_concatenated_records_keep_their_starts():
    first, second = record(samples=11, extra=np.zeros(11)), record(samples=5)
    later = Record({**second.columns, "time_s": second.time_s + 100.0})
    both = concatenate([first, second, later])
    assert len(both) == 21
    assert both.starts == (0, 11, 16)
    assert list(both.columns) == ["time_s", "motor_position_deg", "load_position_deg"]
    assert both.time_s[10:16] == pytest.approx([0.04, 0.044, 0.048, 0.052, 0.056, 0.06])
    assert both.time_s[16:].tolist() == later.time_s.tolist()
    assert both.parts()[0].time_s.tolist() == first.time_s.tolist()
    assert [len(each) for each in both.parts()] == [11, 5, 5]
    assert [len(each) for each in concatenate([both, second]).parts()] == [11, 5, 5, 5]
    assert (np.diff(concatenate([both, both]).time_s) > 0).all()
    assert both.rows(11, 21).starts == (0, 5)
    assert both.rows(10, 16).starts == (0, 1)


def test_a_span_of_time_includes_both_ends():
    one = record(samples=11)
    assert one.between(0.004, 0.012).time_s.tolist() == [0.004, 0.008, 0.012]
    assert len(one.between(1.0, 2.0)) == 0


def test_a_cut_record_names_the_line_of_the_file(tmp_path):
    """However often it was cut, and whatever is refused."""
    path = tmp_path / "record.csv"
    one = record(samples=40, travel_deg=3.3)
    load = one.load_position_deg.copy()
    load[25] = 3e12
    Record({**one.columns, "load_position_deg": load}).write_csv(path)
    whole = Record.read_csv(path)
    cuts = [
        whole,
        whole.rows(7, 40),
        whole.between(whole.time_s[11], whole.time_s[30]),
        whole.rows(7, 40).rows(3, 30),
    ]
    for each in [*cuts, *cuts[-1].parts()]:
        with pytest.raises(InputError, match=r"record\.csv:27: load_position_deg: 3e\+12; "):
            diagnose(each, TransmissionModel(50.0, ()))
    bare = pickle.loads(pickle.dumps(cuts[-1]))
    with pytest.raises(InputError, match=r"record\.csv: sample 25: load_position_deg: 3e\+12; "):
        diagnose(bare, TransmissionModel(50.0, ()))


def test_a_long_record_takes_the_fast_path(tmp_path, monkeypatch):
    path = tmp_path / "long.csv"
    one = record(samples=20_000, travel_deg=3.3)
    one.write_csv(path)
    monkeypatch.setattr("hdbridge.files.csvfile.CsvFile._slow", None)
    assert Record.read_csv(path) == one
