"""``hdbridge ctl``: control of a running daemon: state, motion, stop, compensation."""

from __future__ import annotations

import itertools
import os
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from rich.console import Group
from rich.live import Live
from rich.text import Text
from typer import Argument, Option

from hdbridge.cli import options as opt
from hdbridge.cli.options import taking
from hdbridge.cli.printing import console, note, print_object, print_table, say, tables, write_json
from hdbridge.cli.session import handling, note_clamped
from hdbridge.enums import AdaptationMode, Scheme
from hdbridge.errors import DaemonError, HdbridgeError, InputError

if TYPE_CHECKING:
    from types import FrameType

    from hdbridge.client import Client
    from hdbridge.client.messages import AxisState, Event, LeaseState, MachineState, OuterState, SdoValue
    from hdbridge.client.sync import Axis


STOP_S: Final = 3.0
"""Time-out of a stop command; s."""
AtOption = Annotated[
    str | None,
    Option(
        "--at",
        metavar="ADDRESS",
        help="Name of the machine, socket or URL of its daemon; else HDBRIDGE_SOCKET, HDBRIDGE_URL (its "
        "token in HDBRIDGE_TOKEN), or the only one that runs here.",
    ),
]
OneAxisArgument = Annotated[
    str | None, Argument(metavar="AXIS", help="Name of the axis; needed if there are several.")
]
AxisArgument = Annotated[str, Argument(metavar="AXIS", help="Name of the axis.")]
AxesArgument = Annotated[list[str] | None, Argument(metavar="AXIS...", help="Names of axes; else all.")]


@dataclass(frozen=True)
class Daemon:
    """Options of a command that needs the lease, the right to move."""

    at: AtOption = None
    force: Annotated[
        bool, Option("--force", help="Take the lease from its holder, whose motion is stopped.")
    ] = False
    json_file: opt.Json = None

    @contextmanager
    def moving(self, name: str | None) -> Iterator[Axis]:
        """Yields an axis with the lease for moving it; Ctrl-C or any other end of the command stops it.

        The name may be omitted for a single axis; raises `InputError` if there are several.
        """
        with connected(self.at) as client:
            if name is None:
                names = [*client.axes]
                if len(names) != 1:
                    raise InputError(f"AXIS: is missing; expected one of: {', '.join(names)}")
                name = names[0]
            with client.lease(force=self.force), stopped_by_signals(client, name):
                yield client.axis(name)

    def print_state(self, state: AxisState) -> None:
        """Writes and prints the state of an axis after a command."""
        write_json(self.json_file, document("ctl-axis", state))
        print_state(state)


on_daemon = taking(Daemon)
"""Gives a command the options of a `Daemon`, which it receives as its first argument."""


def connected(at: str | None, *, named: bool = True) -> Client:
    """Returns the daemon's client; ``named`` reports its machine if no address was given."""
    from hdbridge.client import Client

    client = Client(at, name="hdbridge ctl")
    if named:
        _name(at, client)
    return client


def _name(at: str | None, client: Client) -> None:
    """Reports the machine on which a command acts, if the command did not name it."""
    if at is not None:
        return
    place = client.address.socket
    machine = f"machine at {client.address}" if place is None else f"machine '{place.stem}' at {place}"
    given = next((each for each in ("HDBRIDGE_SOCKET", "HDBRIDGE_URL") if os.environ.get(each)), None)
    source = f" (from {given})" if given else ""
    note(f"{machine}{source}")


@contextmanager
def stopping(at: str | None) -> Iterator[Client]:
    """Yields the daemon's client for a stop. If it fails, the error names the holder of the bus."""
    from hdbridge.client import Client

    try:
        with Client(at, name="hdbridge ctl", timeout_s=STOP_S) as client:
            _name(at, client)
            yield client
    except DaemonError as problem:
        if type(problem) is not DaemonError:
            raise  # the daemon answered with a refusal
        raise DaemonError(f"{problem}; {_who_holds(at)}") from None


