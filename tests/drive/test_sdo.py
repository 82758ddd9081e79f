"""The SDO client against nodes that answer late, wrongly, too much, or not at all."""

import struct
from typing import Any

import pytest

from hdbridge.drive import IntegerType, Link, NetworkMonitor, SdoAbortError, SdoClient
from hdbridge.errors import InputError, SdoError


@pytest.fixture
def client(bus: Any, clock: Any, slave: Any) -> SdoClient:
    return SdoClient(Link(bus, clock), NetworkMonitor(1), 1, slave.od, timeout_s=0.1)


def expedited(request: bytes, value: bytes) -> bytes:
    return bytes((0x43 | (4 - len(value)) << 2,)) + request[1:4] + value.ljust(4, b"\0")


def test_integers_of_every_sign_and_width_are_read_and_written(client: SdoClient, slave: Any) -> None:
    for index, sub, value in (
        (0x607A, 0, -123456),
        (0x605A, 0, 6),
        (0x60C2, 2, -4),
        (0x6065, 0, 0xFFFF_FFFF),
    ):
        client.write(index, sub, value)
        assert slave.values[index, sub] == value
        assert client.read(index, sub) == value


def test_strings_come_in_segments(client: SdoClient, slave: Any) -> None:
    slave.values[0x1008, 0] = b"a name of more than two segments\0"
    assert client.read_text(0x1008) == "a name of more than two segments"
    slave.values[0x1008, 0] = b"caf\xc3\xa9"
    assert client.read_text(0x1008) == "caf??"


def test_a_long_value_is_written_in_segments(client: SdoClient, slave: Any) -> None:
    received = bytearray()

    def initiate(request: bytes) -> list[bytes]:
        return [b"\x60" + request[1:4] + bytes(4)]

    def segment(request: bytes) -> list[bytes] | None:
        if request[0] >> 5:
            return slave.scripted(request)
        received.extend(request[1 : 8 - (request[0] >> 1 & 7)])
        return [bytes((0x20 | request[0] & 0x10,)) + bytes(7)]

    slave.sdo = segment
    slave.scripts[0x1008, 0] = initiate
    client.write_bytes(0x1008, 0, b"twelve bytes")
    assert bytes(received) == b"twelve bytes"


def test_retries_are_bounded(client: SdoClient, slave: Any, clock: Any, sent: Any) -> None:
    slave.node.faults.silent = True
    with pytest.raises(
        SdoError, match=r"node 1, object 6064h:00 'Position actual value': read failed after 3"
    ):
        client.read(0x6064)
    assert clock.now() == pytest.approx(0.3, abs=0.02)
    assert [data[0] for _, data in sent] == [0x40, 0x80] * 3


def test_a_lost_answer_is_retried(client: SdoClient, slave: Any) -> None:
    answers: list[list[bytes]] = [[], []]

    def forgetful(request: bytes) -> list[bytes]:
        return answers.pop() if answers else [expedited(request, struct.pack("<i", -7))]

    slave.scripts[0x6064, 0] = forgetful
    assert client.read(0x6064) == -7


def test_a_late_answer_is_not_used_for_another_object(client: SdoClient, slave: Any) -> None:
    other = b"\x43\x64\x60\x00" + struct.pack("<i", 99)
    slave.scripts[0x607A, 0] = lambda request: [other, expedited(request, struct.pack("<i", 5))]
    slave.say(0x580, other)
    assert client.read(0x607A) == 5
    assert client.unsolicited_answers == 2


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x0602_0000, "0602 ?0000h.*does not exist.*drive.eds"),
        (0x0609_0030, "Value range.*axis file"),
        (0x0800_0022, "present device state.*disable it"),
        (0x0123_4567, "vendor-specific.*manual"),
    ],
)
def test_an_abort_is_reported_with_a_remedy_and_not_retried(client, slave, code, text):
    calls = []

    def refuse(request: bytes) -> list[bytes]:
        calls.append(request)
        return [b"\x80" + request[1:4] + code.to_bytes(4, "little")]

    slave.scripts[0x605A, 0] = refuse
    with pytest.raises(SdoAbortError, match=text) as caught:
        client.write(0x605A, 0, 6)
    assert caught.value.code == code
    assert "605Ah:00 'Quick stop option code'" in str(caught.value)
    assert len(calls) == 1


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        *((lambda request, size=size: expedited(request, b"\1\2\3\4")[:size], f"the answer has {size} bytes")
          for size in (0, 1, 4, 7)),
        (lambda request: expedited(request, b"\1\2"), "answered 2 bytes, but int32 has 4"),
        (lambda request: b"\x60" + request[1:4] + bytes(4), "Unexpected response 0x60"),
    ],
    ids=["0 bytes", "1 byte", "4 bytes", "7 bytes", "too few for the type", "of a download"],
)  # fmt: skip
def test_an_invalid_answer_is_an_error_not_a_crash(client, slave, answer, text):
    slave.scripts[0x6064, 0] = lambda request: [answer(request)]
    with pytest.raises(SdoError, match=text):
        client.read(0x6064)


