"""Commands before the first move: `new`, `check`, `scan`, `doctor`, `latency`."""

from __future__ import annotations

from contextlib import nullcontext
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from typer import Argument, Option

from hdbridge.cli import options as opt
from hdbridge.cli.options import taking
from hdbridge.cli.printing import console, note, progress_bar, say, write_json
from hdbridge.cli.session import BusOptions, Session, deferred_interrupt, on_axis
from hdbridge.clock import MonotonicClock
from hdbridge.commissioning.bringup import ASK_TIMEOUT_S, LISTEN_S, TORQUE_PERCENT
from hdbridge.commissioning.bringup.checks import Check, Outcome, Verdict, failed, not_possible, passed
from hdbridge.errors import DriveError, InputError, command
from hdbridge.files.profile import Profile

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig, BusConfig
    from hdbridge.commissioning.bringup.checks import Row
    from hdbridge.commissioning.bringup.scan import Node, Scan
    from hdbridge.commissioning.bringup.slow import BringUpContext
    from hdbridge.control.latency import Measurement
    from hdbridge.daemon.machine import Machine


# ---------------------------------------------------------------- new


class Source(Enum):
    """Origin of a new profile."""

    DEMO = "demo"
    ARTICLE = "article"
    SCAN = "scan"


def new(
    name: Annotated[Path, Argument(metavar="NAME", help="New folder; its name is the axis's.")],
    source: Annotated[
        Source, Option("--from", help="Bundled profile to copy, or the drive that answers on a bus.")
    ] = Source.DEMO,
    interface: opt.Interface = None,
    channel: opt.Channel = None,
    bitrate_bps: opt.Bitrate = None,
    node_id: opt.Node = None,
    eds: opt.Eds = None,
    json_file: opt.Json = None,
) -> None:
    """Make the folder of an axis: a copy of a bundled profile, or from the data of a drive on the bus.

    With `--from scan --interface socketcan --channel can0` the axis file has the identity, encoders and gear
    that the drive reports; missing values are marked, and `hdbridge check` stops there. Nothing moves.
    """
    from hdbridge.axis import AxisConfig
    from hdbridge.commissioning.bringup.newprofile import copy_bundled

    if source is Source.SCAN:
        written = _scanned(name, interface, channel, bitrate_bps, node_id, eds)
    else:
        given = {"--interface": interface, "--channel": channel, "--node": node_id, "--eds": eds}
        for option, value in given.items():
            if value is not None:
                raise InputError(f"{option} says where to scan: give --from scan with it, or leave it out")
        written = copy_bundled(source.value, name)
    write_json(json_file, {"schema": "hdbridge.new/1", "files": [str(each) for each in written]})
    for each in written:
        say(f"wrote {each}")
    try:
        AxisConfig.load(name)
    except InputError as problem:
        say(f"to be completed: {problem}")
    say(f"next: {command('check', name)}")


def _scanned(
    folder: Path,
    interface: str | None,
    channel: str | None,
    bitrate_bps: int | None,
    node_id: int | None,
    eds: Path | None,
) -> list[Path]:
    from hdbridge.axis import BusConfig
    from hdbridge.commissioning.bringup.newprofile import write_scanned
    from hdbridge.commissioning.bringup.scan import scan_bus
    from hdbridge.drive.link import Link, open_bus

    if interface is None or channel is None:
        raise InputError("--from scan needs a bus: give --interface and --channel (socketcan, can0)")
    bus = BusConfig(interface=interface, channel=channel, bitrate_bps=bitrate_bps)
    with open_bus(bus) as opened:
        note("asking nodes ...")
        link = Link(opened, MonotonicClock())
        found = scan_bus(link)
    return write_scanned(folder, bus, _only_usable(link.name, found.nodes, node_id), eds)


def _only_usable(bus: str, nodes: tuple[Node, ...], node_id: int | None) -> Node:
    usable = [each for each in nodes if each.usable and node_id in {None, each.node_id}]
    if len(usable) == 1:
        return usable[0]
    there = ", ".join(f"{each.node_id} ({each.kind})" for each in nodes) or "none"
    if not usable:
        raise DriveError(f"{bus}: no CiA-402 drive with CSP answers; found nodes: {there}")
    raise InputError(f"{bus}: several drives answer: {there}; choose one with --node")


# ---------------------------------------------------------------- check