def _who_holds(at: str | None) -> str:
    """Describes the processes that hold an interface or the daemon's socket, and how to end them."""
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
        return "no process on this computer holds an interface"
    what_to_do = ", ".join(f"'kill {number}'" for number in found)
    return f"{'; '.join(found.values())}; {what_to_do} stops its axes in order and ends it"


@contextmanager
def stopped_by_signals(client: Client, name: str) -> Iterator[None]:
    """Brakes an axis to rest if the block is interrupted, and then lets the interruption propagate."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    try:
        with handling(interrupt, signal.SIGTERM, signal.SIGHUP):
            yield
    except KeyboardInterrupt:
        with suppress(HdbridgeError):  # the daemon's own supervision remains
            client.axis(name).stop()
            note(f"axis '{name}' is stopped; it stays enabled")
        raise


def print_state(state: AxisState) -> None:
    """Prints the state of an axis after a command."""
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


AXES: Final = (
    "axis",
    "state",
    "target, deg",
    "load encoder, deg",
    "error, arcsec",
    "correction, arcsec",
    "compensation",
    "model",
)


def figure(value: float | None, digits: int) -> str:
    """Formats a number in a table; None becomes a dash."""
    return "-" if value is None else f"{value:z.{digits}f}"


def axes_rows(axes: list[AxisState]) -> list[tuple[str, ...]]:
    """Returns a row of `AXES` for each axis."""
    rows: list[tuple[str, ...]] = []
    for each in axes:
        moving = "" if each.mode == "hold" else f", {each.mode}"
        queued = f", {each.queued} wait" if each.queued else ""
        rows.append(
            (
                each.name,
                f"{each.state}{moving}{queued}",
                figure(each.load_target_deg, 4),
                figure(each.load_position_deg, 4),
                figure(each.error_arcsec, 2),
                figure(each.correction_arcsec, 2),
                str(each.scheme),
                _model(each),
            )
        )
    return rows


def _model(state: AxisState) -> str:
    if state.model is None:
        return "-"
    name = "file" if state.model.version is None else str(state.model.version)
    if state.model.age_s is None:
        return name
    days = state.model.age_s / 86_400
    return f"{name}, {days:.0f} days old" if days >= 2 else f"{name}, {state.model.age_s / 3600:.0f} h old"


# ---------------------------------------------------------------- looking


def status(at: AtOption = None, json_file: opt.Json = None) -> None:
    """Report the state of a machine and its axes."""
    with connected(at, named=False) as client:
        state = client.state()
    write_json(json_file, document("ctl-status", state))
    for line in _machine_lines(state):
        say(line)
    print_table(AXES, axes_rows(state.axes))
    for line in _all_concerns(state):
        say(line)


def watch(
    at: AtOption = None,
    every_s: Annotated[
        float, Option("--every", min=0.05, max=3600.0, help="Time between updates, s.")
    ] = 0.25,
    count: Annotated[
        int | None, Option("--count", min=1, help="Number of updates; else until Ctrl-C.")
    ] = None,
    lines: Annotated[
        bool, Option("--lines", help="Print a JSON object per line instead of a table.")
    ] = False,
) -> None:
    """Show the state of a machine until Ctrl-C; nothing moves."""
    with connected(at, named=False) as client:
        if lines:
            for _ in _looks(count, every_s):
                print(client.state().model_dump_json(), flush=True)
            return
        # Rich shows a live table only on a terminal. A reader of a pipe gets one table after the other.
        with Live(console=console, auto_refresh=False) if console.is_terminal else nullcontext() as shown:
            for _ in _looks(count, every_s):
                state = client.state()
                words = (Text(line) for line in (*_machine_lines(state), *_all_concerns(state)))
                table = Group(*words, *tables(AXES, axes_rows(state.axes)))
                if shown is not None:
                    shown.update(table, refresh=True)
                else:
                    console.print(table)
                    if console.unread:
                        return


def events(
    at: AtOption = None,
    since: Annotated[int, Option("--since", min=0, help="Only events after this number.")] = 0,
    follow: Annotated[bool, Option("--follow", "-f", help="Continue until Ctrl-C.")] = False,
    json_file: opt.Json = None,
) -> None:
    """List faults, states, refused commands and remarks, oldest first."""
    with connected(at) as client:
        found = client.events(since)
        write_json(json_file, document("ctl-events", found))
        while True:
            if found.lost:
                say(f"{found.lost} older ones are no longer stored")
            for each in found.events:
                say(_event_line(each))
            if not follow or console.unread:
                return
            time.sleep(0.5)
            found = client.events(found.newest)


@on_daemon
def lease(daemon: Daemon) -> None:
    """Report who has the right to move; with --force, take it from its holder and release it."""
    with connected(daemon.at) as client:
        if daemon.force:
            with client.lease(force=True):
                pass
        state = client.lease_state()
    write_json(daemon.json_file, document("ctl-lease", state))
    say(_lease_line(state))


def mark(text: Annotated[str, Argument(metavar="TEXT", help="One line.")], at: AtOption = None) -> None:
    """Write a remark into the flight recorder, at the current cycle."""
    with connected(at) as client:
        for each in client.mark(text):
            say(_event_line(each))


def _looks(count: int | None, every_s: float) -> Iterator[int]:
    """Yields 0, 1, 2, ... with a pause before each but the first; ``count`` numbers, or endlessly if None."""
    for number in itertools.count() if count is None else range(count):
        if number:
            time.sleep(every_s)
        yield number


def _machine_lines(state: MachineState) -> list[str]:
    simulated = ", simulated" if state.simulated else ""
    load = "" if state.bus.load is None else f", load {100 * state.bus.load:.0f} %"
    bus = f"{state.bus.interface} {state.bus.channel} is {'up' if state.bus.up else 'DOWN'}{load}"
    turning = "" if state.cycle.alive else ", which is NOT running"
    skipped = f", {state.cycle.skipped} periods skipped" if state.cycle.skipped else ""
    cycle = f"cycle of {1e3 * state.cycle.period_s:g} ms{turning}{skipped}"
    return [f"machine '{state.name}'{simulated}; {bus}; {cycle}", _lease_line(state.lease)]


def _all_concerns(state: MachineState) -> list[str]:
    found = [line for each in state.axes for line in concerns(each)]
    found += [
        f"axis '{each.name}': {_outer_line(each.outer)}" for each in state.axes if each.outer is not None
    ]
    if state.recorder.note is not None:
        found.append(f"recorder: {state.recorder.note}")
    return [*found, *state.warnings]


def _outer_line(outer: OuterState) -> str:
    from hdbridge.drive.states import decode

    if not outer.alive:
        return "the gateway process does not run; if it does not come back, start 'hdbridge run' again"
    sync = "no SYNC" if outer.period_s is None else f"SYNC every {1e3 * outer.period_s:.3f} ms"
    error = f", error {outer.error}" if outer.error else ""
    state = decode(outer.statusword).value
    return (
        f"node {outer.node_id} of another master, '{state}' (6041h = {outer.statusword:04X}h){error}, {sync}"
    )


def _lease_line(state: LeaseState) -> str:
    if not state.held:
        return "nobody has the right to move"
    left = "" if state.remaining_s is None else f", for another {state.remaining_s:.1f} s; use extends it"
    return f"'{state.client}' has the right to move{left}"


def _event_line(event: Event) -> str:
    axis = "" if event.axis is None else f"  {event.axis}"
    hint = "" if event.hint is None else f"; {event.hint}"
    date = event.date.astimezone()
    return f"{event.sequence:6d}  {date:%Y-%m-%d %H:%M:%S}{axis}  {event.kind}  {event.text}{hint}".rstrip()


# ---------------------------------------------------------------- power and motion


@on_daemon
def enable(daemon: Daemon, axis: OneAxisArgument = None) -> None:
    """Switch power on at standstill; boots and verifies the drive first if necessary."""
    with daemon.moving(axis) as moved:
        daemon.print_state(moved.enable())


@on_daemon
def disable(daemon: Daemon, axis: OneAxisArgument = None) -> None:
    """Brake to rest, then switch power off. A suspended load needs a brake."""
    with daemon.moving(axis) as moved:
        daemon.print_state(moved.disable())


@on_daemon
def reset(daemon: Daemon, axis: OneAxisArgument = None) -> None:
    """Release a latched stop once its cause is gone; the axis stays disabled."""
    with daemon.moving(axis) as moved:
        daemon.print_state(moved.reset())


@taking(Daemon, opt.Homing)
def home(daemon: Daemon, homing: opt.Homing, axis: OneAxisArgument = None) -> None:
    """Home by one of the drive's own methods; the axis is disabled before and after."""
    with daemon.moving(axis) as moved:
        daemon.print_state(moved.home(**vars(homing)))


