"""Commands that position the load: `move`, `step`, `motion`, `demo`."""

from __future__ import annotations

import math
from contextlib import nullcontext, suppress
from datetime import datetime
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from typer import Option

from hdbridge.cli import options as opt
from hdbridge.cli.calibration import phases
from hdbridge.cli.printing import note, print_blocks, print_table, progress_bar, say, write_json, write_page
from hdbridge.cli.session import Session, note_clamped, on_axis
from hdbridge.enums import Scheme
from hdbridge.errors import HdbridgeError, InputError, command
from hdbridge.files.atomic import make_folder, new_folder, sole_writer
from hdbridge.files.outputs import Kind, writing
from hdbridge.files.profile import Profile, no_model

if TYPE_CHECKING:
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.commissioning.evaluation.comparison import Comparison
    from hdbridge.control.bench import Run
    from hdbridge.drive.drive import Drive
    from hdbridge.motion.procedures.stepping import Standing, Stepping, SteppingOutcome
    from hdbridge.records.record import Record


# ---------------------------------------------------------------- move

KEPT_S = 60.0
"""Duration of the kept samples while the axis holds; s."""


@on_axis
def move(
    session: Session,
    angles_deg: opt.Angles,
    relative: Annotated[
        bool, Option("--relative", help="Each angle is relative to the previous position.")
    ] = False,
    velocity_deg_s: opt.Velocity = None,
    hold_s: Annotated[
        float | None,
        Option(
            "--hold",
            min=0.0,
            help="Seconds to hold the last angle; else until Ctrl-C (a simulated axis: not at all).",
        ),
    ] = None,
    model: opt.Model = None,
    compensated: Annotated[
        bool, Option("--compensated/--uncompensated", help="Use the active model, if there is one.")
    ] = True,
    json_file: opt.Json = None,
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
    chosen = _compensating(files, model, axis.gear.ratio, compensated=compensated)
    compensation = compensation_for(axis, chosen)  # refused before anything is connected
    note_clamped(axis.limits, velocity_deg_s=velocity_deg_s)
    with session.booted() as (drive, interrupted):
        if session.simulate and hold_s is None:
            hold_s = 0.0  # a simulated axis need not hold its position
        hold = Hold(math.inf if hold_s is None else hold_s, released=interrupted)
        stands_deg = drive.read_positions().motor_deg / axis.gear.ratio
        targets_deg = [*accumulate(angles_deg, initial=stands_deg)][1:] if relative else angles_deg
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
                _print_position(drive)
                raise
    write_json(json_file, _move_document(axis.name, chosen, run.outcome))
    _print_move(axis.name, chosen, run.outcome)


def _print_position(drive: Drive) -> None:
    """Prints the position after an interrupted move; nothing if the drive no longer answers."""
    with suppress(HdbridgeError):
        stands_deg = drive.read_positions().motor_deg / drive.axis.gear.ratio
        note(f"stopped on the way, at {stands_deg:.4f} deg by the motor encoder; power is off")


def _compensating(
    files: Profile, given: Path | None, ratio: float, *, compensated: bool
) -> TransmissionModel:
    """Returns the compensation model; it has no effects without a model file, or if not ``compensated``."""
    from hdbridge.axis.model import TransmissionModel

    if not compensated:
        if given is not None:
            raise InputError("--uncompensated uses no model: leave out --model")
        return TransmissionModel(ratio)
    if given is None and not files.model.exists():
        note(f"not compensated: {files.model} does not exist")
        return TransmissionModel(ratio)
    return TransmissionModel.load(given or files.model)


def _move_document(axis: str, model: TransmissionModel, stands: tuple[Standing, ...]) -> dict[str, Any]:
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


def _print_move(axis: str, model: TransmissionModel, stands: tuple[Standing, ...]) -> None:
    rows = [
        (
            f"{each.target_deg:.4f}",
            f"{each.load_deg:.4f}",
            f"{each.error_arcsec:z.2f}",
            f"{each.settle_s:.2f}",
        )
        for each in stands
    ]
    columns = ("target, deg", "load encoder, deg", "error, arcsec", "settled in, s")
    print_table(columns, rows, f"Axis '{axis}' at rest")
    how = f"compensated by {model.path}" if model.effects else "not compensated"
    say(f"{how}; power is off")


@on_axis
def step(
    session: Session,
    model: opt.Model = None,
    scheme: Annotated[
        list[Scheme] | None,
        Option("--scheme", help="Scheme to test; may be repeated. Default: all schemes of the model."),
    ] = None,
    count: Annotated[int, Option("--count", min=2, max=100_000, help="Steps each way.")] = 240,
    step_deg: Annotated[float, Option("--step-deg", help="Step, motor degrees.")] = 43.56,
    start_deg: Annotated[float, Option("--start-deg", help="Load angle of the start, deg.")] = 0.0,
    json_file: opt.Json = None,
    html_file: opt.Html = None,
    record: Annotated[
        Path | None,
        Option(
            "--record",
            metavar="FOLDER",
            help="Write the measured data to this folder: one CSV file per scheme.",
        ),
        Kind.FOLDER,
    ] = None,
) -> None:
    """Step the axis both ways under each compensation scheme; print the results at the load encoder.

    Uses the article's four schemes, and the whole model if it has more than their two parts.
    """
    from hdbridge.control.bench import axis_view
    from hdbridge.motion.procedures.rehearsal import rehearse
    from hdbridge.motion.procedures.stepping import Stepping

    files, axis = session.files, session.axis
    stepping = Stepping(count=count, step_deg=step_deg, start_deg=start_deg)
    rehearse(stepping, axis_view(axis), start_deg)  # refused before anything is connected
    chosen: Path | None = None
    if model is not None or not scheme or set(scheme) != {Scheme.NONE}:  # the scheme none needs no model
        chosen = model or files.model
        if not chosen.exists():
            raise no_model(chosen, "; or step without one: --scheme none")

    run_comparison(session, chosen, stepping, scheme, record=record, json_file=json_file, html_file=html_file)


def run_comparison(
    session: Session,
    model_path: Path | None,
    stepping: Stepping,
    schemes: list[Scheme] | None,
    *,
    record: Path | None,
    json_file: Path | None,
    html_file: Path | None,
) -> None:
    """Connects and boots the drive, and compares the schemes; keeps each record as soon as it is complete.

    Writes and prints the result; for an interrupted test, that of the completed schemes.
    """
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.commissioning.evaluation.comparison import Comparison, compare_schemes
    from hdbridge.control.bench import compensation_for
    from hdbridge.control.caps import cap_remark
    from hdbridge.report.stepping import scheme_blocks

    axis = session.axis
    model = TransmissionModel.load(model_path) if model_path else TransmissionModel(axis.gear.ratio)
    offered = Scheme.offered_by(model)
    wanted = tuple(schemes) if schemes else offered
    if Scheme.EXTENDED in wanted and Scheme.EXTENDED not in offered:
        raise InputError("--scheme extended: the model has no effect beyond its two parts; leave it out")
    for each in wanted:
        compensation_for(axis, each.of(model))  # refused before anything is connected
    if remark := cap_remark(axis, model):
        note(remark)

    done: dict[Scheme, Run[SteppingOutcome]] = {}

    def stopped(scheme: Scheme, measured: Record) -> None:
        path = None if record is None else record / f"stepping-{scheme.value}-stopped.csv.gz"
        if path is not None:
            with writing():
                measured.write_csv(path)
        kept = f"kept in {path}" if path else "not kept: it takes --record FOLDER"
        seconds = float(measured.time_s[-1] - measured.time_s[0])
        note(f"stopped in '{scheme.value}' after {seconds:.1f} s, {kept}")

    alone = nullcontext() if record is None else sole_writer(record, new=True)
    try:
        with alone, session.booted() as (drive, interrupted), progress_bar() as bar:
            bars = {each: bar.add_task(f"{each.value:>12}", total=1.0, visible=False) for each in wanted}
            begun: set[Scheme] = set()

            def show(scheme: Scheme, share: float) -> None:
                if scheme not in begun:
                    begun.add(scheme)
                    bar.reset(bars[scheme])  # the bar's elapsed time starts here
                    for each in bars.values():  # no progress bar for a refused test
                        bar.update(each, visible=True)
                bar.update(bars[scheme], completed=share)

            for scheme, run in compare_schemes(
                drive, model, wanted, stepping, progress=show, interrupted=interrupted, stopped=stopped
            ):
                done[scheme] = run
                if record is not None:
                    with writing():
                        run.record.write_csv(record / f"stepping-{scheme.value}.csv.gz")
    finally:
        if done:
            comparison = Comparison.of(axis, done)
            write_json(json_file, comparison.as_dict())
            if html_file is not None:
                _write_stepping_page(html_file, session, model_path, comparison, stepping)
            floor = comparison.quantisation_floor_arcsec
            print_blocks(
                scheme_blocks(comparison.results, floor, comparison.fault_notes),
                f"Load error at rest: axis '{axis.name}'",
            )


def _write_stepping_page(
    path: Path, session: Session, model: Path | None, comparison: Comparison, stepping: Stepping
) -> None:
    """Writes the result as a self-contained page with axis, date and model of the test."""
    from hdbridge.report.stepping import stepping_page

    axis, seed = session.axis, session.simulated_seed
    cycle = f"cycle {axis.drive.cycle_ms:g} ms"
    drive = (
        f"node {axis.drive.node_id} on {axis.bus.interface}:{axis.bus.channel}, {cycle}"
        if seed is None
        else f"simulated, seed {seed}, {cycle}"
    )
    facts = {
        "axis": f"{axis.name} ({axis.path})",
        "model": str(model or "none"),
        "drive": drive,
        "date": f"{datetime.now().astimezone():%Y-%m-%d %H:%M %Z}",
        "steps": f"{stepping.count} of {stepping.step_deg:g} motor degrees each way",
        "gear ratio": f"{axis.gear.ratio:g}",
        "motor encoder": f"{axis.motor_encoder.counts_per_turn:,} counts per turn",
        "load encoder": f"{axis.load_encoder.counts_per_turn:,} counts per turn",
    }
    if comparison.fault_notes:
        facts["tolerated faults"] = "; ".join(comparison.fault_notes)
    page = stepping_page(
        axis.name,
        comparison.results,
        comparison.quantisation_floor_arcsec,
        facts,
        with_article=axis.name == "article",
    )
    write_page(path, page)


@on_axis
def motion(
    session: Session,
    model: opt.Model = None,
    measure: Annotated[
        bool,
        Option(
            "--measure/--no-measure",
            help="Measure the response of the axis, or test that of the model file.",
        ),
    ] = True,
    propose: Annotated[
        bool, Option("--propose", help="Keep the model with the measured response as pending.")
    ] = False,
    json_file: opt.Json = None,
    html_file: opt.Html = None,
) -> None:
    """Run the axis at several speeds; print the ripple of the load without and with compensation.

    Measures the response to a correction in motion, and compensates for it.
    """
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.axis.model.store import propose as keep
    from hdbridge.commissioning.calibration import Callbacks
    from hdbridge.commissioning.calibration.motion import motion_test, motion_test_s
    from hdbridge.report.motion import motion_page, motion_sections

    files, axis = session.files, session.axis
    chosen = model or files.model
    if propose and not measure:
        raise InputError("--propose needs a measured response: leave out --no-measure")
    used = TransmissionModel.load(chosen)
    used.check_bound_to(axis)
    note(f"motion test: {motion_test_s(axis) / 60.0:.1f} min at most")
    with session.booted() as (drive, interrupted), phases() as progress:
        result = motion_test(drive, used, Callbacks(progress, interrupted), measure=measure)
        identity = drive.identity
    write_json(json_file, result.as_dict())
    if html_file is not None:
        write_page(html_file, motion_page(axis.name, result))
    for section in motion_sections(result):
        print_blocks(section.blocks, section.title)
    if propose and result.response is not None:
        pending = keep(
            files.axis.parent,
            result.applied(used),
            f"response in motion, known up to {result.response.known_to_hz:.0f} Hz",
            datetime.now().astimezone(),
            identity,
        )
        say(f"pending: {pending}; commit it with: {command('model', 'commit', session.profile)}")
        if result.wind_up is not None:
            say("calibrate again after that: with the wind-up compensated, the hysteresis at rest differs")


def demo(
    out: Annotated[
        Path | None,
        Option(
            "--out", metavar="FOLDER", help="Write the results to this folder; else to demo-output, numbered."
        ),
        Kind.FOLDER,
    ] = None,
    count: Annotated[int, Option("--count", min=2, max=2000, help="Steps each way.")] = 240,
    seed: Annotated[int, Option("--seed", help="Seed of the simulated axis.")] = 0,
) -> None:
    """Step a simulated axis 240 times each way under four compensation schemes.

    FOLDER receives table, JSON, records and a page.
    """
    from hdbridge.motion.procedures.stepping import Stepping

    session = Session(profile="article", simulate=True, seed=seed)
    folder = new_folder(Path("demo-output")) if out is None else make_folder(out)

    run_comparison(
        session,
        session.files.model,
        Stepping(count=count),
        None,
        record=folder,
        json_file=folder / "stepping.json",
        html_file=folder / "stepping.html",
    )
    say(f"\nopen {folder / 'stepping.html'} in a browser for the picture; next: docs/tutorial.md")


COMMANDS: Final = {"move": move, "step": step, "motion": motion, "demo": demo}
