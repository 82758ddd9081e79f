"""``hdbridge move``: moves the load to an angle, compensated, and holds it there."""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from hdbridge.cli.options import (
    AnglesArgument,
    JsonOption,
    ModelOption,
    VelocityOption,
    note,
    note_clamped,
    print_table,
    progress_bar,
    say,
    write_json,
)
from hdbridge.cli.session import Session, on_axis
from hdbridge.errors import HdbridgeError, InputError
from hdbridge.files.profile import Profile

if TYPE_CHECKING:
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.drive.drive import Drive
    from hdbridge.motion.procedures.stepping import Standing

KEPT_S = 60.0
"""Duration of the samples kept while the axis holds; s."""


@on_axis
def command(
    session: Session,
    angles_deg: AnglesArgument,
    relative: Annotated[
        bool, typer.Option("--relative", help="Each angle is relative to the previous position.")
    ] = False,
    velocity_deg_s: VelocityOption = None,
    hold_s: Annotated[
        float | None,
        typer.Option(
            "--hold",
            min=0.0,
            help="Seconds to hold the last angle; else until Ctrl-C (a simulated axis: not at all).",
        ),
    ] = None,
    model: ModelOption = None,
    compensated: Annotated[
        bool,
        typer.Option("--compensated/--uncompensated", help="Use the active model, if there is one."),
    ] = True,
    json_file: JsonOption = None,
) -> None:
    """Move the load to one angle or to several, compensated by the active model, and hold the last.

    A move outside the limits of the axis file is refused before anything moves. Ctrl-C stops the axis (exit
    status 130), or ends the hold. Power is then switched off: a suspended load needs a brake.
    """
    from hdbridge.control.bench import Bench, axis_view, compensation_for
    from hdbridge.motion.procedures.rehearsal import rehearse
    from hdbridge.motion.procedures.waypoints import Hold, WayPoints

    files, axis = session.files, session.axis
    if not relative:  # refused before anything is connected
        rehearse(WayPoints(tuple(angles_deg)), axis_view(axis), angles_deg[0])
    chosen = _model(files, model, axis.gear.ratio, compensated=compensated)
    compensation = compensation_for(axis, chosen)  # refused before anything is connected
    note_clamped(axis.limits, velocity_deg_s=velocity_deg_s)
    with session.booted() as (drive, interrupted):
        if session.simulate and hold_s is None:
            hold_s = 0.0  # a simulated axis need not hold
        hold = Hold(math.inf if hold_s is None else hold_s, released=interrupted)
        stands_deg = drive.read_positions().motor_deg / axis.gear.ratio
        targets_deg = _absolute(angles_deg, stands_deg) if relative else angles_deg
        way = WayPoints(tuple(targets_deg), hold, velocity_deg_s)
        bench = Bench(drive, compensation, interrupted=lambda: interrupted() and not hold.begun)
        with progress_bar() as bar:
            task = bar.add_task("moving", total=1.0)

            def show(share: float) -> None:
                there = share >= 1.0
                words = (
                    f"holding {targets_deg[-1]:g} deg; Ctrl-C ends it"
                    if there and hold_s is None
                    else "moving"
                )
                bar.update(task, completed=share, description=words)

            try:
                run = bench.run(way, show, keep_s=KEPT_S)
            except KeyboardInterrupt:
                _tell_where_it_stands(drive)
                raise
    write_json(json_file, _document(axis.name, chosen, run.outcome))
    _print(axis.name, chosen, run.outcome)


def _tell_where_it_stands(drive: Drive) -> None:
    """Prints the position after a stop on the way; nothing if the drive does not answer any more."""
    with suppress(HdbridgeError):
        stands_deg = drive.read_positions().motor_deg / drive.axis.gear.ratio
        note(f"stopped on the way, at {stands_deg:.4f} deg by the motor encoder; power is off")


def _model(files: Profile, given: Path | None, ratio: float, *, compensated: bool) -> TransmissionModel:
    """Returns the compensating model; one without effects if there is none or none is wanted."""
    from hdbridge.axis.model import TransmissionModel

    if not compensated:
        if given is not None:
            raise InputError("--uncompensated uses no model: leave out --model")
        return TransmissionModel(ratio)
    if given is None and not files.model.exists():
        note(f"not compensated: {files.model} does not exist")
        return TransmissionModel(ratio)
    return TransmissionModel.load(given or files.model)


def _absolute(steps_deg: list[float], start_deg: float) -> list[float]:
    targets = []
    for step_deg in steps_deg:
        start_deg += step_deg
        targets.append(start_deg)
    return targets


def _document(axis: str, model: TransmissionModel, stands: tuple[Standing, ...]) -> dict[str, Any]:
    return {
        "schema": "hdbridge.move/1",
        "axis": axis,
        "model": str(model.path) if model.effects else None,
        "stands": [
            {
                "target_deg": each.target_deg,
                "load_position_deg": each.load_deg,
                "error_arcsec": each.error_arcsec,
                "settle_s": each.settle_s,
            }
            for each in stands
        ],
    }


def _print(axis: str, model: TransmissionModel, stands: tuple[Standing, ...]) -> None:
    table = Table(title=f"Axis '{axis}' at rest", title_justify="left")
    for name in ("target, deg", "load encoder, deg", "error, arcsec", "settled in, s"):
        table.add_column(name, justify="right")
    for each in stands:
        table.add_row(
            f"{each.target_deg:.4f}",
            f"{each.load_deg:.4f}",
            f"{each.error_arcsec:z.2f}",
            f"{each.settle_s:.2f}",
        )
    print_table(table)
    how = f"compensated by {model.path}" if model.effects else "not compensated"
    say(f"{how}; power is off")
