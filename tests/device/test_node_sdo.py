"""The SDO server: transfers, abort codes, and requests that make no sense."""

import struct

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

LABEL = (0x2000, 0)


def upload(master, index: int, sub: int = 0) -> bytes:
    """Segmented upload, by hand."""
    answer = master.request(struct.pack("<BHBI", 0x40, index, sub, 0))
    assert answer[:4] == struct.pack("<BHB", 0x41, index, sub)
    size = struct.unpack_from("<I", answer, 4)[0]
    data, toggle = b"", 0
    while True:
        answer = master.request(bytes([0x60 | toggle]) + bytes(7))
        assert answer[0] & 0xF0 == toggle
        data += answer[1 : 8 - (answer[0] >> 1 & 7)]
        toggle ^= 0x10
        if answer[0] & 1:
            assert len(data) == size
            return data


def download(master, index: int, sub: int, data: bytes, size: int | None = -1) -> int:
    """Segmented download, by hand; the abort code or 0. ``size`` None leaves it unstated."""
    size = len(data) if size == -1 else size
    head = 0x20 if size is None else 0x21
    answer = master.request(struct.pack("<BHBI", head, index, sub, size or 0))
    toggle, last = 0, False
    while answer[0] != 0x80:
        assert answer[0] in (0x60, 0x20 | toggle ^ 0x10)
        if answer[0] != 0x60 and last:
            return 0
        segment, data = data[:7], data[7:]
        last = not data
        answer = master.request(bytes([toggle | (7 - len(segment)) << 1 | last]) + segment.ljust(7, b"\0"))
        toggle ^= 0x10
    return struct.unpack_from("<I", answer, 4)[0]


@pytest.mark.parametrize(
    ("index", "sub", "value", "size", "code"),
    [
        (0x6041, 0, 0, 2, 0x06010002),
        (0x1018, 1, 1, 4, 0x06010002),
        (0x1008, 0, 0, 4, 0x06010002),
        (0x6040, 0, 0, 4, 0x06070012),
        (0x607A, 0, 0, 2, 0x06070013),
        (0x605A, 0, 9, 2, 0x06090031),
        (0x605A, 0, -1, 2, 0x06090032),
        (0x6060, 0, 3, 1, 0x06090030),
        (0x6098, 0, 17, 1, 0x06090030),
        (0x60C2, 1, 0, 1, 0x06090032),
        (0x60C2, 2, -2, 1, 0x06090031),
        (0x60C2, 2, -5, 1, 0x06090032),
        (0x1029, 1, 3, 1, 0x06090031),
        (0x6085, 0, 0, 4, 0x06090032),
        (0x6072, 0, 3001, 2, 0x06090031),
        (0x1003, 0, 1, 1, 0x06090030),
        (0x1014, 0, 0x181, 4, 0x06090030),
    ],
)
def test_a_wrong_write_is_refused_and_changes_nothing(master, index, sub, value, size, code):
    before = master.node.dictionary[index, sub].read()
    assert master.write(index, sub, value, size) == code
    assert master.node.dictionary[index, sub].read() == before


def test_the_period_is_fixed_while_the_axis_is_enabled(master):
    master.enable()
    assert master.write(0x60C2, 1, 2, 1) == 0x08000022
    assert master.write(0x607E, 0, 0x80, 1) == 0x08000022
    master.control(0)
    assert master.write(0x60C2, 1, 2, 1) == 0


@given(data=st.binary(min_size=1, max_size=64), stated=st.booleans())
@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_segmented_writes_read_back(master, data, stated):
    assert download(master, *LABEL, data, -1 if stated else None) == 0
    if len(data) > 4:
        assert upload(master, *LABEL) == data
    else:
        assert master.request(struct.pack("<BHBI", 0x40, *LABEL, 0))[4 : 4 + len(data)] == data


def test_endless_segments_end(master):
    master.request(struct.pack("<BHBI", 0x20, *LABEL, 0))
    for k in range(10):
        answer = master.request(bytes([0x10 * (k % 2)]) + b"endless")
    assert answer[0] == 0x80


@given(requests=st.lists(st.binary(min_size=0, max_size=8), max_size=20))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_requests_are_answered_by_whole_frames(master, requests):
    for data in requests:
        master.take()
        master.send(0x601, data)
        answers = [answer for can_id, answer in master.take() if can_id == 0x581]
        assert all(len(answer) == 8 for answer in answers)
        assert len(answers) <= (127 if len(data) == 8 else 0)
    master.send(0x601, struct.pack("<BHBI", 0x80, 0, 0, 0x05040000))  # a block may have begun
    assert master.read(0x1018, 2) == 0x402