CheckedArgument = Annotated[
    str,
    Argument(
        metavar="PROFILE",
        help="Folder with axis.yaml (and model.yaml), axis file, machine file, or a bundled one: "
        "article, demo, cell.",
    ),
]


def check(profile: CheckedArgument, model: opt.Model = None, json_file: opt.Json = None) -> None:
    """Check the files of an axis or of a machine; report their meaning, or the errors with their location."""
    from hdbridge.axis import AxisConfig
    from hdbridge.daemon.machine import Machine, machine_file
    from hdbridge.drive.link import check_interface

    path = machine_file(profile)
    if path is None:
        files = Profile.find(profile)
        axis = AxisConfig.load(files.axis)
        check_interface(axis.bus.interface, axis.where("bus.interface"))
        _check_channel(axis.bus, axis.where("bus.channel"))
        reports = [_Report(axis, model or _existing(files.model))]
        document: dict[str, Any] = {"schema": "hdbridge.check/1", **reports[0].document()}
    elif model is not None:
        raise InputError(
            "--model applies to a single axis: a machine's axes have their models in their profiles"
        )
    else:
        machine = Machine.load(path)
        check_interface(machine.bus.interface, machine.axes[0].config.where("bus.interface"))
        _check_channel(machine.bus, f"{path}: bus.channel")
        if machine.gateway is not None:
            _check_channel(machine.gateway.bus, f"{path}: gateway.bus.channel")
        reports = [_Report(axis.config, _existing(axis.profile.model)) for axis in machine.axes]
        facts = _of_machine(machine)
        document = {"schema": "hdbridge.check/1", **facts, "axes": [each.document() for each in reports]}
        _print_facts(facts)
    write_json(json_file, document)
    for report in reports:
        report.print()
    say("all right")


def _check_channel(bus: BusConfig, where: str) -> None:
    """Prints a note if this computer lacks the channel; the file may be meant for another computer."""
    from hdbridge.drive.link import absent_interface

    if absent := absent_interface(bus):
        note(f"note: {where}: {absent}")


def _existing(path: Path) -> Path | None:
    return path if path.exists() else None


def _of_machine(machine: Machine) -> dict[str, str]:
    from hdbridge.drive.busload import bus_load

    load = bus_load([axis.config for axis in machine.axes], machine.bus.bitrate_bps)
    names = ", ".join(axis.name for axis in machine.axes)
    gateway = machine.gateway
    outer: dict[str, str] = {}
    if gateway is not None:
        nodes = ", ".join(f"{name} as node {node}" for name, node in gateway.nodes.items())
        outer["gateway"] = f"{nodes} on {gateway.bus.interface}:{gateway.bus.channel}"
        outer["gateway increment"] = f"{1_296_000 / gateway.counts_per_turn:.3g} arcsec at the load"
    return {
        "machine": machine.name,
        "axes": names,
        **outer,
        "bus load": f"{100 * load:.0f} % at most" if load is not None else "not known: no bitrate_bps",
    }


def _print_facts(facts: dict[str, str]) -> None:
    for name, value in facts.items():
        say(f"{name:>20}  {value}")


class _Report:
    """Report on the files of one axis."""

    def __init__(self, axis: AxisConfig, model: Path | None) -> None:
        from hdbridge.axis.model import TransmissionModel
        from hdbridge.commissioning.evaluation.stepping import quantisation_floor_arcsec
        from hdbridge.control.bench import compensation_for
        from hdbridge.control.caps import cap_remark
        from hdbridge.drive.bootplan import left_to_drive, plan, unrequested_objects
        from hdbridge.drive.layout import layouts
        from hdbridge.files.edsfile import shared_eds

        plan(axis)
        floor = quantisation_floor_arcsec(axis.motor_encoder.counts_per_turn, axis.gear.ratio)
        self.facts = {
            "axis": axis.name,
            "bus": f"{axis.bus.interface}:{axis.bus.channel}, node {axis.drive.node_id}",
            "cycle": f"{axis.drive.cycle_ms:g} ms",
            "ratio": f"{axis.gear.ratio:g}",
            "one motor count": f"{floor / 3 * 12**0.5:.3g} arcsec at the load",
            "quantisation floor": f"{floor:.3g} arcsec (3 sigma)",
            "travel": f"{axis.limits.position_min_deg:g} to {axis.limits.position_max_deg:g} deg",
        }
        if axis.channels:
            self.facts["other channels"] = ", ".join(axis.channels).replace("_", " ")
        self.remark: str | None = None
        if model is not None:
            loaded = TransmissionModel.load(model)
            compensation_for(axis, loaded)
            self.remark = cap_remark(axis, loaded)
            if response := loaded.response:
                self.facts["response"] = (
                    f"measured; orders are corrected up to {response.known_to_hz:.0f} Hz in motion"
                )
            self.facts["model"] = ", ".join(each.name for each in loaded.effects) or "no effects"
        pdos = layouts(axis)
        self.rows: dict[str, list[str]] = {
            "fixed mapping": [
                str(each) for each in (*pdos.cyclic, *pdos.channels, *pdos.rpdos) if each.is_fixed
            ],
            "sent along": unrequested_objects(axis),
            "left to the drive": [
                f"{each}{f' ({axis.where(each.field)})' if each.field else ''}"
                for each in left_to_drive(axis)
            ],
            "not read": list(shared_eds(axis.eds_path, axis.drive.node_id).unread),
        }

    def document(self) -> dict[str, Any]:
        """Returns the report as data."""
        return {**self.facts, **self.rows}

    def print(self) -> None:
        _print_facts(self.facts)
        for name, rows in self.rows.items():
            for row in rows:
                say(f"{name:>20}  {row}")
        if self.remark:
            note(self.remark)


