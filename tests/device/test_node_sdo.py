"""The SDO server: transfers, abort codes, and requests that make no sense."""

import struct

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

LABEL = (0x2000, 0)


def test_the_period_is_fixed_while_the_axis_is_enabled(master):
    master.enable()
    assert master.write(0x60C2, 1, 2, 1) == 0x08000022
    assert master.write(0x607E, 0, 0x80, 1) == 0x08000022
    master.control(0)
    assert master.write(0x60C2, 1, 2, 1) == 0


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
    # Aborts a block transfer that may have begun.
    master.send(0x601, struct.pack("<BHBI", 0x80, 0, 0, 0x05040000))
    assert master.read(0x1018, 2) == 0x402
