"""CSV files of other benches: dialects, columns, units and wrapped counters; one line for each error."""

import gzip
import itertools
import math
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from hdbridge.analysis.checks import check_records
from hdbridge.analysis.prepared import gather
from hdbridge.cli import app
from hdbridge.errors import InputError
from hdbridge.files import csvfile
from hdbridge.records.columns import Unit
from hdbridge.records.record import Record
from hdbridge.records.recording import Recording
from hdbridge.records.wraps import find_wraps

RATIO = 50.0
HEADER = "time_s,motor_position_deg,load_position_deg\n"
COUNT = 200
TIME = np.arange(COUNT) * 0.01
MOTOR = np.linspace(0.0, 1440.0, COUNT)
LOAD = MOTOR / RATIO + 5.0 / 3600.0 * np.sin(np.radians(2.0 * MOTOR))


def text(time=TIME, motor=MOTOR, load=LOAD, comma=",", dot="."):
    rows = zip(time.tolist(), motor.tolist(), load.tolist(), strict=True)
    lines = (comma.join(f"{value:.9f}".replace(".", dot) for value in row) for row in rows)
    return HEADER.replace(",", comma) + "\n".join(lines) + "\n"


WRONG = {
    "capitals": (text().replace("time_s", "Time_s"), ":1: column 'time_s' is missing"),
    "not a number": (text().replace("0.500000000,", "nan,"), ":52: time_s: nan; expected a finite number"),
    "a hole": (text().replace("0.500000000,", ","), ":52: time_s: no value; expected a number"),
    "time backwards": (text(time=np.r_[TIME[:100], TIME[90:190]]), ":102: time_s: 0.9 after 0.99; expected"),
    "time that stands": (text(time=0.0 * TIME), ": time_s: 0 in all 200 rows; expected increasing times"),
    "another gear": (text(motor=1.02 * MOTOR), "the motor makes 51.001 turns per turn of the load"),
    "a load that stands": (text(load=0.0 * LOAD), "the load stands still while the motor turns"),
    **{
        f"an open quote before {name}": (
            text().replace(name, f'"{name}'),
            ":1: a quote is not closed; expected",
        )
        for name in ("time_s", "motor_position_deg", "load_position_deg")
    },
    "an open quote in a row": (
        text().replace("0.500000000,", '"0.5,'),
        ":52: not CSV: unexpected end of data",
    ),
    "no motion": (text(motor=0.0 * MOTOR, load=0.0 * LOAD), ": the motor never moves in 200 samples"),
    "few samples": ("".join(text().splitlines(keepends=True)[:21]), "20 "),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "model.yaml").write_text(f"schema: hdbridge.model/1\nratio: {RATIO:g}\neffects: []\n")
    return tmp_path


def commands(path: Path) -> list[list[str]]:
    """The two commands that take foreign records, with all their outputs."""
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
def test_errors_are_one_line_and_nothing_is_written(folder: Path, content: str, expected: str) -> None:
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


def shared(record: Record) -> np.ndarray:
    """Returns the columns of a record that `text` writes, shape (3, n); time is from the first sample."""
    angles = (record.time_s - record.time_s[0], record.motor_position_deg, record.load_position_deg)
    return np.array(angles)


ISO = [f"2026-03-01T23:59:59.{ms:03d}Z" for ms in range(0, 1000, 10)]
ISO += [f"2026-03-02 00:00:00.{ms:03d}+00:00" for ms in range(0, 1000, 10)]
ASSUMED = {
    "semicolons": (text(comma=";"), "semicolons"),
    "semicolons and decimal commas": (text(comma=";", dot=","), "semicolons; decimal commas"),
    "decimal commas": (text(dot=","), "decimal commas"),
    "tabs": (text(comma="\t"), "tabs"),
    "tabs and decimal commas": (text(comma="\t", dot=","), "tabs; decimal commas"),
    "spaces in columns": (text(comma="   "), "spaces"),
    "a row of units": (text().replace(HEADER, HEADER + "s,deg,deg\n"), "a row of units in line 2"),
    "comments": ("# bench 3\n" + text() + "# end\n", "comments left out"),
    "lines before the header": ("Bench 3\n\n" + text(), "1 line above the header left out"),
    "ISO times": (
        HEADER
        + "".join(
            f"{when},{line.split(',', 1)[1]}\n" for when, line in zip(ISO, text().split()[1:], strict=True)
        ),
        "dates or times of day in 'time_s'",
    ),
}