@taking(BusOptions)
def scan(
    reach: BusOptions,
    profile: Annotated[
        str | None,
        Argument(
            metavar="PROFILE",
            help="Axis whose bus is scanned and whose drive is expected. Without it: --interface and "
            "--channel.",
        ),
    ] = None,
    bitrate_bps: opt.Bitrate = None,
    listen_s: Annotated[
        float, Option("--listen", min=0.0, max=3600.0, help="Seconds to listen before asking; at least 0.51.")
    ] = LISTEN_S,
    timeout_ms: Annotated[
        float, Option("--timeout-ms", min=1.0, max=5000.0, help="Time for each node id to answer.")
    ] = 1000.0 * ASK_TIMEOUT_S,
    json_file: opt.Json = None,
) -> None:
    """List the nodes on a CAN bus: type, identity, state, and lines for an axis file.

    Listens first, and sends nothing if another master is heard. Then reads a few objects of each node id.
    Writes and enables nothing, and skips a node that another SDO client is using.

    Exit status 4 if no node was found, or PROFILE's drive is missing.
    """
    from hdbridge.axis import BusConfig
    from hdbridge.commissioning.bringup.scan import compare, scan_bus
    from hdbridge.drive.link import Link

    axis = None
    if profile is not None:
        session = reach.of(profile)
        axis, opened = session.axis, session.connected()
    elif reach.simulate or reach.interface is None or reach.channel is None:
        raise InputError("scan needs a bus: give a PROFILE, or --interface and --channel (socketcan, can0)")
    else:
        named = BusConfig(interface=reach.interface, channel=reach.channel, bitrate_bps=bitrate_bps)
        opened = reach.bare(named)
    with opened as (bus, clock), progress_bar() as bar:
        link = Link(bus, clock)
        task = bar.add_task("asking nodes", total=1.0)
        found = scan_bus(
            link,
            listen_s=listen_s,
            timeout_s=timeout_ms / 1000.0,
            force=reach.force,
            progress=lambda share: bar.update(task, completed=share),
        )
    matches, lines = (False, []) if axis is None else compare(axis, found)
    result = _scan_document(link.name, found)
    if axis is not None:
        result["axis"] = {"name": axis.name, "matches": matches, "differences": lines}
    write_json(json_file, result)
    _print_scan(link.name, found)
    if axis is not None:
        if matches:
            say(f"\nnode {axis.drive.node_id} is the drive of {axis.path}")
        for line in lines:
            say(line)
    if not found.nodes:
        raise DriveError(
            f"{link.name}: no node answers; check power, wiring, the termination at both ends (60 ohm "
            "between CAN_H and CAN_L) and that every node has the same bit rate"
        )
    if axis is not None and not matches:
        raise DriveError(f"{link.name}: the drive of {axis.path} is not among the nodes; see the lines above")


