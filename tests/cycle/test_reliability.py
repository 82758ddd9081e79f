"""Every fault of the reliability table on the virtual bus: what comes of it, in how many cycles."""

from __future__ import annotations

import pytest

from hdbridge.drive.supervision import Reaction
from tests.support.reliability import VIRTUAL, Row, rows_of, try_out


@pytest.mark.parametrize("row", rows_of(VIRTUAL), ids=lambda row: row.name)
def test_a_fault_has_its_reaction_in_time(moving, row: Row) -> None:
    try_out(row, moving, VIRTUAL, moving.drive.image.heartbeat_timeout_s)
    if row.reaction >= Reaction.QUICK_STOP:
        moving.stands_still()