@pytest.mark.parametrize(("content", "remark"), ASSUMED.values(), ids=ASSUMED.keys())
def test_another_dialect_is_read_with_one_line_on_assumptions(folder, content, remark):
    path, plain = folder / "bench.csv", folder / "plain.csv"
    path.write_text(content)
    plain.write_text(text())
    record = Record.read_csv(path)
    np.testing.assert_allclose(shared(record), shared(Record.read_csv(plain)), atol=1e-9)
    result = CliRunner().invoke(app, commands(path)[0], catch_exceptions=False)
    assert result.exit_code == 0
    line = f"{path}: assumed {remark}"
    assert [each for each in result.stderr.splitlines() if "assumed" in each] == [line]


def test_a_plain_file_is_read_without_a_remark(folder: Path) -> None:
    (folder / "bench.csv").write_text(text())
    assert Record.read_csv(folder / "bench.csv").origin.remarks == ()


COUNTS_PER_TURN = 2_880_000
"""16 bits of such an encoder are 8.192 deg of the load."""
LONG_MOTOR = 3.0 * MOTOR
LONG_LOAD = LONG_MOTOR / RATIO
GRID = 360.0 / COUNTS_PER_TURN
FINE_LOAD = np.round(LONG_LOAD / GRID) * GRID


def counter(bits: int, counts: np.ndarray, start: float = 0.0) -> np.ndarray:
    """Unsigned counter with this many bits."""
    return (counts + start) % 2.0**bits


def signed(bits: int, counts: np.ndarray) -> np.ndarray:
    """A counter in two's complement."""
    return (counts + 2.0 ** (bits - 1)) % 2.0**bits - 2.0 ** (bits - 1)


WAVE = 5.0 / 3600.0 * np.sin(np.radians(8.0 * MOTOR))
TURNED = 1440.0 - np.abs(np.linspace(-1440.0, 1440.0, COUNT))
"""Motor angle there and back, with the reversal at the wrap of the angle."""
ADVISED: dict[str, tuple[str, str, str]] = {
    # content, message, advice
    "a load counter of 16 bits, in degrees": (
        text(motor=LONG_MOTOR, load=(FINE_LOAD + 3.0) % 8.192),
        "a jump of 8.192 that the other angle does not make (",
        "--unwrap load=8.192",
    ),
    "a load angle of one turn": (
        text(load=(LOAD + 350.0) % 360.0),
        ":72: load_position_deg: 0.129375 after 359.985, a jump of 360 that the other angle does not make "
        "(1 such jump); expected a multi-turn angle, but this looks like an angle that wraps after a turn",
        "--unwrap load=360",
    ),
    "a motor angle of one turn": (
        text(motor=MOTOR % 360.0),
        ":52: motor_position_deg: 1.80905 after 354.573, a jump of 360",
        "--unwrap motor=360",
    ),
    "a motor that jumps by two turns": (
        text(motor=np.where(np.arange(COUNT) > 100, MOTOR + 720.0, MOTOR)),
        ":103: motor_position_deg: 1450.85 after 723.618, a jump of 2 x 360",
        "--unwrap motor=360",
    ),
    "a motor of one turn, backwards": (
        text(motor=-MOTOR % 360.0, load=-LOAD),
        "this looks like an angle that wraps after a turn",
        "--unwrap motor=360",
    ),
    "milliseconds by name": (
        text(time=1000.0 * TIME).replace("time_s", "time_ms"),
        ":1: column 'time_s' is missing; found time_ms, motor_position_deg, load_position_deg",
        "--columns time=time_ms --units time=ms",
    ),
    "milliseconds in time_s": (
        text(time=1000.0 * TIME),
        ": time_s advances by 10 s per sample, too slow to see a motor turn; the column 'time_s' looks like",
        "--units time=ms",
    ),
    "load in radians": (
        text(load=np.radians(LOAD)),
        "the load's angle looks like radians",
        "--units load=rad",
    ),
    "motor in radians": (
        text(motor=np.radians(MOTOR)),
        "the motor's angle looks like radians",
        "--units motor=rad",
    ),
    "both in radians": (
        text(motor=np.radians(MOTOR) / 10, load=np.radians(LOAD) / 10, time=TIME),
        "if the angles are in radians",
        "--units motor=rad,load=rad",
    ),
    "both in radians, at full speed": (
        text(motor=np.radians(4.0 * MOTOR), load=np.radians(4.0 * MOTOR / RATIO + WAVE)),
        "the load's error repeats every 6.283 of the motor's angle, which is a turn in radians",
        "--units motor=rad,load=rad",
    ),
    "microseconds in time_s": (
        text(time=1e6 * TIME),
        "the column 'time_s' looks like us",
        "--units time=us",
    ),
    "a motor of one turn that reverses where it wraps": (
        text(motor=TURNED % 360.0, load=TURNED / RATIO),
        "this looks like an angle that wraps after a turn",
        "--unwrap motor=360",
    ),
    "a motor of one turn around zero": (
        text(motor=(4.0 * MOTOR + 180.0) % 360.0 - 180.0, load=4.0 * MOTOR / RATIO + WAVE),
        "a jump of 360 that the other angle does not make (16 such jumps)",
        "--unwrap motor=360",
    ),
    "motor in turns": (
        text(motor=MOTOR / 360.0),
        "the motor's angle looks like turns",
        "--units motor=turns",
    ),
    "load in arcseconds": (
        text(load=LOAD * 3600.0),
        "the load's angle looks like arcseconds",
        "--units load=arcsec",
    ),
    "motor in counts": (
        text(motor=MOTOR * 8000.0 / 360.0),
        "the motor's angle looks like counts, about 8000 per turn",
        "--units motor=counts:8000",
    ),
    "motor at the output": (
        text(motor=MOTOR / RATIO),
        "the motor's angle is that of the gear's output",
        "--units motor=50deg",
    ),
    "exchanged": (
        text(motor=LOAD, load=MOTOR),
        "the columns of motor and load are exchanged",
        "--columns motor=load_position_deg,load=motor_position_deg",
    ),
    "against each other": (
        text(load=-LOAD),
        "reverse the direction of one encoder",
        "--units load=-deg",
    ),
}


