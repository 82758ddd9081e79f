"""``hdbridge record import``: logs of a bus on which another master drives a simulated axis."""

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path

import can
import numpy as np
import pytest
from support.rawmaster import FrameMaster
from typer.testing import CliRunner

from hdbridge.axis import AxisConfig
from hdbridge.cli import app
from hdbridge.control.buslog import import_log
from hdbridge.errors import InputError
from hdbridge.records.recording import Recording
from hdbridge.sim.lockstep import LockstepBus, VirtualClock, simulated_bench

ROOT = Path(__file__).parents[2]
ARTICLE = ROOT / "profiles" / "article"
AXIS = AxisConfig.load(ARTICLE / "axis.yaml")
EDS = ROOT / "eds" / "hdbridge-402.eds"
PERIOD_S = 0.004
EPOCH_S = 1.7e9
CYCLES = 1500


def frame(time_s: float, can_id: int, data: bytes, channel: int = 0, **more: bool) -> can.Message:
    return can.Message(
        timestamp=time_s, arbitration_id=can_id, data=data, is_extended_id=False, channel=channel, **more
    )


@dataclass
class Logged:
    """Frames of the bus, and the master's own values."""

    messages: list[can.Message] = field(default_factory=list)
    rows: list[tuple[float, int, int, int, int]] = field(default_factory=list)
    """Time of SYNC in s; motor, load and demand of the drive in counts; its torque in per mille."""

    def write(self, path: Path, *, skip: Callable[[can.Message], bool] = lambda _: False) -> Path:
        """Writes the frames with the python-can writer that matches the file's extension."""
        with can.Logger(path) as logger:
            for message in self.messages:
                if not skip(message):
                    logger.on_message_received(message)
        return path


class Master(FrameMaster):
    """A third-party master: its own PDO order and identifiers, SDO and CSP in raw frames, all logged."""

    def __init__(self, bus: LockstepBus, clock: VirtualClock) -> None:
        super().__init__(bus, clock)
        self.log = Logged()

    def keep(self, message: can.Message, *, is_rx: bool) -> None:
        copy = frame(EPOCH_S + message.timestamp, message.arbitration_id, message.data, is_rx=is_rx)
        self.log.messages.append(copy)

    def send(self, can_id: int, data: bytes = b"") -> None:
        message = frame(self.clock.now(), can_id, data)
        self.keep(message, is_rx=False)
        self.bus.send(message)

    def messages(self) -> list[can.Message]:
        found = super().messages()
        for each in found:
            self.keep(each, is_rx=True)
        return found

    def boot(self, *, with_demand: bool = True) -> None:
        """Configures and starts the node. TPDO1 carries load encoder and statusword, TPDO2 torque and
        position; in the RPDO, the target comes first.
        """
        self.send(0x000, b"\x80\x01")
        self.read(0x1018, 1)
        self.read(0x1018, 2)
        self.map(0x1800, 1, 0x1A1, 0x60E4_0120, 0x6041_0010)
        self.map(0x1800, 2, 0x2C1, 0x6077_0010, 0x6064_0020)
        self.map(0x1800, 3, 0x381, *([0x6062_0020] if with_demand else []))
        self.map(0x1800, 4, 0x481)
        self.map(0x1400, 1, 0x231, 0x607A_0020, 0x6040_0010)
        self.put(0x6060, 0, 8, 1)
        self.put(0x60C2, 1, 4, 1)
        self.put(0x60C2, 2, -3, 1)
        self.send(0x000, b"\x01\x01")

    def cycle(self, word: int, target: int | None = None) -> tuple[int, int]:
        now_s = self.clock.now()
        self.send(0x080)
        frames = dict(self.take())
        load, _ = struct.unpack("<iH", frames[0x1A1])
        torque, motor = struct.unpack("<hi", frames[0x2C1])
        demand = struct.unpack("<i", frames[0x381])[0] if 0x381 in frames else 0
        if word == 0x0F and target is not None:
            self.log.rows.append((now_s, motor, load, demand, torque))
        self.send(0x231, struct.pack("<iH", motor if target is None else target, word))
        self.clock.sleep_until(now_s + PERIOD_S)
        return motor, load

    def enable(self) -> int:
        for word in (0x06, 0x06, 0x07, 0x07, 0x0F, 0x0F):
            motor, _ = self.cycle(word)
        return motor

    def sweep(self, cycles: int = CYCLES) -> None:
        start = self.enable()
        turns = 4.0
        for cycle in range(cycles):
            phase = 2.0 * math.pi * cycle / 750
            self.cycle(0x0F, start + round(8000 * turns * (1.0 - math.cos(phase)) / 2.0))
        self.cycle(0x06)
        self.cycle(0x06)


