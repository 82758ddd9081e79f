"""The CiA-402 state table: decoding, every legal and every illegal transition, paths, the diagram."""

from itertools import pairwise, product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hdbridge.drive.states import (
    TRANSITIONS,
    Command,
    PowerWalk,
    State,
    controlword_for,
    decode,
    row_for,
    states_on_the_way,
)
from hdbridge.errors import TransitionError

STATUSWORDS = {
    State.NOT_READY_TO_SWITCH_ON: 0x0000,
    State.SWITCH_ON_DISABLED: 0x0040,
    State.READY_TO_SWITCH_ON: 0x0021,
    State.SWITCHED_ON: 0x0023,
    State.OPERATION_ENABLED: 0x0027,
    State.QUICK_STOP_ACTIVE: 0x0007,
    State.FAULT_REACTION_ACTIVE: 0x000F,
    State.FAULT: 0x0008,
}
# Copied independently from CiA 402-2, so that an error in the table is detected.
EXPECTED_LEGAL = {
    (State.SWITCH_ON_DISABLED, Command.SHUTDOWN): State.READY_TO_SWITCH_ON,
    (State.READY_TO_SWITCH_ON, Command.SWITCH_ON): State.SWITCHED_ON,
    (State.READY_TO_SWITCH_ON, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.READY_TO_SWITCH_ON, Command.QUICK_STOP): State.SWITCH_ON_DISABLED,
    (State.SWITCHED_ON, Command.ENABLE_OPERATION): State.OPERATION_ENABLED,
    (State.SWITCHED_ON, Command.SHUTDOWN): State.READY_TO_SWITCH_ON,
    (State.SWITCHED_ON, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.SWITCHED_ON, Command.QUICK_STOP): State.SWITCH_ON_DISABLED,
    (State.OPERATION_ENABLED, Command.DISABLE_OPERATION): State.SWITCHED_ON,
    (State.OPERATION_ENABLED, Command.SHUTDOWN): State.READY_TO_SWITCH_ON,
    (State.OPERATION_ENABLED, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.OPERATION_ENABLED, Command.QUICK_STOP): State.QUICK_STOP_ACTIVE,
    (State.QUICK_STOP_ACTIVE, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.QUICK_STOP_ACTIVE, Command.ENABLE_OPERATION): State.OPERATION_ENABLED,
    (State.FAULT, Command.FAULT_RESET): State.SWITCH_ON_DISABLED,
}


@pytest.mark.parametrize(("state", "word"), list(STATUSWORDS.items()))
@given(other_bits=st.integers(0, 0xFFFF))
def test_decoding_looks_at_the_state_bits_only(state: State, word: int, other_bits: int) -> None:
    free = 0xFFFF & ~0x6F
    assert decode(word | (other_bits & free)) is state


@pytest.mark.parametrize("word", [None, -1, 0x1_0000, 0x0001, 0x0003, 0x0022, 0x0045, 0x0067, 0x002C])
def test_missing_or_undefined_statuswords_are_unknown(word: int | None) -> None:
    assert decode(word) is State.UNKNOWN


def test_operation_enabled_is_exactly_one_pattern() -> None:
    enabled = {word & 0x6F for word in range(0x10000) if decode(word) is State.OPERATION_ENABLED}
    assert enabled == {0x27}


@pytest.mark.parametrize(("state", "command"), list(product(State, Command)))
def test_every_pair_is_legal_as_in_the_standard_or_raises(state: State, command: Command) -> None:
    if (state, command) in EXPECTED_LEGAL:
        assert row_for(state, command).target is EXPECTED_LEGAL[state, command]
    else:
        with pytest.raises(TransitionError, match=command.label):
            row_for(state, command)


@pytest.mark.parametrize(("state", "target"), list(product(State, State)))
def test_every_path_uses_legal_commands_or_raises_without_change(state: State, target: State) -> None:
    walk = PowerWalk()
    walk.observe(STATUSWORDS.get(state))
    aim, word = walk.aim, walk.controlword()
    try:
        way = list(states_on_the_way(state, target))
        if state is target:
            controlword_for(state, target)
    except TransitionError:
        with pytest.raises(TransitionError):
            walk.go(target)
        assert (walk.state, walk.aim, walk.controlword()) == (state, aim, word)
        return
    assert way[-1] is target
    walk.go(target)
    for here, there in pairwise(way):
        walk.observe(STATUSWORDS[here])
        word = walk.controlword()
        rows = [row for row in TRANSITIONS if row.source is here and row.target is there]
        assert any(row.command is None or word & row.command.mask == row.command.word for row in rows)


