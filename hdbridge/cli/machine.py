"""Commands for the daemon and its gateway: `run`, `install-service`, `gateway`, and `simulate`."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import chain, islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from typer import Option

from hdbridge.cli import eventlog
from hdbridge.cli import options as opt
from hdbridge.cli.options import need_extra
from hdbridge.cli.printing import note, say, write_json
from hdbridge.cli.session import Session, check_bus_options, deferred_interrupt, simulated_by
from hdbridge.clock import Clock, MonotonicClock
from hdbridge.errors import BusInUseError, DriveError, InputError

if TYPE_CHECKING:
    import can
    from canopen.objectdictionary import ObjectDictionary

    from hdbridge.axis import AxisConfig, BusConfig
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.daemon.machine import Machine
    from hdbridge.daemon.machinefile import GatewaySettings
    from hdbridge.daemon.start import Simulation
    from hdbridge.daemon.systemd import ServiceFile
    from hdbridge.device.node import DriveNode
    from hdbridge.drive.link import Frame


# ---------------------------------------------------------------- run

_EXTRA = ("fastapi", "uvicorn", "websockets", "mcap", "prometheus_client")
"""Packages of the extra ``daemon``."""


def run(
    machine: opt.Machine,
    simulate: Annotated[
        bool, Option("--simulate", help="Control simulated drives instead of those on the bus.")
    ] = False,
    speed: Annotated[
        float,
        Option(
            "--speed", min=0.01, max=1000.0, help="With --simulate: speed relative to real time, at most."
        ),
    ] = 1.0,
    truth: Annotated[
        list[Path] | None,
        Option(
            "--truth",
            metavar="TRUTH.yaml",
            help="Truth file of a simulated axis; once for each axis, in order.",
        ),
    ] = None,
    seed: opt.Seed = 0,
    interface: opt.Interface = None,
    channel: opt.Channel = None,
    page: Annotated[
        bool, Option("--page", help="Serve the live page to this computer and print its address.")
    ] = False,
    port: Annotated[int, Option("--port", min=0, max=65_535, help="Port of --page; 0: any.")] = 8402,
    force: opt.Force = False,
) -> None:
    """Run the daemon: control the drives of a machine and accept load angles from clients.

    Nothing moves until a client enables an axis. SIGTERM, Ctrl-C and SIGHUP stop the axes in an orderly way
    and end the daemon; a second signal stops them at the quick-stop ramp. A drive fault is reported and
    latched.

    Exit status: 0 orderly end, 1 a process died repeatedly, 2 bad input, 3 the bus cannot be opened or has
    another master, 7 another daemon has the API's address.
    """
    check_bus_options(interface, channel, simulate=simulate)
    need_extra("the daemon needs", _EXTRA, "daemon")
    from hdbridge.daemon.hold import hold
    from hdbridge.daemon.logs import LogSettings
    from hdbridge.daemon.machine import Machine
    from hdbridge.drive.link import check_interface

    held = Machine.find(machine)
    changes = {name: given for name, given in (("interface", interface), ("channel", channel)) if given}
    held = held.on_bus(**changes) if changes else held
    simulation = _simulation(held, truth or [], seed, speed) if simulate else None
    if (gateway := held.gateway) is not None and gateway.bus.interface == "virtual":
        raise InputError(
            f"{held.path}: gateway.bus: 'virtual' reaches no other process; expected the interface "
            "of the other master (socketcan, or udp_multicast without hardware)"
        )
    if simulation is None:
        where = "--interface" if interface else held.axes[0].config.where("bus.interface")
        check_interface(held.bus.interface, where)
        _check_real(held, truth or [], speed)
    log = LogSettings(*eventlog.handed_over())
    raise typer.Exit(hold(held, simulation, force=force, page=port if page else None, log=log))


def _simulation(machine: Machine, truths: list[Path], seed: int, speed: float) -> Simulation:
    from hdbridge.daemon.start import Simulation
    from hdbridge.sim.truth import Truth

    if truths and len(truths) != len(machine.axes):
        names = ", ".join(axis.name for axis in machine.axes)
        raise InputError(f"--truth: given {len(truths)} times; expected once for each of the axes {names}")
    paths = tuple(path.absolute() for path in truths) or tuple(
        simulated_by(axis.profile, None) for axis in machine.axes
    )
    for path in paths:
        Truth.load(path)
    return Simulation(paths, seed, speed)


def _check_real(machine: Machine, truths: list[Path], speed: float) -> None:
    if truths or speed != 1.0:
        raise InputError("--truth and --speed are for simulated axes: give --simulate with them")
    if machine.bus.interface == "virtual":
        raise InputError(
            f"{machine.path}: the bus 'virtual' reaches nothing outside this process; expected the interface "
            "of the bus (socketcan), or give --simulate, which puts simulated drives there"
        )


def install_service(
    machine: opt.Machine,
    yes: Annotated[bool, Option("--yes", help="Write the files; else they are only shown.")] = False,
    remove: Annotated[bool, Option("--remove", help="Remove the files.")] = False,
    user: Annotated[bool, Option("--user", help="For your own service manager, without root.")] = False,
    account: Annotated[
        str | None,
        Option("--account", metavar="NAME", help="User of the service; else the owner of the machine file."),
    ] = None,
) -> None:
    """Show, write or remove the systemd files that run a machine's daemon from the start of the computer.

    Nothing is started; the necessary commands are printed.
    """
    from hdbridge.daemon.machine import Machine
    from hdbridge.daemon.systemd import service_files

    if user and account is not None:
        raise InputError("--account does not apply to your own service manager: leave it out")
    held = Machine.find(machine)
    if held.bus.interface == "virtual":
        raise InputError(
            f"{held.path}: the bus 'virtual' reaches no drive; expected the interface of the bus (socketcan)"
        )
    files = service_files(held, user=user, account=account)
    foreign = [each.path for each in files if not each.ours]
    if foreign and (yes or remove):
        raise InputError(
            f"{foreign[0]}: was not written by this program, or cannot be read; move it away first"
        )
    if remove:
        _remove(files)
    elif yes:
        _write(files)
        _print_next_steps(held, files, user=user)
    else:
        for file in files:
            say(f"# {file.path}")
            say(file.text)
        say("nothing was written: --yes writes this")


def _write(files: list[ServiceFile]) -> None:
    from hdbridge.files.atomic import write_atomically

    for file in files:
        try:
            file.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as problem:
            raise InputError(_refused(file, problem)) from None
        write_atomically(file.path, file.text)
        file.path.chmod(0o644)
        say(f"wrote {file.path}")


def _remove(files: list[ServiceFile]) -> None:
    for file in files:
        if not file.path.exists():
            say(f"{file.path} is not there")
            continue
        try:
            file.path.unlink()
        except OSError as problem:
            raise InputError(_refused(file, problem)) from None
        say(f"removed {file.path}")


def _refused(file: ServiceFile, problem: OSError) -> str:
    return f"{file.path}: {problem.strerror}; expected the rights of root (sudo), or --user"


def _print_next_steps(machine: Machine, files: list[ServiceFile], *, user: bool) -> None:
    control = "systemctl --user" if user else "systemctl"
    unit = files[0].path.name
    say("next:")
    if len(files) > 1:
        say("  networkctl reload")
    say(f"  {control} daemon-reload")
    say(f"  {control} enable --now {unit}")
    if user and machine.bus.interface == "socketcan":
        say("the CAN interface is set up by root: see docs/daemon.md")


def eds(machine: opt.Machine, axis: opt.GatewayAxis = None) -> None:
    """Print the EDS of an axis on the gateway's bus, for the tool that configures the other master.

    hdbridge gateway eds cell > axis1.eds
    """
    from hdbridge.daemon.gateway.objects import eds as text_of

    typer.echo(text_of(*gateway_axis(machine, axis)), nl=False)


def doctor(
    machine: opt.Machine,
    axis: opt.GatewayAxis = None,
    duration_s: Annotated[
        float, Option("--duration", min=0.1, max=86_400.0, help="Time to listen, s; Ctrl-C ends it earlier.")
    ] = 10.0,
    log: Annotated[
        Path | None,
        Option(
            "--log", metavar="FILE", help="Read a bus log (.log, .asc, .blf, .trc, .mf4) instead of the bus."
        ),
    ] = None,
    json_file: opt.Json = None,
) -> None:
    """Listen to the other master; report its configuration, its commands and its mistakes, with reasons.

    Sends nothing, so it may run next to the daemon.

    Exit status 4 if the master made a mistake, or no frame of the axis was received.
    """
    from hdbridge.daemon.gateway.trace import Trace

    logged = None if log is None else _logged(log)
    first = [] if logged is None else list(islice(logged, 1))  # an unreadable file is refused early
    config, settings, model = gateway_axis(machine, axis)
    node_id = settings.nodes[config.name]
    trace = Trace(node_id, eds_of(config, settings, model))
    rows: list[dict[str, Any]] = []
    begun_s: float | None = None
    frames = _heard(settings, duration_s) if logged is None else chain(first, logged)
    for frame in frames:
        begun_s = frame.time_s if begun_s is None else begun_s
        for line in trace.take(frame):
            at_s = line.time_s - begun_s
            rows.append({"time_s": round(at_s, 6), "text": line.text, "advice": line.advice})
            say(f"{at_s:10.4f}  {line.text}")
            if line.advice:
                say(f"{'':10}  > {line.advice}", style="bold")
    configured = trace.configured()
    for text in configured:
        say(f"configured  {text}")
    write_json(
        json_file,
        {"schema": "hdbridge.gateway-doctor/1", "node_id": node_id, "configured": configured, "trace": rows},
    )
    if begun_s is None:
        raise DriveError(
            f"node {node_id}: nothing was heard on the outer bus; expected the other master's frames"
        )
    if trace.mistakes:
        advice, count = trace.mistakes.most_common(1)[0]
        which = f"{count} times" if count > 1 else "the first"
        raise DriveError(
            f"node {node_id}: mistakes of the other master: {trace.mistakes.total()}; {which}: {advice}"
        )


def eds_of(axis: AxisConfig, settings: GatewaySettings, model: TransmissionModel) -> ObjectDictionary:
    """Returns the object dictionary of a gateway axis, read from its EDS like another master does."""
    from hdbridge.daemon.gateway.objects import write_eds
    from hdbridge.files.edsfile import read_eds

    with TemporaryDirectory(prefix="hdbridge-gateway-") as folder:
        return read_eds(write_eds(Path(folder), axis, settings, model), settings.nodes[axis.name]).dictionary


def _heard(settings: GatewaySettings, duration_s: float) -> Iterator[Frame]:
    """Yields the frames on the bus of the gateway for ``duration_s``."""
    from hdbridge.drive.link import Link, open_bus

    with deferred_interrupt() as interrupted, open_bus(settings.bus, shared=True) as bus:
        link = Link(bus, MonotonicClock())
        note(f"listening on {link.name} for {duration_s:g} s")
        end_s = link.now() + duration_s
        while not interrupted() and (now_s := link.now()) < end_s:
            if (frame := link.recv(min(end_s, now_s + 0.2))) is not None:
                yield frame


def _logged(path: Path) -> Iterator[Frame]:
    """Yields the frames of a bus log; InputError if it cannot be read."""
    from hdbridge.control.buslog import messages
    from hdbridge.drive.link import Frame

    cut_off: list[str] = []
    for message in messages(path, cut_off):
        yield Frame(message.arbitration_id, bytes(message.data), message.timestamp)
    for problem in cut_off:
        note(f"{path}: {problem}")


def gateway_axis(machine: str, name: str | None) -> tuple[AxisConfig, GatewaySettings, TransmissionModel]:
    """Returns an axis of a machine's gateway, the gateway's settings, and the axis's model.

    InputError if the machine has no gateway, or if ``name`` is needed to select one of several axes.
    """
    from hdbridge.daemon.machine import Machine

    found = Machine.find(machine)
    if found.gateway is None:
        raise InputError(
            f"{found.path}: has no gateway; expected a machine file with a key 'gateway' (docs/gateway.md)"
        )
    names = [*found.gateway.nodes]
    if name is None and len(names) > 1:
        raise InputError(
            f"{found.path}: the gateway has several axes; give --axis with one of: {', '.join(names)}"
        )
    if name is not None and name not in names:
        raise InputError(f"--axis {name}: not in the gateway; expected one of: {', '.join(names)}")
    axis = found.axis(name or names[0])
    return axis.config, found.gateway, axis.model()


def simulate(
    profile: opt.Profile,
    truth: opt.Truth = None,
    seed: opt.Seed = 0,
    interface: opt.Interface = None,
    channel: opt.Channel = None,
    gateway: Annotated[
        bool,
        Option(
            "--gateway", help="PROFILE is a machine: an ideal drive with the bus and objects of its gateway."
        ),
    ] = False,
    axis: opt.GatewayAxis = None,
    duration_s: Annotated[
        float | None, Option("--duration", min=0.0, help="Stop after this time, s; else at Ctrl-C.")
    ] = None,
) -> None:
    """Run the simulated drive of a profile on its bus, in real time, until Ctrl-C.

    Another process acts as its master, for example over SocketCAN:

        hdbridge simulate article --interface socketcan --channel vcan0 &

        hdbridge step article --interface socketcan --channel vcan0
    """
    from hdbridge.device.run import run
    from hdbridge.drive.link import open_bus

    if gateway and (truth, interface, channel) != (None, None, None):
        raise InputError(
            "--gateway: the drive is ideal and its bus is the gateway's; leave out --truth, --interface and "
            "--channel"
        )
    if axis and not gateway:
        raise InputError("--axis: names an axis of a gateway; add --gateway, or leave it out")
    clock = MonotonicClock()
    with deferred_interrupt() as interrupted, TemporaryDirectory(prefix="hdbridge-gateway-") as folder:
        name, config, make = (
            _ideal(profile, axis, Path(folder))
            if gateway
            else _simulated(profile, truth, seed, interface, channel)
        )
        with open_bus(config, shared=True) as bus:
            node = make(bus=bus, clock=clock)
            _refuse_another(bus, clock, node.node_id)
            note(f"{name} drive: node {node.node_id} on {bus.channel_info}; Ctrl-C ends it")
            end = float("inf") if duration_s is None else clock.now() + duration_s
            run(bus, node, clock, lambda: interrupted() or clock.now() >= end)


def _refuse_another(bus: can.BusABC, clock: Clock, node_id: int) -> None:
    """Raises `BusInUseError` if another node with this id answers a request or sends frames of its own."""
    from hdbridge.drive.link import Link
    from hdbridge.drive.masterdetection import listening_s
    from hdbridge.drive.objects import COB_SDO_REQUEST

    link = Link(bus, clock)
    # SDO upload of 1000h, which every node must have
    link.send(COB_SDO_REQUEST + node_id, b"\x40\x00\x10\x00\0\0\0\0")
    end_s = clock.now() + listening_s()
    while (frame := link.recv(end_s)) is not None:
        if frame.can_id & 0x7F == node_id and frame.can_id >> 7 in (0x1, 0x3, 0x5, 0x7, 0x9, 0xB, 0xE):
            raise BusInUseError(
                f"{link.name}: a node {node_id} is on this bus already ({frame.can_id:03X}h); stop it first"
            )


def _simulated(
    profile: str, truth: Path | None, seed: int, interface: str | None, channel: str | None
) -> tuple[str, BusConfig, partial[DriveNode]]:
    from hdbridge.device.node import DriveNode
    from hdbridge.sim.lockstep import nameplate_of
    from hdbridge.sim.machine import Machine
    from hdbridge.sim.truth import Truth

    session = Session(profile=profile, interface=interface, channel=channel)
    axis = session.axis
    if axis.bus.interface == "virtual":
        raise InputError(
            "the bus 'virtual' exists within one process only, so the simulated drive cannot be reached; "
            "give --interface udp_multicast --channel 239.0.0.1, or socketcan, "
            "or use 'hdbridge step --simulate'"
        )
    known = Truth.load(simulated_by(session.files, truth))
    make = partial(
        DriveNode,
        machine=Machine(known, seed),
        eds_path=axis.eds_path,
        node_id=axis.drive.node_id,
        nameplate=nameplate_of(known, load_object=axis.load_encoder.source.address),
        behaviour=known.firmware,
        bit_rate_bps=axis.bus.bitrate_bps,
    )
    return "simulated", axis.bus, make


def _ideal(machine: str, name: str | None, folder: Path) -> tuple[str, BusConfig, partial[DriveNode]]:
    from hdbridge.daemon.gateway.ideal import IdealAxis
    from hdbridge.daemon.gateway.objects import nameplate, write_eds
    from hdbridge.daemon.gateway.slave import BEHAVIOUR
    from hdbridge.device.node import DriveNode

    axis, settings, model = gateway_axis(machine, name)
    plate = nameplate(axis, settings)
    make = partial(
        DriveNode,
        machine=IdealAxis(axis.gear.ratio * plate.load_counts_per_turn / plate.motor_counts_per_turn),
        eds_path=write_eds(folder, axis, settings, model),
        node_id=settings.nodes[axis.name],
        nameplate=plate,
        behaviour=BEHAVIOUR,
        bit_rate_bps=settings.bus.bitrate_bps,
    )
    return "ideal", settings.bus, make


COMMANDS: Final = {
    "run": run,
    "install-service": install_service,
    "gateway": {"eds": eds, "doctor": doctor},
    "simulate": simulate,
}