def stop(axes: AxesArgument = None, at: AtOption = None) -> None:
    """Brake axes to rest within their limits; they stay enabled. Needs no right to move."""
    with stopping(at) as client:
        states = [client.axis(each).stop() for each in axes] if axes else client.stop().axes
    for each in states:
        print_state(each)


def quick_stop(axes: AxesArgument = None, at: AtOption = None) -> None:
    """Stop axes as fast as their drives can, latched until a reset. Needs no right to move."""
    with stopping(at) as client:
        states = [client.axis(each).quick_stop() for each in axes] if axes else client.quick_stop().axes
    for each in states:
        print_state(each)


@on_daemon
def move(
    daemon: Daemon,
    axis: AxisArgument,
    angles_deg: opt.Angles,
    relative: Annotated[
        bool, Option("--relative", help="Each angle is relative to the previous target.")
    ] = False,
    velocity_deg_s: opt.Velocity = None,
    acceleration_deg_s2: opt.Acceleration = None,
    wait: Annotated[
        bool, Option("--wait/--no-wait", help="Wait until the axis rests there; else return at once.")
    ] = True,
) -> None:
    """Move the load to one angle or to several, and hold the last.

    The axis must be enabled. Ctrl-C stops it; it stays enabled.
    """
    from hdbridge.client.messages import Move

    if not wait and len(angles_deg) > 1:
        raise InputError("--no-wait goes to one angle: give one, or use 'hdbridge ctl queue'")
    limits = {"velocity_deg_s": velocity_deg_s, "acceleration_deg_s2": acceleration_deg_s2}
    Move.given(target_deg=angles_deg[0], **limits)  # refused before anything is said or done
    with daemon.moving(axis) as moved:
        state = moved.state()
        note_clamped(state.limits, **limits)
        before_deg = state.load_target_deg or 0.0
        for given_deg in angles_deg:
            before_deg = before_deg + given_deg if relative else given_deg
            state = moved.move(before_deg, **limits, wait=wait)
            (daemon.print_state if given_deg is angles_deg[-1] else print_state)(state)


