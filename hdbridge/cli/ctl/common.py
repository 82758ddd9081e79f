"""Shared parts of the commands: address of the daemon, lease, printing of an axis."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from rich.markup import escape
from rich.table import Table

from hdbridge.cli.options import note, say, write_json
from hdbridge.errors import DaemonError, HdbridgeError, InputError

if TYPE_CHECKING:
    from types import FrameType

    from hdbridge.client import Client
    from hdbridge.client.messages import AxisState
    from hdbridge.client.sync import Axis

STOP_S: Final = 3.0
"""Time-out of a stop command; s."""
AtOption = Annotated[
    str | None,
    typer.Option(
        "--at",
        metavar="ADDRESS",
        help="Name of the machine, socket or URL of its daemon; else HDBRIDGE_SOCKET, HDBRIDGE_URL (its "
        "token in HDBRIDGE_TOKEN), or the only one that runs here.",
    ),
]
OneAxisArgument = Annotated[
    str | None,
    typer.Argument(metavar="AXIS", help="Name of the axis; needed if there are several."),
]
AxisArgument = Annotated[str, typer.Argument(metavar="AXIS", help="Name of the axis.")]
AxesArgument = Annotated[list[str] | None, typer.Argument(metavar="AXIS...", help="Names of axes; else all.")]
TakeOption = Annotated[
    bool,
    typer.Option("--force", help="Take the lease from its holder, whose motion is stopped."),
]


def connected(at: str | None, *, named: bool = True) -> Client:
    """Returns the daemon's client, a context manager. ``named`` reports its machine if no
    address was given.
    """
    from hdbridge.client import Client

    client = Client(at, name="hdbridge ctl")
    if named:
        _name(at, client)
    return client


def _name(at: str | None, client: Client) -> None:
    """Reports the machine that a command acts on if the command did not name it."""
    if at is not None:
        return
    place = client.address.socket
    machine = f"machine at {client.address}" if place is None else f"machine '{place.stem}' at {place}"
    given = next((each for each in ("HDBRIDGE_SOCKET", "HDBRIDGE_URL") if os.environ.get(each)), None)
    source = f" (from {given})" if given else ""
    note(f"{machine}{source}")


@contextmanager
def stopping(at: str | None) -> Iterator[Client]:
    """Yields the daemon's client for a stop. If it fails, the error names the process that holds the bus."""
    from hdbridge.client import Client

    try:
        with Client(at, name="hdbridge ctl", timeout_s=STOP_S) as client:
            _name(at, client)
            yield client
    except DaemonError as problem:
        if type(problem) is not DaemonError:
            raise  # the daemon answers
        raise DaemonError(f"{problem}; {_who_holds(at)}") from None


def _who_holds(at: str | None) -> str:
    """Describes the processes that hold an interface or listen at the daemon's socket, and how
    to end them.
    """
    from hdbridge.client.address import find
    from hdbridge.daemon.api.sockets import daemon_of
    from hdbridge.drive.interfacelock import holders, process_words

    found = holders()
    with suppress(HdbridgeError, OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as raw:
        raw.settimeout(STOP_S)
        raw.connect(str(find(at).socket))
        number = daemon_of(raw)
        found.setdefault(number, f"the daemon is {process_words(number)}")
    if not found:
        return "no process of this machine holds an interface"
    what_to_do = ", ".join(f"'kill {number}'" for number in found)
    return f"{'; '.join(found.values())}; {what_to_do} stops its axes in order and ends it"


@contextmanager
def moving(at: str | None, name: str | None, *, force: bool = False) -> Iterator[Axis]:
    """Yields an axis with the lease to move it; Ctrl-C or another end of the command stops it.

    Without a name it is the only axis; raises `InputError` if there are several.
    """
    with connected(at) as client:
        name = name or _only(client)
        with client.lease(force=force), stopped_by_signals(client, name):
            yield client.axis(name)


def _only(client: Client) -> str:
    names = list(client.axes)
    if len(names) != 1:
        raise InputError(f"AXIS: is missing; expected one of: {', '.join(names)}")
    return names[0]


@contextmanager
def stopped_by_signals(client: Client, *names: str) -> Iterator[None]:
    """Brakes these axes to rest if the block is interrupted; the interruption propagates."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {
        each: signal.signal(each, interrupt)
        for each in (signal.SIGTERM, signal.SIGHUP)
        if signal.getsignal(each) is not signal.SIG_IGN
    }
    try:
        yield
    except KeyboardInterrupt:
        for name in names:
            with suppress(HdbridgeError):  # the daemon's own supervision remains
                client.axis(name).stop()
                note(f"axis '{name}' is stopped; it stays enabled")
        raise
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


def tell(state: AxisState, json_file: Path | None) -> None:
    """Prints the state of an axis after a command."""
    write_json(json_file, document("ctl-axis", state))
    load = "" if state.load_position_deg is None else f", load encoder {state.load_position_deg:.4f} deg"
    error = "" if state.error_arcsec is None else f", error {state.error_arcsec:+.2f} arcsec"
    target = "" if state.load_target_deg is None else f": target {state.load_target_deg:.4f} deg{load}{error}"
    say(f"axis '{state.name}' is {state.state}{target}")
    if state.fault is not None:
        say(f"stopped: {state.fault}")
    if state.adaptation.response is not None:
        say(str(state.adaptation.response))


def concerns(state: AxisState) -> Iterator[str]:
    """Yields the warnings about an axis, one line each."""
    if state.fault is not None:
        yield f"axis '{state.name}' stopped: {state.fault}"
    if state.adaptation.frozen is not None:
        yield f"axis '{state.name}' does not adapt: {state.adaptation.frozen}"
    if state.adaptation.response is not None:
        yield f"axis '{state.name}': {state.adaptation.response}"
    if state.load_loop.on and state.load_loop.doubt is not None:
        yield f"the load loop of axis '{state.name}' does not act: {state.load_loop.doubt}"
    for each in state.advice:
        yield f"axis '{state.name}': {each}"


def document(kind: str, message: Any) -> dict[str, Any]:
    """Returns a message of the daemon as a JSON result."""
    return {"schema": f"hdbridge.{kind}/1", **message.model_dump(mode="json")}


def figure(value: float | None, digits: int) -> str:
    """Formats a number in a table; a dash if there is none."""
    return "-" if value is None else f"{value:z.{digits}f}"


def axes_table(axes: list[AxisState]) -> Table:
    """Returns a table with one row per axis."""
    table = Table("axis", "state")
    for name in ("target, deg", "load encoder, deg", "error, arcsec", "correction, arcsec"):
        table.add_column(name, justify="right")
    table.add_column("compensation")
    table.add_column("model")
    for each in axes:
        moving = "" if each.mode == "hold" else f", {each.mode}"
        queued = f", {each.queued} wait" if each.queued else ""
        table.add_row(
            escape(each.name),
            f"{each.state}{moving}{queued}",
            figure(each.load_target_deg, 4),
            figure(each.load_position_deg, 4),
            figure(each.error_arcsec, 2),
            figure(each.correction_arcsec, 2),
            str(each.scheme),
            _model(each),
        )
    return table


def _model(state: AxisState) -> str:
    if state.model is None:
        return "-"
    name = "file" if state.model.version is None else str(state.model.version)
    if state.model.age_s is None:
        return name
    days = state.model.age_s / 86_400
    return f"{name}, {days:.0f} days old" if days >= 2 else f"{name}, {state.model.age_s / 3600:.0f} h old"