@pytest.mark.parametrize(("content", "expected", "advice"), ADVISED.values(), ids=ADVISED.keys())
def test_the_given_advice_works(folder: Path, content: str, expected: str, advice: str) -> None:
    path = folder / "bench.csv"
    path.write_text(content)
    for command in commands(path):
        result = CliRunner().invoke(app, command)
        assert isinstance(result.exception, InputError), result.output
        message = str(result.exception)
        assert expected in message
        assert f"pass {advice}" in message
        assert not {"out.json", "out.html", "new.yaml"} & {each.name for each in folder.iterdir()}
        followed = CliRunner().invoke(app, [*command, *advice.split()])
        problem = followed.exception  # a model that does not help is not the record's fault
        assert problem is None or "not written: the model" in str(problem), problem
        for name in ("out.json", "out.html", "new.yaml"):
            (folder / name).unlink(missing_ok=True)


@pytest.mark.parametrize("bits", [12, 16, 24])
@pytest.mark.parametrize("form", [counter, signed])
@pytest.mark.parametrize("backwards", [False, True])
def test_a_wrapped_counter_is_reported_with_its_size_and_unwrapped(tmp_path, bits, form, backwards):
    """Both angles in counts, of a motor encoder whose counter wraps several times."""
    counts = np.round(np.linspace(0.0, 5.3 * 2.0**bits, 400)) * (-1.0 if backwards else 1.0)
    per_turn = 2.0 ** (bits + 1)
    load = np.round(counts / RATIO * COUNTS_PER_TURN / per_turn)
    path = tmp_path / "bench.csv"
    rows = zip(np.arange(400) * 0.01, form(bits, counts), load, strict=True)
    path.write_text("t,theta_m,theta_l\n" + "".join(f"{t:.2f},{m:.0f},{angle:.0f}\n" for t, m, angle in rows))
    said = {
        "columns": "time=t,motor=theta_m,load=theta_l",
        "units": {"motor": f"counts:{per_turn:.0f}", "load": f"counts:{COUNTS_PER_TURN}"},
    }
    record = Record.read_csv(path, **said)
    with pytest.raises(InputError) as caught:
        check_records({path: record}, RATIO)
    assert f"this looks like a counter of {2**bits} counts that wraps" in str(caught.value)
    assert f"pass --unwrap motor={2**bits}" in str(caught.value)
    unwrapped = Record.read_csv(path, **said, unwrap={"motor": 2**bits})
    check_records({path: unwrapped}, RATIO)
    np.testing.assert_allclose(np.diff(unwrapped.motor_position_deg), np.diff(counts * 360.0 / per_turn))


