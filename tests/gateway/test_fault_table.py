"""The fault table on the other master's bus: each fault is survived, or stops the axis within its time."""

import math

import pytest
from support.gateway_faults import ROWS, measure


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_a_fault_is_survived_or_stops_the_axis_in_time(tmp_path, row):
    seen = measure(tmp_path, row)
    assert bool(row.codes) == bool(seen.codes), [hex(each) for each in seen.codes]
    assert set(seen.codes) <= set(row.codes)
    assert (seen.stands_s <= row.within_s) if row.within_s else math.isinf(seen.stands_s)