def test_paths_into_and_out_of_power() -> None:
    up = [State.SWITCH_ON_DISABLED, State.READY_TO_SWITCH_ON, State.SWITCHED_ON, State.OPERATION_ENABLED]
    assert list(states_on_the_way(State.SWITCH_ON_DISABLED, State.OPERATION_ENABLED)) == up
    assert [controlword_for(state, State.OPERATION_ENABLED) for state in up] == [0x06, 0x07, 0x0F, 0x0F]
    assert controlword_for(State.OPERATION_ENABLED, State.SWITCH_ON_DISABLED) == 0x00
    # Resuming out of a quick stop (16) is never implied; recovery is by 'switch on disabled'.
    resumed = list(states_on_the_way(State.QUICK_STOP_ACTIVE, State.OPERATION_ENABLED))
    assert resumed[1] is State.SWITCH_ON_DISABLED


@pytest.mark.parametrize("state", [State.FAULT, State.FAULT_REACTION_ACTIVE, State.UNKNOWN])
def test_no_path_leads_out_of_fault_or_unknown(state: State) -> None:
    with pytest.raises(TransitionError, match="cannot go from"):
        controlword_for(state, State.OPERATION_ENABLED)


@pytest.mark.parametrize(
    "state", [s for s in State if s not in (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE)]
)
def test_quick_stop_is_never_reached_by_enabling(state: State) -> None:
    with pytest.raises(TransitionError):
        controlword_for(state, State.QUICK_STOP_ACTIVE)


def test_a_fault_reset_is_one_rising_edge() -> None:
    walk = PowerWalk()
    walk.observe(0x0008)
    walk.reset_fault()
    words = [walk.controlword() for _ in range(5)]
    assert words == [0x00, 0x80, 0x80, 0x80, 0x80]
    walk.observe(0x0040)
    assert walk.controlword() == 0x00


@pytest.mark.parametrize("state", [state for state in STATUSWORDS if state is not State.FAULT])
def test_a_fault_reset_without_a_fault_raises_and_changes_nothing(state: State) -> None:
    walk = PowerWalk()
    walk.observe(STATUSWORDS[state])
    before = walk.controlword()
    with pytest.raises(TransitionError, match="fault reset"):
        walk.reset_fault()
    assert walk.controlword() == before
    assert not before & 0x80


def enabled_walk() -> PowerWalk:
    walk = PowerWalk()
    walk.observe(0x0040)
    walk.go(State.OPERATION_ENABLED)
    for word in (0x0040, 0x0021, 0x0023, 0x0027):
        walk.observe(word)
    assert walk.state is walk.aim
    return walk


@pytest.mark.parametrize(
    ("word", "controlword"),
    [
        (0x0040, 0x00),
        (0x0021, 0x00),
        (0x0023, 0x00),
        (0x0007, 0x02),
        (0x000F, 0x00),
        (0x0008, 0x00),
        (0x0001, 0x02),
    ],
)
def test_a_drive_that_drops_out_is_not_enabled_again(word: int, controlword: int) -> None:
    walk = enabled_walk()
    walk.observe(word)
    assert walk.aim is not State.OPERATION_ENABLED
    assert walk.controlword() == controlword
    # This holds even if the drive recovers on its own.
    walk.observe(0x0027)
    assert walk.controlword() != 0x0F


def test_a_quick_stop_holds_until_an_explicit_request() -> None:
    walk = enabled_walk()
    walk.quick_stop()
    assert walk.controlword() == 0x02
    walk.observe(0x0007)
    assert walk.controlword() == 0x02
    walk.go(State.SWITCH_ON_DISABLED)
    assert walk.controlword() == 0x00


@given(words=st.lists(st.integers(0, 0xFFFF), max_size=30))
def test_without_a_goal_no_statusword_leads_to_enabling(words: list[int]) -> None:
    walk = PowerWalk()
    for word in words:
        walk.observe(word)
        assert walk.controlword() & 0x0F not in (0x06, 0x07, 0x0F)
