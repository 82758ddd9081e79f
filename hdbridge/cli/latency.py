"""``hdbridge latency``: timer latency, and the shortest cycle that this computer sustains."""

from __future__ import annotations

from contextlib import nullcontext
from typing import TYPE_CHECKING, Annotated

import typer

from hdbridge.cli.options import JsonOption, note, say, write_json
from hdbridge.clock import MonotonicClock

if TYPE_CHECKING:
    from hdbridge.control.latency import Measurement


def command(
    duration_s: Annotated[
        float, typer.Option("--duration", min=0.1, max=86_400, help="Seconds for each cycle time.")
    ] = 10.0,
    cycle_ms: Annotated[
        list[float] | None,
        typer.Option("--cycle-ms", min=0.1, max=1000, help="Only this cycle time; may be repeated."),
    ] = None,
    realtime: Annotated[
        bool, typer.Option(help="Ask for real-time priority and locked memory, as the control loop does.")
    ] = True,
    json_file: JsonOption = None,
) -> None:
    """Measure timer latency; print its histogram and the shortest cycle that this computer sustains.

    Run it on the control computer under its usual load, for minutes.
    """
    from hdbridge.control.latency import CANDIDATES_S, measure
    from hdbridge.control.realtime import prepare_realtime

    periods = tuple(each / 1000.0 for each in cycle_ms) if cycle_ms else CANDIDATES_S

    def tell(done: Measurement) -> None:
        note(f"measured {1e3 * done.period_s:g} ms")

    with prepare_realtime() if realtime else nullcontext("ordinary priority") as conditions:
        report = measure(MonotonicClock(), duration_s, periods, conditions=str(conditions), progress=tell)
    write_json(json_file, report.as_dict())
    say(report.table())