def _print_scan(name: str, found: Scan) -> None:
    from hdbridge.commissioning.bringup.scan import axis_lines

    count = len(found.nodes)
    say(f"{name}: {count} node{'' if count == 1 else 's'}")
    for node in found.nodes:
        say(f"\nnode {node.node_id}: {node.kind}", style="bold")
        for label, value in _facts_of_node(node).items():
            say(f"{label:>12}  {value}")
        if lines := axis_lines(node):
            say("  for the axis file:")
            for line in lines:
                say(f"    {line}")
    for remark in found.remarks:
        note(f"note: {remark}")


def _facts_of_node(node: Node) -> dict[str, str]:
    facts = {"NMT state": node.state}
    if node.device_type is not None:
        facts["device type"] = f"{node.device_type:08X}h"
    if node.identity:
        facts["identity"] = ", ".join(
            f"{name.replace('_', ' ')} {value:#x}" for name, value in node.identity.items()
        )
    facts |= {name: text for name, text in node.names.items() if text}
    if node.modes is not None:
        facts["modes"] = ", ".join(node.mode_names) or "none"
    return facts


def _scan_document(name: str, found: Scan) -> dict[str, Any]:
    from hdbridge.commissioning.bringup.scan import axis_lines

    return {
        "schema": "hdbridge.scan/1",
        "bus": name,
        "nodes": [
            {
                "node_id": node.node_id,
                "answers": node.answers,
                "kind": node.kind,
                "device_type": node.device_type,
                "profile": node.profile,
                "nmt_state": node.nmt_state,
                "state": node.state,
                "identity": node.identity,
                "names": node.names,
                "modes": node.mode_names,
                "usable": node.usable,
                "axis_file": axis_lines(node),
            }
            for node in found.nodes
        ],
        "remarks": list(found.remarks),
    }


# ---------------------------------------------------------------- doctor

_MARKS = {
    Outcome.PASS: "[green]pass[/green]        ",
    Outcome.FAIL: "[bold red]FAIL[/bold red]        ",
    Outcome.NOT_POSSIBLE: "[yellow]not possible[/yellow]",
}
_WARNING = (
    "The next checks switch the drive on and move the axis: up to a motor turn and an eighth each way (more "
    "with a ratio above 75), slowly, with at most {torque:g} % of the rated torque. Keep the path clear "
    "and a "
    "hardware emergency stop at hand. Move now?"
)
_FAST = (
    "After these, the last check runs the axis at up to 64 % of its speed limit in the middle of its "
    "travel, with its full torque."
)
DECLINED = "motion was not confirmed (on a terminal: answer y; in a script: --yes)"
LEFT_OUT = "left out by --no-motion"


@on_axis
def doctor(
    session: Session,
    torque_percent: Annotated[
        float,
        Option(
            "--torque-percent",
            min=1.0,
            max=500.0,
            help="Highest motor torque, relative to the rated torque; never above limits.torque_percent.",
        ),
    ] = TORQUE_PERCENT,
    yes: Annotated[bool, Option("--yes", help="Move the axis without asking.")] = False,
    motion: Annotated[
        bool, Option("--motion/--no-motion", help="--no-motion: only checks without power.")
    ] = True,
    servo: Annotated[
        bool,
        Option(
            "--servo",
            help="Also run at up to 64 % of the speed limit and compare the servo with the model's response.",
        ),
    ] = False,
    json_file: opt.Json = None,
) -> None:
    """Check an axis before its first long motion: files, bus, drive, encoders, directions, ratio, stops.

    A failed check is followed by the line of the axis file to change, or by another remedy.

    Exit status 0 if all checks passed, 4 if one failed or motion was not confirmed, 2 if the first failure
    is a file, 3 if it is the bus. This is not a safety function: the emergency stop must be in hardware.
    """
    from hdbridge.commissioning.bringup.checks import run_checks
    from hdbridge.commissioning.bringup.doctor import CHECKS
    from hdbridge.commissioning.bringup.slow import BringUpContext

    files = session.files
    refused: list[str] = []

    def permitted() -> str | None:
        if not motion:
            return LEFT_OUT
        if session.simulate or yes or _confirm(torque_percent, servo):
            return None
        refused.append(DECLINED)
        return DECLINED

    with BringUpContext(
        lambda: session.axis,
        lambda _axis: session.connected(),
        torque_percent=torque_percent,
        force=session.force,
        interruptible=deferred_interrupt,
    ) as context:
        moving = next(place for place, each in enumerate(CHECKS) if each.moves)
        checks = (*CHECKS[:moving], RESPONSE, *CHECKS[moving:], SERVO) if servo else CHECKS
        rows = run_checks(context, checks, permitted=permitted, notify=_print_row)
    failures = [row for row in rows if row.verdict.outcome is Outcome.FAIL]
    write_json(
        json_file,
        {
            "schema": "hdbridge.doctor/1",
            "axis_file": str(files.axis),
            "simulated": session.simulate,
            "passed": not failures and not refused,
            "checks": [row.as_dict() for row in rows],
        },
    )
    if failures:
        first = failures[0]
        raise first.verdict.error(
            f"{files.axis}: {len(failures)} of {len(rows)} checks failed, first '{first.check.title}'; "
            "the lines below each give the remedy"
        )
    if refused:
        raise DriveError(f"{files.axis}: {DECLINED}")
    say("all right" if motion else "all right, as far as it can be checked without motion")


