"""CSV files of other benches: what is wrong is said in one line, nothing is written; the rest is read."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hdbridge.cli import app
from hdbridge.errors import InputError
from hdbridge.files import csvfile
from hdbridge.records.record import Record

RATIO = 50.0
HEADER = "time_s,motor_position_deg,load_position_deg\n"
COUNT = 200
TIME = np.arange(COUNT) * 0.01
MOTOR = np.linspace(0.0, 1440.0, COUNT)
LOAD = MOTOR / RATIO + 5.0 / 3600.0 * np.sin(np.radians(2.0 * MOTOR))


def text(
    time: np.ndarray = TIME,
    motor: np.ndarray = MOTOR,
    load: np.ndarray = LOAD,
    comma: str = ",",
    dot: str = ".",
) -> str:
    rows = zip(time.tolist(), motor.tolist(), load.tolist(), strict=True)
    lines = (comma.join(f"{value:.9f}".replace(".", dot) for value in row) for row in rows)
    return HEADER.replace(",", comma) + "\n".join(lines) + "\n"


JUMPED = np.where(np.arange(COUNT) > 100, MOTOR + 720.0, MOTOR)
WRONG = {
    "semicolons": (text(comma=";", dot=","), ":1: the columns are not separated by commas"),
    "decimal commas": (text(dot=","), ":2: 6 values; expected 3, one for each column; decimal commas?"),
    "tabs": (text(comma="\t"), ":1: the columns are not separated by commas"),
    "capitals": (text().replace("time_s", "Time_s"), ":1: column 'time_s' is missing"),
    "a row of units": (
        text().replace(HEADER, HEADER + "s,deg,deg\n"),
        ":2: load_position_deg: 'deg' is not a",
    ),
    "not a number": (text().replace("0.500000000,", "nan,"), ":52: time_s: nan; expected a finite number"),
    "a hole": (text().replace("0.500000000,", ","), ":52: time_s: no value; expected a number"),
    "time backwards": (text(time=np.r_[TIME[:100], TIME[90:190]]), ":102: time_s: 0.9 after 0.99; expected"),
    "time that stands": (text(time=0.0 * TIME), ": time_s: 0 in all 200 rows; expected time that passes"),
    "load wrapped": (text(load=(LOAD + 350.0) % 360.0), ":72: load_position_deg: 0.129375 after 359.985"),
    "motor wrapped": (text(motor=MOTOR % 360.0), ":52: motor_position_deg: 1.80905 after 354.573"),
    "motor jumps": (text(motor=JUMPED), ":103: motor_position_deg: 1450.85 after 723.618"),
    "load in radians": (text(load=np.radians(LOAD)), "the load's angle looks like radians"),
    "motor in radians": (text(motor=np.radians(MOTOR)), "the motor's angle looks like radians"),
    "load in radians, ratio a little off": (
        text(load=np.radians(1.004 * LOAD)),
        "the load's angle looks like radians: convert it to degrees (then it is 0.4 % off",
    ),
    "motor in counts": (
        text(motor=MOTOR * 8000.0 / 360.0),
        "the motor's angle looks like counts, some 8000 to",
    ),
    "both in counts": (
        text(motor=np.round(MOTOR * 8000.0 / 360.0), load=np.round(LOAD * 2.88e6 / 360.0)),
        ": load_position_deg: whole numbers only (",
    ),
    "motor in turns": (text(motor=MOTOR / 360.0), "the motor's angle looks like turns"),
    "motor at the output": (text(motor=MOTOR / RATIO), "multiply it by the ratio"),
    "exchanged": (text(motor=LOAD, load=MOTOR), "the columns of motor and load are exchanged"),
    "against each other": (text(load=-LOAD), "turn the direction of one encoder round"),
    "another gear": (text(motor=1.02 * MOTOR), "the motor makes 51.001 turns per turn of the load"),
    "a load that stands": (text(load=0.0 * LOAD), "the load stands still while the motor turns"),
    "no motion": (text(motor=0.0 * MOTOR, load=0.0 * LOAD), ": the motor never moves in 200 samples"),
    "few samples": ("".join(text().splitlines(keepends=True)[:21]), "20 "),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "model.yaml").write_text(f"schema: hdbridge.model/1\nratio: {RATIO:g}\neffects: []\n")
    return tmp_path


def commands(path: Path) -> list[list[str]]:
    """The two commands that take anybody's records, asked to write all that they can."""
    beside = path.parent
    out = ["--json", str(beside / "out.json"), "--html", str(beside / "out.html")]
    return [
        [
            "diagnose",
            str(path),
            "--model",
            str(beside / "model.yaml"),
            *out,
            "--extend",
            str(beside / "new.yaml"),
        ],
        ["fit", str(path), "--ratio", f"{RATIO:g}", *out, "--out", str(beside / "new.yaml")],
    ]