def driven(*, with_demand: bool = True) -> Logged:
    with simulated_bench(ARTICLE / "truth.yaml", EDS) as (bus, clock, _):
        master = Master(bus, clock)
        master.take()
        master.boot(with_demand=with_demand)
        master.sweep()
        return master.log


@pytest.fixture(scope="module")
def logged() -> Logged:
    """Another master's session from boot-up to standstill, with 6062h."""
    return driven()


@pytest.fixture(scope="module")
def without_demand() -> Logged:
    """The same session without the drive's position demand (6062h)."""
    return driven(with_demand=False)


def run(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(each) for each in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.stderr


def check_angles(recording: Recording, logged: Logged, *, time_s: float = 1e-6) -> slice:
    """Compares a recording with the master's own values: angles exactly, times to the format's resolution.
    Returns the rows of the recording that the master has, too.
    """
    record, rows = recording.record, np.array(logged.rows)
    motor = np.round(record.motor_position_deg * 8000 / 360.0)
    load = np.round(record.load_position_deg * 2_880_000 / 360.0)
    shifts = range(len(record) - len(rows) + 1)
    first = next(each for each in shifts if np.array_equal(motor[each : each + len(rows)], rows[:, 1]))
    known = slice(first, first + len(rows))
    np.testing.assert_array_equal(load[known], rows[:, 2])
    torque = 1000.0 * record.columns["motor_torque_nm"] / AXIS.drive.rated_torque_nm
    np.testing.assert_allclose(torque[known], rows[:, 4], atol=1e-6)
    assert np.ptp(rows[:, 4]) > 100
    assert len(record) <= len(rows) + 6
    np.testing.assert_allclose(np.diff(record.time_s), PERIOD_S, atol=2 * time_s)
    return known


FORMATS = {".log": 2e-6, ".asc": 2e-6, ".blf": 2e-6, ".trc": 2e-4, ".log.gz": 2e-6, ".asc.gz": 2e-6}


@pytest.mark.parametrize(("suffix", "time_s"), FORMATS.items())
def test_a_log_of_another_master_becomes_an_ordinary_recording(tmp_path, logged, suffix, time_s):
    path = logged.write(tmp_path / f"bus{suffix}")
    said = run("record", "import", path, ARTICLE, "--out", tmp_path / "made")
    assert "PDO mapping by the log's SDO traffic: 1A1h: 60E4h:01 int32, 6041h:00 uint16" in said
    recording = Recording.load(tmp_path / "made")
    known = check_angles(recording, logged, time_s=time_s)
    assert recording.axis == "article"
    assert recording.ratio == 50.0
    assert recording.drive is not None
    assert (recording.drive.vendor_id, recording.drive.product_code) == (0x4844, 0x402)
    rows = np.array(logged.rows)
    target = recording.record.motor_target_deg
    assert target is not None
    np.testing.assert_allclose(target[known], rows[:, 3] * 360.0 / 8000, atol=1e-9)
    assert "motor_torque_nm" in recording.record.columns


@pytest.mark.skipif(find_spec("asammdf") is None, reason="asammdf is not installed")
def test_an_mf4_log_is_read(tmp_path: Path, logged: Logged) -> None:
    path = logged.write(tmp_path / "bus.mf4")
    check_angles(import_log(path, AXIS), logged)


@pytest.mark.skipif(find_spec("asammdf") is not None, reason="asammdf is installed")
def test_an_mf4_log_without_its_reader_names_the_extra(tmp_path: Path) -> None:
    (tmp_path / "bus.mf4").write_bytes(b"MDF     4.10")
    with pytest.raises(InputError, match=r"pip install 'hdbridge\[mf4\]'"):
        import_log(tmp_path / "bus.mf4", AXIS)


def test_without_6062h_the_target_is_the_command(tmp_path, without_demand, logged):
    """Axis and seed are the same as with 6062h; the drive reaches the target sent two cycles before."""
    recording = import_log(without_demand.write(tmp_path / "bus.log"), AXIS)
    target = recording.record.motor_target_deg
    assert target is not None
    known = check_angles(recording, without_demand)
    demand = np.array(logged.rows)[:, 3] * 360.0 / 8000
    np.testing.assert_allclose(target[known], demand, atol=1e-9)


def test_profile_targets_are_not_a_command(tmp_path: Path, without_demand: Logged) -> None:
    """A drive in profile position mode plans the move itself."""
    constant = replace(without_demand)
    constant.messages = [
        frame(each.timestamp, each.arbitration_id, struct.pack("<i", 32000) + each.data[4:])
        if each.arbitration_id == 0x231
        else each
        for each in without_demand.messages
    ]
    said = run(
        "record", "import", constant.write(tmp_path / "bus.log"), ARTICLE, "--out", tmp_path / "made.csv"
    )
    assert "no command in each cycle" in said
    assert Recording.load(tmp_path / "made.csv").record.motor_target_deg is None


def is_sdo(message: can.Message) -> bool:
    return message.arbitration_id in (0x581, 0x601)


def in_order_of_axis_file(logged: Logged, *, swapped: bool = False) -> Logged:
    """The same session with the PDOs that hdbridge maps, and without SDO traffic."""
    messages: list[can.Message] = []
    latest: dict[int, bytes] = {}

    def add(like: can.Message, can_id: int, data: bytes) -> None:
        messages.append(frame(like.timestamp, can_id, data))

    for each in logged.messages:
        can_id, data = each.arbitration_id, bytes(each.data)
        latest[can_id] = data
        if can_id == 0x381:
            first, second = latest[0x1A1], latest[0x2C1]
            load, position = (second[2:], first[:4]) if swapped else (first[:4], second[2:])
            add(each, 0x181, first[4:] + position + second[:2])
            add(each, 0x281, load + data)
        elif can_id == 0x231:
            add(each, 0x201, data[4:] + data[:4])
        elif not is_sdo(each) and can_id not in (0x1A1, 0x2C1):
            messages.append(each)
    return Logged(messages, logged.rows)


def test_without_sdo_traffic_the_mapping_is_that_of_the_axis_file(tmp_path: Path, logged: Logged) -> None:
    path = in_order_of_axis_file(logged).write(tmp_path / "bus.log")
    said = run("record", "import", path, ARTICLE, "--out", tmp_path / "made")
    assert "PDO mapping by the axis file: 181h: 6041h:00 uint16, 6064h:00 int32, 6077h:00 int16" in said
    check_angles(Recording.load(tmp_path / "made"), logged)


def test_a_mapping_different_from_the_axis_file_is_reported(tmp_path: Path, logged: Logged) -> None:
    path = in_order_of_axis_file(logged, swapped=True).write(tmp_path / "bus.log")
    with pytest.raises(InputError, match="the mapping is that of the axis file, the log may use another"):
        import_log(path, AXIS)


REFUSED: dict[str, tuple[Callable[[can.Message], bool], str]] = {
    "no SDO traffic, other identifiers": (is_sdo, "no PDO of node 1 in "),
    "no load encoder": (lambda each: each.arbitration_id == 0x1A1, "no SYNC period has both encoders"),
    "no SYNC": (
        lambda each: each.arbitration_id == 0x080,
        "the encoders come in different PDOs (1A1h and 2C1h) that no SYNC ties together",
    ),
    "another axis": (lambda each: each.arbitration_id != 0x080, "no PDO of node 1 in "),
    "nothing": (lambda _: True, "no PDO of node 1 in 0 frames"),
}


@pytest.mark.parametrize(("skip", "expected"), REFUSED.values(), ids=REFUSED.keys())
def test_a_log_without_the_axis_is_refused_in_one_line(tmp_path, logged, skip, expected):
    path = logged.write(tmp_path / "bus.log", skip=skip)
    with pytest.raises(InputError) as caught:
        run("record", "import", path, ARTICLE, "--out", tmp_path / "made")
    assert str(caught.value).startswith(f"{path}: {expected}")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "made").exists()