@pytest.mark.parametrize(
    ("data", "value"), [(b"\xfe\xff\xff\xff", -2), (b"\x06\0\0\0", 6), (b"\x06\0\1\0", None)]
)
def test_four_bytes_for_a_shorter_object(client, slave, data, value):
    slave.scripts[0x605A, 0] = lambda request: [expedited(request, data)]
    if value is None:
        with pytest.raises(SdoError, match="answered 4 bytes"):
            client.read(0x605A)
    else:
        assert client.read(0x605A) == value


def endless(slave: Any, chunk: bytes) -> None:
    """Answers every segment without ever marking a last one."""

    def serve(request: bytes) -> list[bytes] | None:
        if request[0] >> 5 != 3:
            return slave.scripted(request)
        return [bytes((request[0] & 0x10 | (7 - len(chunk)) << 1,)) + chunk.ljust(7, b"\0")]

    slave.sdo = serve
    slave.scripts[0x1008, 0] = lambda request: [b"\x40" + request[1:4] + bytes(4)]


@pytest.mark.parametrize(
    ("chunk", "text"), [(b"sevenby", "more than the 4096 bytes"), (b"", "empty segments without an end")]
)
def test_endless_segments_end(client: SdoClient, slave: Any, chunk: bytes, text: str) -> None:
    endless(slave, chunk)
    with pytest.raises(SdoError, match=text):
        client.read_text(0x1008)


def test_a_slow_drip_of_segments_ends_too(bus: Any, clock: Any, slave: Any) -> None:
    client = SdoClient(Link(bus, clock), NetworkMonitor(1), 1, slave.od, timeout_s=0.1, attempts=1)
    endless(slave, b"x")
    answer = slave.sdo

    def slowly(request: bytes) -> list[bytes] | None:
        clock.sleep_until(clock.now() + 0.09)
        return answer(request)

    slave.sdo = slowly
    with pytest.raises(SdoError, match="no answer within"):
        client.read_text(0x1008)
    assert clock.now() < 2.5


def test_wrong_announced_sizes_are_refused(client: SdoClient, slave: Any) -> None:
    slave.scripts[0x1008, 0] = lambda request: [b"\x41" + request[1:4] + (10**6).to_bytes(4, "little")]
    with pytest.raises(SdoError, match="more than the 4096 bytes"):
        client.read_text(0x1008)
    slave.scripts[0x1008, 0] = lambda request: [b"\x41" + request[1:4] + (9).to_bytes(4, "little")]
    slave.sdo = lambda request: (
        [bytes((request[0] & 0x10 | 7,)) + b"four\0\0\0"] if request[0] >> 5 == 3 else slave.scripted(request)
    )
    with pytest.raises(SdoError, match="announced 9 bytes and sent"):
        client.read_text(0x1008)


def test_frames_arriving_meanwhile_are_not_lost(bus: Any, clock: Any, slave: Any) -> None:
    monitor = NetworkMonitor(1)
    client = SdoClient(Link(bus, clock), monitor, 1, slave.od)

    def chatty(request: bytes) -> list[bytes]:
        slave.say(0x700, b"\x05")
        slave.say(0x080, b"\x11\x86\x21")
        return [expedited(request, b"\1\0\0\0")]

    slave.scripts[0x6064, 0] = chatty
    slave.say(0x700, b"\x00")
    assert client.read(0x6064) == 1
    status = monitor.nodes[1]
    assert (status.boot_ups, status.nmt_state, status.emergency_count) == (1, 5, 1)


def test_a_value_that_does_not_fit_is_not_sent(client: SdoClient, sent: Any) -> None:
    for value in (-1, 65536, 1.5, float("nan")):
        with pytest.raises(InputError, match="nothing was written"):
            client.write(0x6040, 0, value)  # type: ignore[arg-type]
    assert sent == []


def test_sub_indices_are_kept_apart(client: SdoClient, slave: Any) -> None:
    client.write(0x607D, 1, -5)
    client.write(0x607D, 2, 5)
    assert (client.read(0x607D, 1), client.read(0x607D, 2)) == (-5, 5)
    assert client.has(0x607D, 2)
    assert not client.has(0x607D, 3)
    assert not client.has(0x6064, 1)
    assert not client.has(0x2222)


def test_types_without_an_eds(bus: Any, clock: Any, slave: Any) -> None:
    client = SdoClient(Link(bus, clock), NetworkMonitor(1), 1)
    client.write(0x607A, 0, -9)
    assert client.read(0x607A) == -9
    assert client.read(0x60E4, 1, IntegerType.INT32) == 7200
    with pytest.raises(SdoError, match="neither the EDS nor the profile"):
        client.read(0x2222)


def test_a_non_integer_object_is_refused(client: SdoClient) -> None:
    with pytest.raises(SdoError, match="not an integer in the EDS"):
        client.read(0x1008)


def test_an_old_answer_for_the_same_object_is_ignored(client: SdoClient, slave: Any) -> None:
    slave.say(0x580, b"\x43\x64\x60\x00" + struct.pack("<i", 99))
    assert client.read(0x6064) == 1000
