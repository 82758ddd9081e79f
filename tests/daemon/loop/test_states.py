"""Properties of the state table."""

from pathlib import Path

import pytest

from hdbridge.daemon.loop.states import TRANSITIONS, AxisState, Trigger, refusal, target_of
from hdbridge.daemon.memory import CommandKind

S = AxisState


def mermaid() -> str:
    """Returns the table as a Mermaid state diagram, without rows that keep the state.

    A transition that most states share is a note at its target in place of as many arrows.
    """
    lines = ["stateDiagram-v2", f"    [*] --> {AxisState.UNVERIFIED.name}"]
    causes: dict[tuple[AxisState, AxisState], list[str]] = {}
    for row in TRANSITIONS:
        if row.source is not row.target:
            words = row.cause.value if isinstance(row.cause, Trigger) else row.cause.name
            causes.setdefault((row.source, row.target), []).append(str(words))
    sources: dict[tuple[AxisState, str], list[str]] = {}
    for (source, target), each in causes.items():
        sources.setdefault((target, ", ".join(each)), []).append(source.name)
    for (target, cause), names in sources.items():
        if len(names) > len(AxisState) / 2:
            lines.append(f"    note right of {target.name}: {cause} (from {', '.join(names)})")
        else:
            lines += [f"    {name} --> {target.name}: {cause}" for name in names]
    return "\n".join(lines)


def test_every_row_is_unique() -> None:
    assert len({(row.source, row.cause) for row in TRANSITIONS}) == len(TRANSITIONS)


def test_only_an_enable_command_leads_towards_power() -> None:
    ways = [row for row in TRANSITIONS if row.target is S.ENABLING and row.source is not S.ENABLING]
    assert [(row.source, row.cause) for row in ways] == [(S.DISABLED, CommandKind.ENABLE)]
    ways = [row for row in TRANSITIONS if row.target is S.ENABLED and row.source is not S.ENABLED]
    assert [(row.source, row.cause) for row in ways] == [(S.ENABLING, Trigger.POWERED)]


def test_only_a_reset_leaves_the_latch() -> None:
    for latched in (S.QUICK_STOPPED, S.LATCHED):
        causes = {row.cause for row in TRANSITIONS if row.source is latched and row.target is not latched}
        assert causes - {Trigger.VERIFICATION_LOST} == {CommandKind.RESET}


@pytest.mark.parametrize("state", list(AxisState))
def test_stopping_is_never_refused(state: AxisState) -> None:
    for kind in (CommandKind.STOP, CommandKind.QUICK_STOP):
        target = target_of(state, kind)
        assert target is not None
        assert target not in {S.ENABLING, S.ENABLED} or target is state


@pytest.mark.parametrize("state", [S.DISABLED, S.ENABLING, S.ENABLED, S.STOPPING, S.LENT, S.QUICK_STOPPED])
def test_a_lost_drive_latches_from_every_known_state(state: AxisState) -> None:
    assert target_of(state, Trigger.VERIFICATION_LOST) is S.LATCHED


def test_every_state_is_reached_and_left() -> None:
    for state in AxisState:
        assert any(row.target is state for row in TRANSITIONS if row.source is not state)
        assert any(row.source is state for row in TRANSITIONS if row.target is not state)


def test_motion_is_possible_only_while_enabled() -> None:
    for kind in (CommandKind.MOVE, CommandKind.JOG, CommandKind.STREAM_BEGIN):
        assert [state for state in AxisState if target_of(state, kind) is not None] == [S.ENABLED]


def test_refusals_state_the_remedy() -> None:
    assert refusal("arm", S.QUICK_STOPPED, CommandKind.ENABLE) == (
        "arm: enable is not possible while the axis is quick stopped: remove the cause, then reset it: "
        "hdbridge ctl reset arm"
    )
    assert refusal("arm", S.ENABLED, CommandKind.HOME) == (
        "arm: home is not possible while the axis is enabled: disable it first"
    )


def test_the_documented_diagram_matches_the_table() -> None:
    page = Path(__file__).resolve().parents[3] / "docs" / "architecture.md"
    assert mermaid() in page.read_text(encoding="utf-8")