@pytest.mark.parametrize(("content", "expected"), WRONG.values(), ids=WRONG.keys())
def test_what_is_wrong_is_said_in_one_line_and_nothing_is_written(
    folder: Path, content: str, expected: str
) -> None:
    path = folder / "bench.csv"
    path.write_text(content)
    for command in commands(path):
        result = CliRunner().invoke(app, command)
        assert isinstance(result.exception, InputError), result.output
        assert result.exception.exit_status == 2
        message = str(result.exception)
        assert message.startswith(f"{path}")
        assert "\n" not in message
        assert expected in message
        assert sorted(each.name for each in folder.iterdir()) == ["bench.csv", "model.yaml"]


AS_IT_COMES = {
    "Windows line ends": text().replace("\n", "\r\n").encode(),
    "old line ends": text().replace("\n", "\r").encode(),
    "a byte-order mark": b"\xef\xbb\xbf" + text().encode(),
    "spaces": text(comma=", ").encode(),
    "quotes": text().replace(",", '","').replace("\n", '"\n"').join(['"', ""])[:-1].encode(),
    "gzip without the name": gzip.compress(text().encode()),
    "another order, and more": ("\n".join(f"x,{line}" for line in text().splitlines()) + "\n").encode(),
}


@pytest.mark.parametrize("content", AS_IT_COMES.values(), ids=AS_IT_COMES.keys())
def test_what_other_programs_write_reads_the_same(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "plain.csv").write_text(text())
    (tmp_path / "bench.csv").write_bytes(content)
    plain, other = (Record.read_csv(tmp_path / name) for name in ("plain.csv", "bench.csv"))
    for name in ("time_s", "motor_position_deg", "load_position_deg"):
        np.testing.assert_array_equal(other.columns[name], plain.columns[name])


@pytest.mark.parametrize("compressed", [False, True], ids=["plain", "gzip"])
def test_a_file_too_large_to_hold_is_refused_before_it_is_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compressed: bool
) -> None:
    monkeypatch.setattr(csvfile, "MAXIMUM_BYTES", 1 << 12)
    path = tmp_path / "bench.csv"
    path.write_bytes(gzip.compress(text().encode()) if compressed else text().encode())
    with pytest.raises(InputError, match="split the record"):
        Record.read_csv(path)


def test_samples_taken_twice_change_nothing_that_is_said(folder: Path) -> None:
    path = folder / "bench.csv"
    twice = np.r_[0:100, 99:199]
    path.write_text(text(TIME[twice], MOTOR[twice], LOAD[twice]))
    result = CliRunner().invoke(app, commands(path)[0], catch_exceptions=False)
    assert result.exit_code == 0
    assert (folder / "out.json").is_file()


def test_milliseconds_are_told_by_what_they_look_like(folder: Path) -> None:
    path = folder / "bench.csv"
    path.write_text(text(time=1000.0 * TIME))
    result = CliRunner().invoke(app, commands(path)[0], catch_exceptions=False)
    assert result.exit_code == 0
    assert "if these are milliseconds, divide them by 1000" in " ".join(result.stderr.split())


def test_a_measurement_that_is_named_twice_is_refused(folder: Path) -> None:
    (folder / "bench.csv").write_text(text())
    (folder / "copy.csv").write_text(text())
    for other, said in (("copy.csv", "holds the same samples as"), ("bench.csv", "is named twice")):
        for name, first, *options in commands(folder / "bench.csv"):
            result = CliRunner().invoke(app, [name, first, str(folder / other), *options])
            assert isinstance(result.exception, InputError), result.output
            assert said in str(result.exception)
            assert not (folder / "new.yaml").exists()
