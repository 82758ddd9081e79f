"""Every fault of the reliability table on the virtual bus, on drives of several characters."""

from __future__ import annotations

import pytest

from hdbridge.drive.supervision import Reaction
from tests.support.characters import CHARACTERS, Character, PowerCount, every_character
from tests.support.reliability import VIRTUAL, Row, rows_of, try_out


@pytest.mark.parametrize("row", rows_of(VIRTUAL), ids=lambda row: row.name)
@pytest.mark.parametrize("moving", CHARACTERS, ids=str, indirect=True)
def test_a_fault_has_its_reaction_in_time(moving, row: Row, request: pytest.FixtureRequest) -> None:
    check(moving, row, request.node.callspec.params["moving"])


@pytest.mark.slow
@pytest.mark.parametrize("row", rows_of(VIRTUAL), ids=lambda row: row.name)
@pytest.mark.parametrize("moving", every_character(), ids=str, indirect=True)
def test_a_fault_has_its_reaction_on_every_drive(moving, row: Row, request: pytest.FixtureRequest) -> None:
    check(moving, row, request.node.callspec.params["moving"])


def check(moving, row: Row, character: Character) -> None:
    if row.unseen_on(character):
        pytest.skip("nothing that this drive sends shows it")
    power = PowerCount(moving.node)
    try_out(row, moving, VIRTUAL, moving.drive.image.heartbeat_timeout_s, character)
    if row.reaction >= Reaction.QUICK_STOP:
        moving.stands_still()
        moving.next_program()
        moving.stands_still()
        assert power.times <= row.resumptions_on(character), "power without a request"
