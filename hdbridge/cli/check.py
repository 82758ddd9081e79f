"""``hdbridge check``: are the files of an axis right?"""

from __future__ import annotations

import typer

from hdbridge.cli.options import JsonOption, ModelOption, ProfileArgument, console, notes, write_json
from hdbridge.files.profile import Profile


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("check")(check)


def check(profile: ProfileArgument, model: ModelOption = None, json_file: JsonOption = None) -> None:
    """Read an axis file, its EDS and its model; say what they mean, or what is wrong and where."""
    from hdbridge.axis import AxisConfig
    from hdbridge.control.bench import compensation_for
    from hdbridge.control.caps import cap_remark
    from hdbridge.drive import load_eds, plan
    from hdbridge.drive.writes import left_out
    from hdbridge.evaluation.stepping import quantisation_floor_arcsec
    from hdbridge.model import TransmissionModel

    files = Profile.find(profile)
    axis = AxisConfig.load(files.axis)
    od = load_eds(axis.eds_path, axis.drive.node_id)
    plan(axis, od)
    floor = quantisation_floor_arcsec(axis.motor_encoder.counts_per_turn, axis.gear.ratio)
    facts = {
        "axis": axis.name,
        "bus": f"{axis.bus.interface}:{axis.bus.channel}, node {axis.drive.node_id}",
        "cycle": f"{axis.drive.cycle_ms:g} ms",
        "ratio": f"{axis.gear.ratio:g}",
        "one motor count": f"{floor / 3 * 12**0.5:.3g} arcsec at the load",
        "quantisation floor": f"{floor:.3g} arcsec (3 sigma)",
        "travel": f"{axis.limits.position_min_deg:g} to {axis.limits.position_max_deg:g} deg",
    }
    if axis.channels:
        facts["other channels"] = ", ".join(axis.channels).replace("_", " ")
    remark = None
    path = model or (files.model if files.model.exists() else None)
    if path is not None:
        loaded = TransmissionModel.load(path)
        compensation_for(axis, loaded)
        remark = cap_remark(axis, loaded)
        facts["model"] = ", ".join(each.name for each in loaded.effects) or "no effects"
    lacking = left_out(axis, od)
    write_json(json_file, {"schema": "hdbridge.check/1", **facts, "left to the drive": [*map(str, lacking)]})
    for name, value in facts.items():
        console.print(f"{name:>20}  {value}")
    for row in lacking:
        source = f" ({axis.where(row.field)})" if row.field else ""
        console.print(
            f"{'left to the drive':>20}  {row.index:04X}h:{row.sub:02X}, which {axis.drive.eds} lacks: "
            f"{row.why}{source}",
            soft_wrap=True,
        )
    if remark:
        notes.print(remark, markup=False, soft_wrap=True)
    console.print("all right")