def test_a_multi_turn_counter_is_reported_with_its_size(tmp_path: Path) -> None:
    path = tmp_path / "bench.csv"
    counts = np.round(LOAD * 2.0**26 / 360.0) + 2.0**31 - 2.0**20
    path.write_text(text(load=signed(32, counts)))
    record = Record.read_csv(path, units=f"load=counts:{2**26}")
    with pytest.raises(
        InputError, match=r"this looks like a counter of 4294967296 counts that wraps: pass --unwrap"
    ):
        check_records({path: record}, RATIO)
    unwrapped = Record.read_csv(path, units=f"load=counts:{2**26}", unwrap=f"load={2**32}")
    np.testing.assert_allclose(np.diff(unwrapped.load_position_deg), np.diff(LOAD), atol=1e-5)


@pytest.mark.parametrize("jump_deg", [12.08, 47.3, 150.0, 505.0])
def test_a_single_jump_is_not_a_counter_wrap(jump_deg: float) -> None:
    """For a reading that slips once, as in a measured record, no unwrapping is suggested."""
    slow = np.round(MOTOR / 10.0, 8)
    slipped = np.where(np.arange(COUNT) > 100, slow + jump_deg, slow)
    assert find_wraps(slipped, slow / RATIO) is None


@pytest.mark.parametrize("losses", list(itertools.product([-47.3, 47.3], repeat=2)))
@pytest.mark.parametrize("there_and_back", [False, True])
def test_lost_counts_of_equal_size_are_not_counter_wraps(
    losses: tuple[float, float], there_and_back: bool
) -> None:
    true = np.round(np.concatenate([MOTOR, MOTOR[::-1]] if there_and_back else [MOTOR]) / 10.0, 8)
    rows = np.arange(len(true))
    lost = losses[0] * (rows > 70) + losses[1] * (rows > len(rows) - 40)
    assert find_wraps(true + lost, true / RATIO) is None


@pytest.mark.parametrize("samples", [1, 2])
def test_a_reading_that_is_a_turn_off_for_one_or_two_samples_is_not_a_counter_wrap(samples: int) -> None:
    slow = np.round(MOTOR / 10.0, 8)
    for first in (50, 120):
        wrong = slow.copy()
        wrong[first : first + samples] += 360.0
        assert find_wraps(wrong, slow / RATIO) is None
    wrong[80:120] += 360.0
    assert find_wraps(wrong, slow / RATIO) is not None


def test_a_single_wrap_of_a_binary_range_of_counts_is_found() -> None:
    """The column is in degrees; the range of the 12-bit counter is 204.8 deg."""
    angle = np.round(MOTOR / 8.0 / 0.05) * 0.05
    wrapped = np.where(angle > 100.0, angle - 204.8, angle)
    found = find_wraps(wrapped, angle / RATIO)
    assert found is not None
    assert found.period_deg == pytest.approx(204.8, abs=0.1)
    slipped = np.where(angle > 100.0, angle - 190.0, angle)
    assert find_wraps(slipped, angle / RATIO) is None


def test_times_since_1970_keep_their_precision(tmp_path: Path) -> None:
    path = tmp_path / "bench.csv"
    path.write_text(text(time=1.7e15 + TIME * 1e6))
    record = Record.read_csv(path, units="time=us")
    np.testing.assert_allclose(record.time_s, TIME, atol=1e-10)