def _confirm(torque_percent: float, servo: bool) -> bool:
    if servo:
        note(_FAST)
    try:
        return typer.confirm(_WARNING.format(torque=torque_percent), err=True)
    except typer.Abort:  # no terminal, or end of input
        note("")
        return False


def _print_row(row: Row[BringUpContext]) -> None:
    console.print(f"{_MARKS[row.verdict.outcome]}  {row.check.title:<25}", end=" ")
    say(row.verdict.measured)
    for remedy in row.verdict.remedies:
        say(f"              -> {remedy}")


def _stored_response(context: BringUpContext) -> Verdict:
    """Checks, before any motion, that the model's response is valid for this drive, axis and cycle time."""
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.control.bench import compensation_for

    path = context.axis.path.with_name("model.yaml")
    model = TransmissionModel.load(path) if path.exists() else None
    if model is None or model.response is None:
        return not_possible("there is no model with a response in motion: hdbridge motion --propose")
    model.check_bound_to(context.axis, context.drive.identity)
    compensation_for(context.axis, model)
    return passed(f"{path}: known up to {model.response.known_to_hz:.0f} Hz")


def _servo_as_measured(context: BringUpContext) -> Verdict:
    """Runs the axis at constant speeds with its correction, and compares the response with the model's."""
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.commissioning.calibration.motion import servo_check

    model = TransmissionModel.load(context.axis.path.with_name("model.yaml"))
    with context.interruptible() as interrupted:
        found = servo_check(context.boot(), model, interrupted)
    text = (
        f"following lag {found.lag_ms:.1f} ms, {found.stored_lag_ms:.1f} when it was measured; "
        f"responses differ by {100.0 * found.difference:.0f} %"
    )
    figures = {
        "following_lag_ms": found.lag_ms,
        "stored_following_lag_ms": found.stored_lag_ms,
        "difference": found.difference,
    }
    if found.agrees:
        return passed(text, **figures)
    return failed(
        text, "restore the gains of the servo, or measure it again: hdbridge motion --propose", **figures
    )


RESPONSE: Final[Check[Any]] = Check("response", "the stored response", _stored_response, ("boot",))
SERVO: Final[Check[Any]] = Check(
    "servo", "servo as measured", _servo_as_measured, ("response", "turn", "quick_stop", "off"), moves=True
)


def latency(
    duration_s: Annotated[
        float, Option("--duration", min=0.1, max=86_400, help="Seconds for each cycle time.")
    ] = 10.0,
    cycle_ms: Annotated[
        list[float] | None,
        Option("--cycle-ms", min=0.1, max=1000, help="Only this cycle time; may be repeated."),
    ] = None,
    realtime: Annotated[
        bool, Option(help="Request real-time priority and locked memory, like the control loop.")
    ] = True,
    json_file: opt.Json = None,
) -> None:
    """Measure timer latency; print its histogram and the shortest cycle that this computer sustains.

    Run it on the control computer under its usual load, for minutes.
    """
    from hdbridge.control.latency import CANDIDATES_S, measure
    from hdbridge.control.realtime import prepare_realtime

    periods = tuple(each / 1000.0 for each in cycle_ms) if cycle_ms else CANDIDATES_S

    def notify(done: Measurement) -> None:
        note(f"measured {1e3 * done.period_s:g} ms")

    with prepare_realtime() if realtime else nullcontext("ordinary priority") as conditions:
        report = measure(MonotonicClock(), duration_s, periods, conditions=str(conditions), progress=notify)
    write_json(json_file, report.as_dict())
    say(report.table())


COMMANDS: Final = {"new": new, "check": check, "scan": scan, "doctor": doctor, "latency": latency}
