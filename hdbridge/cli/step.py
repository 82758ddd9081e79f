"""``hdbridge step``: the stepping test, with and without compensation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hdbridge.cli.options import (
    HtmlOption,
    JsonOption,
    ModelOption,
    compensating_model,
    note,
    progress_bar,
    say,
    write_json,
    write_result,
)
from hdbridge.cli.session import Session, on_axis
from hdbridge.commissioning.evaluation.stepping import Scheme
from hdbridge.errors import InputError
from hdbridge.files.atomic import make_folder
from hdbridge.files.outputs import Kind, writing

if TYPE_CHECKING:
    from hdbridge.axis import AxisConfig
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.commissioning.evaluation.comparison import Comparison
    from hdbridge.control.bench import Run
    from hdbridge.motion.procedures.stepping import Stepping, SteppingOutcome
    from hdbridge.records.record import Record


@on_axis
def command(
    session: Session,
    model: ModelOption = None,
    scheme: Annotated[
        list[Scheme] | None,
        typer.Option(
            "--scheme",
            help="Only this scheme; may be repeated. Else all of the model.",
        ),
    ] = None,
    count: Annotated[int, typer.Option("--count", min=2, max=100_000, help="Steps each way.")] = 240,
    step_deg: Annotated[float, typer.Option("--step-deg", help="Step, motor degrees.")] = 43.56,
    start_deg: Annotated[float, typer.Option("--start-deg", help="Load angle of the start, deg.")] = 0.0,
    json_file: JsonOption = None,
    html_file: HtmlOption = None,
    record: Annotated[
        Path | None,
        typer.Option("--record", metavar="FOLDER", help="Keep what was measured: one CSV file per scheme."),
        Kind.FOLDER,
    ] = None,
) -> None:
    """Step the axis both ways under each compensation scheme; print what the load encoder measured.

    Uses the article's four schemes, and the whole model if it has more than their two parts.
    """
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.control.bench import axis_view
    from hdbridge.motion.procedures.rehearsal import rehearse
    from hdbridge.motion.procedures.stepping import Stepping

    files, axis = session.files, session.axis
    stepping = Stepping(count=count, step_deg=step_deg, start_deg=start_deg)
    rehearse(stepping, axis_view(axis), start_deg)  # refused before anything is connected
    chosen: Path | None = None
    if model is not None or not scheme or set(scheme) != {Scheme.NONE}:  # the scheme none needs no model
        chosen = compensating_model(files, session.profile, model, ", or step without one: --scheme none")

    def tell(comparison: Comparison) -> None:
        write_json(json_file, comparison.as_dict())
        if html_file is not None:
            write_page(html_file, axis, chosen, comparison, stepping, session.simulated_seed)
        print_result(axis, comparison)

    run_comparison(
        session,
        TransmissionModel.load(chosen) if chosen else TransmissionModel(axis.gear.ratio),
        stepping,
        scheme,
        record=record,
        tell=tell,
    )


def run_comparison(
    session: Session,
    model: TransmissionModel,
    stepping: Stepping,
    schemes: list[Scheme] | None,
    *,
    record: Path | None = None,
    tell: Callable[[Comparison], None],
) -> None:
    """Connects, boots and compares, with a progress bar; keeps each scheme's record as soon as it is
    complete.

    ``tell`` receives the result, also of an interrupted test: then that of the completed schemes.
    """
    from hdbridge.commissioning.evaluation.comparison import compare_schemes
    from hdbridge.control.bench import compensation_for
    from hdbridge.control.caps import cap_remark

    axis = session.axis
    offered = Scheme.offered_by(model)
    wanted = tuple(schemes) if schemes else offered
    if Scheme.EXTENDED in wanted and Scheme.EXTENDED not in offered:
        raise InputError("--scheme extended: the model has no effect beyond its two parts; leave it out")
    if record is not None:
        make_folder(record)  # before the axis moves, not after

    for each in wanted:
        compensation_for(axis, each.of(model))  # refused before anything is connected
    if remark := cap_remark(axis, model):
        note(remark)

    done: dict[Scheme, Run[SteppingOutcome]] = {}

    def keep(scheme: Scheme, run: Run[SteppingOutcome]) -> None:
        done[scheme] = run
        if record is not None:
            with writing():
                run.record.write_csv(record / f"stepping-{scheme.value}.csv.gz")

    def stopped(scheme: Scheme, measured: Record) -> None:
        path = None if record is None else record / f"stepping-{scheme.value}-stopped.csv.gz"
        if path is not None:
            with writing():
                measured.write_csv(path)
        kept = f"kept in {path}" if path else "not kept: it takes --record FOLDER"
        seconds = float(measured.time_s[-1] - measured.time_s[0])
        note(f"stopped in '{scheme.value}' after {seconds:.1f} s, {kept}")

    with (
        _told_when_stopped(axis, done, tell),
        session.booted() as (drive, interrupted),
        progress_bar() as bar,
    ):
        bars = {each: bar.add_task(f"{each.value:>12}", total=1.0, visible=False) for each in wanted}

        begun: set[Scheme] = set()

        def show(scheme: Scheme, share: float) -> None:
            if scheme not in begun:
                begun.add(scheme)
                bar.reset(bars[scheme])  # the progress time starts here
                for each in bars.values():  # no progress bar for a refused test
                    bar.update(each, visible=True)
            bar.update(bars[scheme], completed=share)

        comparison = compare_schemes(
            drive,
            model,
            wanted,
            stepping,
            progress=show,
            interrupted=interrupted,
            finished=keep,
            stopped=stopped,
        )
    tell(comparison)


@contextmanager
def _told_when_stopped(
    axis: AxisConfig, done: dict[Scheme, Run[SteppingOutcome]], tell: Callable[[Comparison], None]
) -> Iterator[None]:
    """Reports the results of the completed schemes if a test is interrupted."""
    from hdbridge.commissioning.evaluation.comparison import Comparison

    try:
        yield
    except BaseException:
        if done:
            tell(Comparison.of(axis, done))
        raise


def print_result(axis: AxisConfig, comparison: Comparison) -> None:
    """Prints the result."""
    from hdbridge.cli.calibration_output import print_scatter

    print_scatter(
        f"Load error at rest, arcsec: axis '{axis.name}'",
        "compensation",
        ((scheme.value, (each.cw, each.ccw, each.pooled)) for scheme, each in comparison.results.items()),
    )
    for line in comparison.survived:
        say(f"note: {line}")
    best, result = min(comparison.results.items(), key=lambda item: item[1].pooled.three_sigma_arcsec)
    floor = comparison.quantisation_floor_arcsec
    say(
        f"quantisation floor (3 sigma of one motor count): {floor:.2f}; "
        f"'{best.value}' is at {result.pooled.three_sigma_arcsec / floor:.2f} times that"
    )


def write_page(
    path: Path,
    axis: AxisConfig,
    model: Path | None,
    comparison: Comparison,
    stepping: Stepping,
    simulated_seed: int | None,
) -> None:
    """Writes the result as a self-contained page, with what was stepped, when, and by which model."""
    from hdbridge.report.page import render
    from hdbridge.report.stepping import stepping_page

    cycle = f"cycle {axis.drive.cycle_ms:g} ms"
    drive = (
        f"node {axis.drive.node_id} on {axis.bus.interface}:{axis.bus.channel}, {cycle}"
        if simulated_seed is None
        else f"simulated, seed {simulated_seed}, {cycle}"
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
    if comparison.survived:
        facts["survived"] = "; ".join(comparison.survived)
    page = stepping_page(
        axis.name,
        comparison.results,
        comparison.quantisation_floor_arcsec,
        facts,
        with_article=axis.name == "article",
    )
    write_result(path, render(page))