@on_daemon
def jog(
    daemon: Daemon,
    axis: AxisArgument,
    velocity_deg_s: Annotated[float, Argument(metavar="SPEED", help="Speed of the load, deg/s, with sign.")],
    duration_s: Annotated[
        float, Option("--for", min=0.05, max=86_400.0, help="Time, s; Ctrl-C ends it earlier.")
    ] = 1.0,
) -> None:
    """Turn an axis at a speed for a time, then brake to rest, even if this command is killed."""
    from hdbridge.client.messages import Jog

    Jog.given(velocity_deg_s=velocity_deg_s)  # refused before anything is said or done
    with daemon.moving(axis) as moved:
        note_clamped(moved.state().limits, velocity_deg_s=velocity_deg_s)
        moved.jog(velocity_deg_s, duration_s)
        daemon.print_state(moved.rest())


@on_daemon
def queue(
    daemon: Daemon,
    axis: AxisArgument,
    angles_deg: Annotated[
        list[float] | None, Argument(metavar="ANGLE...", help="Load angles in degrees.")
    ] = None,
    velocity_deg_s: opt.Velocity = None,
    acceleration_deg_s2: opt.Acceleration = None,
    dwell_s: Annotated[float, Option("--dwell", min=0.0, max=86_400.0, help="Rest at each, s.")] = 0.0,
    clear: Annotated[
        bool, Option("--clear", help="Remove the way points not yet started; add none.")
    ] = False,
) -> None:
    """Append way points, and wait until the last one is reached. Ctrl-C stops the axis."""
    from hdbridge.client.messages import QueueItem

    if clear == bool(angles_deg):
        raise InputError("expected either angles or --clear")
    limits = {"velocity_deg_s": velocity_deg_s, "acceleration_deg_s2": acceleration_deg_s2}
    points = [QueueItem.given(target_deg=each, dwell_s=dwell_s, **limits) for each in angles_deg or ()]
    with daemon.moving(axis) as moved:
        note_clamped(moved.state().limits, **limits)
        daemon.print_state(moved.clear_queue() if clear else moved.queue(points))


