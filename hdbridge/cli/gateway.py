"""``hdbridge gateway``: the axes of a machine as drives of another master."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain, islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from hdbridge.cli.options import GatewayAxisOption, JsonOption, MachineArgument, note, say, write_json
from hdbridge.errors import DriveError, InputError

if TYPE_CHECKING:
    from canopen.objectdictionary import ObjectDictionary

    from hdbridge.axis import AxisConfig
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.daemon.machinefile import GatewaySettings
    from hdbridge.drive.link import Frame


def eds(machine: MachineArgument, axis: GatewayAxisOption = None) -> None:
    """Print the EDS of an axis on the gateway's bus, for the tool that configures the other master.

    hdbridge gateway eds cell > axis1.eds
    """
    from hdbridge.daemon.gateway.objects import eds as text_of

    typer.echo(text_of(*gateway_axis(machine, axis)), nl=False)


def doctor(
    machine: MachineArgument,
    axis: GatewayAxisOption = None,
    duration_s: Annotated[
        float,
        typer.Option("--duration", min=0.1, max=86_400.0, help="Time to listen, s; Ctrl-C ends it earlier."),
    ] = 10.0,
    log: Annotated[
        Path | None,
        typer.Option(
            "--log", metavar="FILE", help="Read a bus log (.log, .asc, .blf, .trc, .mf4) in place of the bus."
        ),
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Listen to the other master; report its configuration, its commands and its mistakes, with reasons.

    Sends nothing, so it may run next to the daemon.

    Exit status 4 if the master made a mistake, or nothing of the axis was heard.
    """
    from hdbridge.daemon.gateway.trace import Trace

    logged = None if log is None else _begun(_logged(log))
    config, settings, model = gateway_axis(machine, axis)
    node_id = settings.nodes[config.name]
    trace = Trace(node_id, eds_of(config, settings, model))
    rows: list[dict[str, Any]] = []
    begun_s: float | None = None
    frames = logged if logged is not None else _heard(settings, duration_s)
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
    """The object dictionary of a gateway axis, read from its EDS as another master does."""
    from hdbridge.daemon.gateway.objects import write_eds
    from hdbridge.files.edsfile import read_eds

    with TemporaryDirectory(prefix="hdbridge-gateway-") as folder:
        return read_eds(write_eds(Path(folder), axis, settings, model), settings.nodes[axis.name]).dictionary


def _heard(settings: GatewaySettings, duration_s: float) -> Iterator[Frame]:
    """Yields the frames on the outer bus."""
    from hdbridge.cli.interrupt import deferred_interrupt
    from hdbridge.clock import MonotonicClock
    from hdbridge.drive.link import Link, open_bus

    with deferred_interrupt() as interrupted, open_bus(settings.bus, shared=True) as bus:
        link = Link(bus, MonotonicClock())
        note(f"listening on {link.name} for {duration_s:g} s")
        end_s = link.now() + duration_s
        while not interrupted() and (now_s := link.now()) < end_s:
            if (frame := link.recv(min(end_s, now_s + 0.2))) is not None:
                yield frame


def _begun(frames: Iterator[Frame]) -> Iterator[Frame]:
    """Returns the same frames, the first of them read already, so that a wrong file is refused first."""
    return chain(list(islice(frames, 1)), frames)


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
    """An axis of a machine's gateway, the gateway, and the axis's model.

    InputError if the machine has no gateway, or the name is needed.
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
        raise InputError(f"--axis {name}: is not in the gateway; expected one of: {', '.join(names)}")
    axis = found.axis(name or names[0])
    return axis.config, found.gateway, axis.model()


COMMANDS: Final = {"eds": eds, "doctor": doctor}
