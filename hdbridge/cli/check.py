"""``hdbridge check``: checks the files of an axis or of a machine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hdbridge.cli.options import JsonOption, ModelOption, note, say, write_json
from hdbridge.errors import InputError
from hdbridge.files.profile import Profile

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig, BusConfig
    from hdbridge.daemon.machine import Machine

CheckedArgument = Annotated[
    str,
    typer.Argument(
        metavar="PROFILE",
        help="Folder with axis.yaml (and model.yaml), axis file, machine file, or a bundled one: "
        "article, demo, cell.",
    ),
]


def command(profile: CheckedArgument, model: ModelOption = None, json_file: JsonOption = None) -> None:
    """Check the files of an axis or of a machine; report what they mean, or what is wrong and where."""
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
        raise InputError("--model goes with one axis: a machine's axes have their models in their profiles")
    else:
        machine = Machine.load(path)
        check_interface(machine.bus.interface, machine.axes[0].config.where("bus.interface"))
        _check_channel(machine.bus, f"{path}: bus.channel")
        if machine.gateway is not None:
            _check_channel(machine.gateway.bus, f"{path}: gateway.bus.channel")
        reports = [_Report(axis.config, _existing(axis.profile.model)) for axis in machine.axes]
        facts = _of_machine(machine)
        document = {"schema": "hdbridge.check/1", **facts, "axes": [each.document() for each in reports]}
        _print(facts)
    write_json(json_file, document)
    for report in reports:
        report.print()
    say("all right")


def _check_channel(bus: BusConfig, where: str) -> None:
    """Notes a channel that this computer lacks; it may belong to another one."""
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


def _print(facts: dict[str, str]) -> None:
    for name, value in facts.items():
        say(f"{name:>20}  {value}")


class _Report:
    """Content of one axis's files, for reports."""

    def __init__(self, axis: AxisConfig, model: Path | None) -> None:
        from hdbridge.axis.model import TransmissionModel
        from hdbridge.commissioning.evaluation.stepping import quantisation_floor_arcsec
        from hdbridge.control.bench import compensation_for
        from hdbridge.control.caps import cap_remark
        from hdbridge.drive.bootplan import left_to_drive, plan, sent_along
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
            "sent along": sent_along(axis),
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
        """Prints the report."""
        _print(self.facts)
        for name, rows in self.rows.items():
            for row in rows:
                say(f"{name:>20}  {row}")
        if self.remark:
            note(self.remark)
