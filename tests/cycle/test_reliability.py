"""Every fault of the reliability table on the virtual bus, on drives of several characters."""

from __future__ import annotations

import pytest
from support.characters import CHARACTERS, Character, PowerCount, every_character
from support.reliability import VIRTUAL, Row, rows_of, try_out

from hdbridge.drive.supervision import Reaction
from tests.cycle.conftest import rig


@pytest.mark.parametrize("row", rows_of(VIRTUAL), ids=lambda row: row.name)
@pytest.mark.parametrize("character", CHARACTERS, ids=str)
def test_a_fault_has_its_reaction_in_time(character: Character, row: Row) -> None:
    if row.unseen_on(character):
        pytest.skip("nothing that this drive sends shows it")
    check(character, row)


@pytest.mark.slow
@pytest.mark.parametrize("character", every_character(), ids=str)
def test_a_fault_has_its_reaction_on_every_drive(character: Character) -> None:
    for row in rows_of(VIRTUAL):
        print(row.name)
        if not row.unseen_on(character):
            check(character, row)


def check(character: Character, row: Row) -> None:
    with rig(character=character) as moving:
        moving.set_off()
        power = PowerCount(moving.node)
        try_out(row, moving, VIRTUAL, moving.drive.image.heartbeat_timeout_s, character)
        if row.reaction >= Reaction.QUICK_STOP:
            moving.stands_still()
            moving.next_program()
            moving.stands_still()
            assert power.times <= row.resumptions_on(character), "power without a request"