# ---------------------------------------------------------------- compensation and models


@on_daemon
def compensate(
    daemon: Daemon,
    axis: AxisArgument,
    scheme: Annotated[Scheme, Argument(metavar="SCHEME", help="`none` switches the compensation off.")],
) -> None:
    """Select the part of the model that compensates: none, synchronous, hysteresis, both or extended.

    The change is ramped, also in motion.
    """
    with daemon.moving(axis) as moved:
        daemon.print_state(moved.compensate(scheme.value))


@on_daemon
def model(
    daemon: Daemon,
    axis: AxisArgument,
    version: Annotated[
        str,
        Argument(
            metavar="VERSION",
            help="Number in `hdbridge model log`; `pending` commits that one, `active` reads it again.",
        ),
    ],
) -> None:
    """Make a different model of an axis the active one; the change is ramped, also in motion."""
    if version not in {"pending", "active"} and not (version.isascii() and version.isdigit()):
        raise InputError(f"VERSION: found {version!r}; expected a number, pending or active")
    with daemon.moving(axis) as moved:
        daemon.print_state(moved.activate_model(int(version) if version.isdigit() else version))


@on_daemon
def adapt(
    daemon: Daemon,
    axis: AxisArgument,
    mode: Annotated[
        AdaptationMode | None,
        Argument(metavar="MODE", help="`off`, `observe` (report what would change) or `on`."),
    ] = None,
    back: Annotated[bool, Option("--back", help="Return to the committed model.")] = False,
) -> None:
    """Set the adaptation of model parameters to the load encoder."""
    if back == (mode is not None):
        raise InputError("expected either a mode or --back")
    with daemon.moving(axis) as moved:
        daemon.print_state(moved.revert_adaptation() if mode is None else moved.adapt(mode.value))


@on_daemon
def load_loop(
    daemon: Daemon, axis: AxisArgument, on: Annotated[bool, Option("--on/--off", help="Switch it on or off.")]
) -> None:
    """Switch the slow integral of the load error on or off, if the machine file has one."""
    with daemon.moving(axis) as moved:
        daemon.print_state(moved.load_loop(on))


# ---------------------------------------------------------------- objects of the drive


def get(axis: AxisArgument, object_: opt.Object, at: AtOption = None, json_file: opt.Json = None) -> None:
    """Read an object of the drive by SDO, between the cycles."""
    with connected(at) as client:
        _print_object(client.axis(axis).read(object_), json_file)


@on_daemon
def put(daemon: Daemon, axis: AxisArgument, object_: opt.Object, value: opt.Value) -> None:
    """Write an object of the drive by SDO, and read it back; refused while the axis is enabled."""
    with daemon.moving(axis) as moved:
        _print_object(moved.write(object_, value), daemon.json_file)


def _print_object(found: SdoValue, json_file: Path | None) -> None:
    write_json(json_file, document("ctl-object", found))
    print_object(f"{found.index:04X}h:{found.subindex:02X} '{found.name}'", found.value, found.type)


COMMANDS: Final = {
    "ctl": {
        "status": status,
        "watch": watch,
        "events": events,
        "lease": lease,
        "mark": mark,
        "enable": enable,
        "disable": disable,
        "reset": reset,
        "home": home,
        "stop": stop,
        "quick-stop": quick_stop,
        "compensate": compensate,
        "model": model,
        "adapt": adapt,
        "load-loop": load_loop,
        "get": get,
        "move": move,
        "jog": jog,
        "queue": queue,
        "set": put,
    }
}