UNREADABLE = {
    "bus.txt": b"(0.1) can0 181#00",
    "bus.log": b"can0  181   [8]  01 02 03 04 05 06 07 08\n",
    "bus.blf": b"LOGGnothing of the kind",
    "bus.asc": b"\xff\xfe\x00 binary\x00",
    "bus.trc": b";$FILEVERSION=9.9\n",
    "bus.log.gz": b"no gzip",
    "bus.csv": b"timestamp,arbitration_id\n",
    "bus": b"",
}


@pytest.mark.parametrize(("name", "content"), UNREADABLE.items())
def test_a_file_that_is_not_a_log_is_refused_in_one_line(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as caught:
        import_log(tmp_path / name, AXIS)
    assert str(caught.value).startswith(f"{tmp_path / name}: ")
    assert "\n" not in str(caught.value)


def test_a_truncated_log_is_read_to_its_end(tmp_path: Path, logged: Logged) -> None:
    """The logger was killed, or its disk was full."""
    text = logged.write(tmp_path / "whole.log").read_text()
    (tmp_path / "bus.log").write_text(text[: len(text) // 2])
    said = run("record", "import", tmp_path / "bus.log", ARTICLE, "--out", tmp_path / "made")
    half = Recording.load(tmp_path / "made").record
    assert 0.4 * CYCLES < len(half) < 0.6 * CYCLES
    whole = logged.write(tmp_path / "whole.blf").read_bytes()
    (tmp_path / "bus.blf").write_bytes(whole[: len(whole) // 2])
    said = run("record", "import", tmp_path / "bus.blf", ARTICLE, "--out", tmp_path / "also")
    assert "damaged after" in said or len(Recording.load(tmp_path / "also").record) < CYCLES


def test_two_buses_in_one_log_need_a_choice(tmp_path: Path, logged: Logged) -> None:
    twice = Logged([*logged.messages], logged.rows)
    for each in logged.messages:
        twice.messages.append(frame(each.timestamp, each.arbitration_id, each.data, channel=1))
    twice.messages.sort(key=lambda each: each.timestamp)
    path = twice.write(tmp_path / "bus.blf")
    with pytest.raises(InputError, match="node 1 is on the channels 0, 1; choose one: --channel"):
        import_log(path, AXIS)
    check_angles(import_log(path, AXIS, channel="1"), logged)


def test_parts_begin_at_gaps_and_when_the_drive_boots(tmp_path: Path, logged: Logged) -> None:
    first_s, last_s = (each.timestamp for each in (logged.messages[0], logged.messages[-1]))
    middle_s = 0.5 * (first_s + last_s)
    gap = Logged([each for each in logged.messages if not middle_s < each.timestamp < middle_s + 0.1])
    cut = import_log(gap.write(tmp_path / "gap.log"), AXIS)
    assert len(cut.record.parts()) == 2
    assert "zeros_may_differ" not in cut.notes
    place = next(place for place, each in enumerate(logged.messages) if each.timestamp >= middle_s)
    boot = frame(logged.messages[place].timestamp, 0x701, b"\0")
    booted = Logged([*logged.messages[:place], boot, *logged.messages[place:]])
    again = import_log(booted.write(tmp_path / "boot.log"), AXIS)
    assert len(again.record.parts()) == 2
    assert again.notes["zeros_may_differ"]


def test_a_refused_write_is_not_the_mapping(tmp_path: Path, logged: Logged) -> None:
    """An SDO abort leaves the drive as it was."""
    request = struct.pack("<BHBI", 0x23, 0x1A00, 1, 0x6041_0010)
    abort = struct.pack("<BHBI", 0x80, 0x1A00, 1, 0x0800_0022)
    place = next(n for n, each in enumerate(logged.messages) if each.arbitration_id == 0x1A1)
    now_s = logged.messages[place].timestamp
    frames = [frame(now_s, can_id, data) for can_id, data in ((0x601, request), (0x581, abort))]
    tried = Logged([*logged.messages[:place], *frames, *logged.messages[place:]], logged.rows)
    check_angles(import_log(tried.write(tmp_path / "bus.log"), AXIS), logged)


def synthetic(count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Counts of motor and load in a one-way sweep."""
    motor = np.round(np.linspace(0.0, 3.0 * 8000, count)).astype(int)
    return motor, np.round(motor * 7.2).astype(int)


def write_frames(path: Path, frames: list[tuple[float, int, bytes]]) -> Path:
    with can.Logger(path) as logger:
        for time_s, can_id, data in frames:
            logger.on_message_received(frame(time_s, can_id, data))
    return path


def mapping(node: int, number: int, can_id: int, kind: int, *words: int) -> list[tuple[float, int, bytes]]:
    """The SDO reads of a drive's own PDO mapping."""

    def read(index: int, sub: int, value: int, size: int) -> tuple[float, int, bytes]:
        command = 0x43 | (4 - size) << 2
        return 0.0, 0x580 + node, struct.pack("<BHBI", command, index, sub, value)

    return [
        read(0x1800 + number - 1, 1, 0x4000_0000 | can_id, 4),
        read(0x1800 + number - 1, 2, kind, 1),
        read(0x1A00 + number - 1, 0, len(words), 1),
        *(read(0x1A00 + number - 1, place, word, 4) for place, word in enumerate(words, 1)),
    ]


def check_synthetic(recording: Recording) -> None:
    motor, load = synthetic()
    record = recording.record
    np.testing.assert_allclose(record.motor_position_deg, motor * 360.0 / 8000)
    np.testing.assert_allclose(record.load_position_deg, load * 360.0 / 2_880_000)
    np.testing.assert_allclose(np.diff(record.time_s), PERIOD_S, atol=1e-6)


def test_event_driven_pdos_are_read_if_one_carries_both_encoders(tmp_path: Path) -> None:
    frames = mapping(1, 1, 0x181, 255, 0x6064_0020, 0x60E4_0120)
    for row, (motor, load) in enumerate(zip(*synthetic(), strict=True)):
        time_s = 1.0 + PERIOD_S * row
        frames += [(time_s, 0x080, b""), (time_s + 0.001, 0x181, struct.pack("<ii", motor, load))]
    check_synthetic(import_log(write_frames(tmp_path / "bus.log", frames), AXIS))
    apart = [
        *mapping(1, 1, 0x181, 255, 0x6064_0020),
        *mapping(1, 2, 0x281, 255, 0x60E4_0120),
        *((time_s, can_id, data[:4]) for time_s, can_id, data in frames[5:]),
        *((time_s, 0x281, data[4:]) for time_s, can_id, data in frames[5:] if can_id == 0x181),
    ]
    with pytest.raises(InputError, match=r"different PDOs \(181h and 281h\) that no SYNC ties together"):
        import_log(write_frames(tmp_path / "apart.log", apart), AXIS)


def test_load_encoder_on_a_separate_node(tmp_path: Path) -> None:
    """An absolute encoder of 16 bits whose count wraps, on node 5, with a mapping of its own."""
    text = (ARTICLE / "axis.yaml").read_text()
    source = "{index: 0x60E4, subindex: 1, type: int32, via: tpdo}"
    assert source in text
    own = "{node: 5, index: 0x6004, subindex: 0, type: uint16, via: tpdo}"
    (tmp_path / "axis.yaml").write_text(text.replace(source, own))
    axis = AxisConfig.load(tmp_path / "axis.yaml")
    frames = mapping(1, 1, 0x181, 1, 0x6064_0020, 0x6041_0010) + mapping(5, 1, 0x1F0, 1, 0x6004_0010)
    for row, (motor, load) in enumerate(zip(*synthetic(), strict=True)):
        time_s = 1.0 + PERIOD_S * row
        frames += [
            (time_s, 0x080, b""),
            (time_s + 0.0003, 0x1F0, struct.pack("<H", load % 65536)),
            (time_s + 0.0005, 0x181, struct.pack("<iH", motor, 0x1237)),
        ]
    check_synthetic(import_log(write_frames(tmp_path / "bus.log", frames), axis))


def test_a_drive_that_was_not_enabled(tmp_path: Path) -> None:
    frames = mapping(1, 1, 0x181, 1, 0x6064_0020) + mapping(1, 2, 0x281, 1, 0x60E4_0120, 0x6041_0010)
    for row, (motor, load) in enumerate(zip(*synthetic(), strict=True)):
        time_s = 1.0 + PERIOD_S * row
        frames += [
            (time_s, 0x080, b""),
            (time_s + 0.0003, 0x181, struct.pack("<i", motor)),
            (time_s + 0.0005, 0x281, struct.pack("<iH", load, 0x1231)),
        ]
    path = write_frames(tmp_path / "bus.log", frames)
    with pytest.raises(InputError, match="the drive was never enabled in 200 samples; --all-states"):
        import_log(path, AXIS)
    check_synthetic(import_log(path, AXIS, all_states=True))