@pytest.mark.parametrize("scatter_deg", [0.3, 0.6])
def test_steps_that_differ_by_jitter_are_not_a_counter(scatter_deg: float) -> None:
    """Fast motion at 10 Hz: the two angles are sampled at different times, and two of the slips are equal."""
    random = np.random.default_rng(5)
    motor = np.cumsum(np.full(COUNT, -13.0) + random.normal(0.0, 0.5, COUNT))
    load = (motor + random.normal(0.0, scatter_deg, COUNT)) / RATIO
    motor[np.arange(COUNT) >= COUNT // 3] += 4.0 * scatter_deg
    motor[np.arange(COUNT) >= 2 * COUNT // 3] -= 4.0 * scatter_deg
    assert find_wraps(motor, load) is None


@given(
    zeros_deg=st.lists(st.floats(-500.0, 500.0), min_size=2, max_size=5),
    wrapped=st.booleans(),
)
def test_zeros_that_differ_between_records_neither_make_nor_hide_a_wrap(zeros_deg, wrapped):
    angle = np.linspace(0.0, 500.0, 100)
    motor = np.concatenate([(angle + 180.0) % 360.0 - 180.0 if wrapped else angle for _ in zeros_deg])
    load = np.concatenate([angle / RATIO + zero for zero in zeros_deg])
    found = find_wraps(motor, load, tuple(range(0, len(motor), 100)))
    assert (found is not None) == wrapped
    if found is not None:
        assert len(found.rows) == len(zeros_deg)


@given(seed=st.integers(0, 2**31))
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_errors_at_a_few_places_are_not_a_turn_in_radians(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    places = np.sort(rng.uniform(0.0, 900.0, 11))
    motor = np.repeat(places, 5)
    load = motor / RATIO + np.repeat(rng.normal(scale=5.0 / 3600.0, size=11), 5)
    path = tmp_path / "bench.csv"
    path.write_text(text(0.1 * np.arange(len(motor)), motor, load))
    check_records({path: Record.read_csv(path)}, RATIO)


@pytest.mark.parametrize("step_deg", [0.5, 3.0, 12.35, 18.8, 30.0])
def test_angles_are_taken_for_radians_only_if_they_are(tmp_path: Path, step_deg: float) -> None:
    """Some of the steps in degrees are nearly whole multiples of 2 pi; half of the record is a loop at a
    reversal.
    """
    swept = step_deg * np.arange(1500.0)
    sine = 20.0 * np.sin(np.radians(swept))
    motor = np.concatenate([swept, swept[-1] + sine])
    loop = 30.0 * np.concatenate([np.ones(1500), sine / 20.0])
    wave = 14.0 * np.cos(np.radians(2.0 * motor)) + 9.0 * np.cos(np.radians(4.0 * motor))
    load = motor / RATIO + (wave + loop) / 3600.0
    path = tmp_path / "bench.csv"
    for in_unit, error in (
        (np.asarray, nullcontext()),
        (np.radians, pytest.raises(InputError, match="radians")),
    ):
        path.write_text(text(0.02 * np.arange(len(motor)), in_unit(motor), in_unit(load)))
        with error:
            check_records({path: Record.read_csv(path)}, RATIO)


@pytest.mark.parametrize(
    ("turns", "units", "remarked"), [(1.0, None, 1), (1.0, "motor=deg", 0), (4.0, None, 0)]
)
def test_too_short_a_travel_to_know_radians_is_remarked(tmp_path, turns, units, remarked):
    path = tmp_path / "bench.csv"
    path.write_text(text(motor=MOTOR * turns / 4.0, load=MOTOR * turns / 4.0 / RATIO))
    remarks = gather(Record.read_csv(path, units=units), RATIO).remarks
    assert sum("not in radians" in each for each in remarks) == remarked


def test_a_wrapping_clock_is_reported_with_its_period(tmp_path: Path) -> None:
    path = tmp_path / "bench.csv"
    path.write_text(text(time=(TIME * 1000.0 + 65_000.0) % 65_536.0))
    with pytest.raises(InputError, match=r"times that do not decrease: .* pass --unwrap time=65536$"):
        Record.read_csv(path, units="time=ms")
    record = Record.read_csv(path, units="time=ms", unwrap="time=65536")
    np.testing.assert_allclose(np.diff(record.time_s), 0.01)


def test_a_clock_that_repeats_a_time_and_wraps_is_unwrapped_only_where_it_wraps(tmp_path: Path) -> None:
    path = tmp_path / "bench.csv"
    ticks = np.repeat(np.arange(100) * 20.0, 2)  # coarser than the sampling period
    path.write_text(text(time=(ticks + 65_000.0) % 65_536.0))
    record = Record.read_csv(path, units="time=ms", unwrap="time=65536")
    np.testing.assert_allclose(record.time_s - record.time_s[0], ticks / 1000.0, atol=1e-9)


@pytest.mark.parametrize(
    ("channel", "unit", "value", "expected"),
    [
        ("temperature", "degC", 20.0, 20.0),
        ("temperature", "K", 300.0, 26.85),
        ("temperature", "degF", 212.0, 100.0),
        ("temperature", "degF", 32.0, 0.0),
        ("temperature", "0.1degC", 235.0, 23.5),
        ("motor_torque", "Nm", 0.3, 0.3),
        ("motor_torque", "mNm", 300.0, 0.3),
        ("motor_torque", "kNm", 0.3, 300.0),
        ("motor_torque", "percent:2.5", 50.0, 1.25),
        ("motor_torque", "-permille:2.5", 100.0, -0.25),
        ("load_torque", "percent:40", -10.0, -4.0),
        ("target", "counts:8000", 2000.0, 90.0),
        ("target", "mrad", 1000.0, math.degrees(1.0)),
        ("time", "min", 2.0, 120.0),
        ("time", "ns", 5e8, 0.5),
    ],
)
def test_every_unit_has_its_factor_and_zero(channel: str, unit: str, value: float, expected: float) -> None:
    converted = Unit.parse(unit, channel).convert(np.array([value]))
    assert converted.tolist() == pytest.approx([expected])


def test_columns_of_any_name_and_unit_are_the_same_record(folder: Path) -> None:
    """The command line of `fit` and `diagnose`, and Python."""
    path = folder / "bench.csv"
    rows = zip(TIME * 1e3, MOTOR * 65536 / 360.0, np.radians(LOAD), strict=True)
    path.write_text(
        "t;theta_m;theta_l\n" + "".join(f"{t:.3f};{m:.9f};{angle:.15f}\n" for t, m, angle in rows)
    )
    columns, units = "motor=theta_m,load=theta_l,time=t", "motor=counts:65536,load=rad,time=ms"
    record = Recording.load(path, columns=columns, units=units).record
    np.testing.assert_allclose(shared(record), [TIME, MOTOR, LOAD], atol=1e-9)
    by_number = Record.read_csv(path, columns={"motor": 2, "load": 3, "time": 1}, units=units)
    assert by_number == record
    for command in commands(path):
        result = CliRunner().invoke(app, [*command, "--columns", columns, "--units", units])
        assert result.exception is None, result.exception


@given(
    time=st.sampled_from([("s", 1.0), ("ms", 1e3), ("us", 1e6), ("min", 1 / 60)]),
    angles=st.tuples(*2 * [st.sampled_from([("deg", 1.0), ("rad", math.pi / 180), ("turns", 1 / 360),
        ("arcsec", 3600.0), ("counts:8192", 8192 / 360), ("-counts:131072", -131072 / 360)])]),
    separator=st.sampled_from([",", ";", "\t", "|", "  "]),
    comma=st.booleans(),
    order=st.permutations([0, 1, 2]),
    junk=st.sampled_from(["", "# by a logger\n", "Logger 4.2\n\n"]),
    end=st.sampled_from(["\n", "\r\n", "\r"]),
    compressed=st.booleans(),
)  # fmt: skip
def test_units_separators_and_order_do_not_change_a_record(
    tmp_path_factory, time, angles, separator, comma, order, junk, end, compressed
):
    path = tmp_path_factory.getbasetemp() / "any.csv"
    values = [array * unit[1] for array, unit in zip((TIME, MOTOR, LOAD), (time, *angles), strict=True)]
    names = ["clock", "phi_a", "phi_b"]
    lines = [separator.join(names[each] for each in order)]
    for row in zip(*values, strict=True):
        line = separator.join(f"{row[each]:.12f}" for each in order)
        lines.append(line.replace(".", ",") if comma else line)
    content = (junk + "\n".join(lines) + "\n").replace("\n", end).encode()
    path.write_bytes(gzip.compress(content) if compressed else content)
    (tunit, _), ((munit, _), (lunit, _)) = time, angles
    record = Record.read_csv(
        path, columns="time=clock,motor=phi_a,load=phi_b", units=f"time={tunit},motor={munit},load={lunit}"
    )
    np.testing.assert_allclose(shared(record), [TIME, MOTOR, LOAD], atol=1e-7)


OPTIONS = {
    "no such channel": (["--columns", "moter=a"], "did you mean motor?"),
    "no such unit": (["--units", "load=radian_s"], "--units: load=radian_s: no such unit; expected deg, rad"),
    "counts of no turn": (["--units", "motor=counts"], "expected counts:N with N the counts per turn"),
    "no period": (["--unwrap", "motor=nan"], "--unwrap: motor=nan: expected the period of the counter"),
    "no such column": (["--columns", "motor=theta"], "column 'theta' is missing; found time_s,"),
    "one column for two": (["--columns", "motor=load_position_deg"], "is both load and motor"),
    "no target": (["--units", "target=rad"], "there is no column 'motor_target_deg' for --units target"),
}


@pytest.mark.parametrize(("options", "expected"), OPTIONS.values(), ids=OPTIONS.keys())
def test_wrong_options_are_refused_in_one_line(folder: Path, options: list[str], expected: str) -> None:
    path = folder / "bench.csv"
    path.write_text(text())
    for command in commands(path):
        result = CliRunner().invoke(app, [*command, *options])
        assert isinstance(result.exception, InputError), result.output
        assert expected in str(result.exception)
        assert "\n" not in str(result.exception)


def test_diagnose_accepts_a_profile_and_explains_how_to_get_a_model(folder):
    record = folder / "bench.csv"
    record.write_text(text())
    alone = CliRunner().invoke(app, ["diagnose", str(record)])
    assert "hdbridge fit" in str(alone.exception)
    assert "--out model.yaml" in str(alone.exception)
    profile = folder / "axis1"
    made = CliRunner().invoke(app, ["new", str(profile)], catch_exceptions=False)
    assert made.exit_code == 0
    (profile / "model.yaml").unlink(missing_ok=True)
    without = CliRunner().invoke(app, ["diagnose", str(record), "--model", str(profile)])
    assert f"hdbridge calibrate {profile}" in str(without.exception)
    (profile / "model.yaml").write_text((folder / "model.yaml").read_text())
    for name in (profile, profile / "axis.yaml"):
        result = CliRunner().invoke(
            app, ["diagnose", str(record), "--model", str(name)], catch_exceptions=False
        )
        assert result.exit_code == 0
    neither = CliRunner().invoke(app, ["diagnose", str(record), "--model", str(folder / "absent")])
    assert "no such model file, and no such profile" in str(neither.exception)


@pytest.mark.parametrize("compressed", [False, True], ids=["plain", "gzip"])
def test_a_file_too_large_for_memory_is_refused_before_loading(tmp_path, monkeypatch, compressed):
    monkeypatch.setattr(csvfile, "MAXIMUM_BYTES", 1 << 12)
    path = tmp_path / "bench.csv"
    path.write_bytes(gzip.compress(text().encode()) if compressed else text().encode())
    with pytest.raises(InputError, match="split the record"):
        Record.read_csv(path)


def test_duplicate_samples_change_no_result(folder: Path) -> None:
    path = folder / "bench.csv"
    twice = np.r_[0:100, 99:199]
    path.write_text(text(TIME[twice], MOTOR[twice], LOAD[twice]))
    result = CliRunner().invoke(app, commands(path)[0], catch_exceptions=False)
    assert result.exit_code == 0
    assert (folder / "out.json").is_file()


def test_a_record_given_twice_is_refused(folder: Path) -> None:
    (folder / "bench.csv").write_text(text())
    (folder / "copy.csv").write_text(text())
    for other, said in (("copy.csv", "holds the same samples as"), ("bench.csv", "is named twice")):
        for name, first, *options in commands(folder / "bench.csv"):
            result = CliRunner().invoke(app, [name, first, str(folder / other), *options])
            assert isinstance(result.exception, InputError), result.output
            assert said in str(result.exception)
            assert not (folder / "new.yaml").exists()
