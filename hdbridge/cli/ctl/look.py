"""Commands that look at a machine and move nothing."""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Group
from rich.live import Live
from rich.text import Text

from hdbridge.cli.ctl.common import AtOption, TakeOption, axes_table, concerns, connected, document
from hdbridge.cli.options import JsonOption, console, fitted, print_table, say, write_json

if TYPE_CHECKING:
    from hdbridge.client.messages import Event, LeaseState, MachineState, OuterState


def status(at: AtOption = None, json_file: JsonOption = None) -> None:
    """Report the state of a machine and its axes."""
    with connected(at, named=False) as client:
        state = client.state()
    write_json(json_file, document("ctl-status", state))
    for line in _machine(state):
        say(line)
    print_table(axes_table(state.axes))
    for line in _concerns(state):
        say(line)


def watch(
    at: AtOption = None,
    every_s: Annotated[
        float, typer.Option("--every", min=0.05, max=3600.0, help="Time between updates, s.")
    ] = 0.25,
    count: Annotated[
        int | None, typer.Option("--count", min=1, help="Number of updates; else until Ctrl-C.")
    ] = None,
    lines: Annotated[
        bool, typer.Option("--lines", help="Print a JSON object per line in place of a table.")
    ] = False,
) -> None:
    """Show the state of a machine until Ctrl-C; it moves nothing."""
    with connected(at, named=False) as client:
        if lines:
            for _ in _looks(count, every_s):
                print(client.state().model_dump_json(), flush=True)
            return
        with Live(console=console, auto_refresh=False, screen=False) as shown:
            for _ in _looks(count, every_s):
                state = client.state()
                words = (Text(line) for line in (*_machine(state), *_concerns(state)))
                shown.update(Group(*words, *fitted(axes_table(state.axes))), refresh=True)


def events(
    at: AtOption = None,
    since: Annotated[int, typer.Option("--since", min=0, help="Only events after this number.")] = 0,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Continue until Ctrl-C.")] = False,
    json_file: JsonOption = None,
) -> None:
    """List faults, states, refused commands and remarks; oldest first."""
    with connected(at) as client:
        found = client.events(since)
        write_json(json_file, document("ctl-events", found))
        while True:
            if found.lost:
                say(f"{found.lost} older ones are kept no more")
            for each in found.events:
                say(_event(each))
            if not follow:
                return
            sys.stdout.flush()
            time.sleep(0.5)
            found = client.events(found.newest)


def lease(at: AtOption = None, force: TakeOption = False, json_file: JsonOption = None) -> None:
    """Report who has the right to move; with --force take it from its holder, and release it."""
    with connected(at) as client:
        if force:
            with client.lease(force=True):
                pass
        state = client.lease_state()
    write_json(json_file, document("ctl-lease", state))
    say(_lease(state))


def mark(text: Annotated[str, typer.Argument(metavar="TEXT", help="One line.")], at: AtOption = None) -> None:
    """Write a remark into the flight recorder, at the present cycle."""
    with connected(at) as client:
        for each in client.mark(text):
            say(_event(each))


def _looks(count: int | None, every_s: float) -> Iterator[int]:
    """Yields ``count`` numbers, with a pause between two."""
    for number in itertools.count() if count is None else range(count):
        if number:
            time.sleep(every_s)
        yield number


def _machine(state: MachineState) -> list[str]:
    simulated = ", simulated" if state.simulated else ""
    load = "" if state.bus.load is None else f", load {100 * state.bus.load:.0f} %"
    bus = f"{state.bus.interface} {state.bus.channel} is {'up' if state.bus.up else 'DOWN'}{load}"
    turning = "" if state.cycle.alive else ", which does NOT turn"
    skipped = f", {state.cycle.skipped} periods skipped" if state.cycle.skipped else ""
    cycle = f"cycle of {1e3 * state.cycle.period_s:g} ms{turning}{skipped}"
    return [
        f"machine '{state.name}'{simulated}; {bus}; {cycle}",
        _lease(state.lease),
    ]


def _concerns(state: MachineState) -> list[str]:
    found = [line for each in state.axes for line in concerns(each)]
    found += [f"axis '{each.name}': {_outer(each.outer)}" for each in state.axes if each.outer is not None]
    if state.recorder.note is not None:
        found.append(f"recorder: {state.recorder.note}")
    return [*found, *state.warnings]


def _outer(outer: OuterState) -> str:
    from hdbridge.drive.states import decode

    if not outer.alive:
        return "the gateway process does not run; if it does not come back, start 'hdbridge run' again"
    sync = "no SYNC" if outer.period_s is None else f"SYNC every {1e3 * outer.period_s:.3f} ms"
    error = f", error {outer.error}" if outer.error else ""
    state = decode(outer.statusword).value
    return (
        f"node {outer.node_id} of another master, '{state}' (6041h = {outer.statusword:04X}h){error}, {sync}"
    )


def _lease(state: LeaseState) -> str:
    if not state.held:
        return "nobody has the right to move"
    left = "" if state.remaining_s is None else f", for another {state.remaining_s:.1f} s; use extends it"
    return f"'{state.client}' has the right to move{left}"


def _event(event: Event) -> str:
    axis = "" if event.axis is None else f"  {event.axis}"
    hint = "" if event.hint is None else f"; {event.hint}"
    date = event.date.astimezone()
    return f"{event.sequence:6d}  {date:%Y-%m-%d %H:%M:%S}{axis}  {event.kind}  {event.text}{hint}".rstrip()
