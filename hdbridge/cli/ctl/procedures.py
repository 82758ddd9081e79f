"""Procedures that run in a daemon while it holds the bus, and objects of its drives."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from hdbridge.cli.ctl.common import (
    AtOption,
    AxisArgument,
    TakeOption,
    connected,
    document,
    moving,
    stopped_by_signals,
)
from hdbridge.cli.options import JsonOption, console, print_table, progress_bar, write_json
from hdbridge.client.messages.jobs import JobKind, JobState
from hdbridge.errors import InputError

if TYPE_CHECKING:
    from hdbridge.client import Client
    from hdbridge.client.messages import Job, SdoValue

JobArgument = Annotated[str, typer.Argument(metavar="JOB", help="As `hdbridge ctl jobs` names it.")]
ObjectArgument = Annotated[
    str,
    typer.Argument(
        metavar="OBJECT", help="Its number (6064h, 0x1018:4, 60C2h:01; hexadecimal) or its name in the EDS."
    ),
]


def job(
    axis: AxisArgument,
    kind: Annotated[JobKind, typer.Argument(metavar="KIND", help="`step`, `calibrate` or `improve`.")],
    options: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Option of that command; may be repeated."),
    ] = None,
    wait: Annotated[
        bool, typer.Option("--wait/--no-wait", help="Wait for the end; else print the job's name at once.")
    ] = True,
    at: AtOption = None,
    force: TakeOption = False,
    json_file: JsonOption = None,
) -> None:
    """Run a procedure through the daemon: step, calibrate or improve an axis. Ctrl-C stops it in order."""
    wanted = dict(_option(each) for each in options or ())
    with connected(at) as client, client.lease(force=force):
        begun = client.axis(axis).job(kind.value, wait=False, **wanted)
        if wait:
            with stopped_by_signals(client, axis):
                begun = _followed(client, begun)
    write_json(json_file, document("ctl-job", begun))
    _print([begun])
    if begun.problem is not None:
        raise begun.problem.error()


def jobs(at: AtOption = None, json_file: JsonOption = None) -> None:
    """List the procedures that run or ran since the daemon's service began."""
    with connected(at) as client:
        found = client.jobs()
    write_json(
        json_file, {"schema": "hdbridge.ctl-jobs/1", "jobs": [each.model_dump(mode="json") for each in found]}
    )
    _print(found)


def cancel(
    job_id: JobArgument, at: AtOption = None, force: TakeOption = False, json_file: JsonOption = None
) -> None:
    """Stop a procedure and its axis in order; what it has measured is kept."""
    with connected(at) as client, client.lease(force=force):
        found = client.cancel_job(job_id)
    write_json(json_file, document("ctl-job", found))
    _print([found])


def get(
    axis: AxisArgument, object_: ObjectArgument, at: AtOption = None, json_file: JsonOption = None
) -> None:
    """Read an object of the drive by SDO, between the cycles."""
    with connected(at) as client:
        _print_object(client.axis(axis).read(object_), json_file)


def put(
    axis: AxisArgument,
    object_: ObjectArgument,
    value: Annotated[
        str, typer.Argument(metavar="VALUE", help="Decimal or 0x...; text, or bytes in hexadecimal.")
    ],
    at: AtOption = None,
    force: TakeOption = False,
    json_file: JsonOption = None,
) -> None:
    """Write an object of the drive by SDO, and read it back; refused while the axis is enabled."""
    with moving(at, axis, force=force) as moved:
        _print_object(moved.write(object_, value), json_file)


def _followed(client: Client, begun: Job) -> Job:
    with progress_bar() as bar:
        task = bar.add_task(begun.kind.value, total=1.0)
        while begun.state is JobState.RUNNING:
            time.sleep(0.2)
            begun = client.job(begun.id)
            bar.update(task, completed=begun.share, description=escape(begun.text or begun.kind.value))
    return begun


def _option(text: str) -> tuple[str, Any]:
    """Parses ``count=60``: a number, true, false or a list as in JSON, else text."""
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise InputError(f"--set: found {text!r}; expected NAME=VALUE, count=60 for example")
    try:
        return name.replace("-", "_"), json.loads(value)
    except ValueError:
        return name.replace("-", "_"), value


def _print(found: list[Job]) -> None:
    table = Table("job", "axis", "state", "done", "begun")
    for each in found:
        begun = f"{each.started.astimezone():%Y-%m-%d %H:%M:%S}"
        done = f"{100 * each.share:.0f} %"
        table.add_row(escape(each.id), escape(each.axis), str(each.state), done, begun)
    print_table(table)
    for each in found:
        words = each.text if each.problem is None else each.problem.detail
        for line in (words, each.folder and f"recorded in {each.folder}", *_figures(each)):
            if line:
                console.print(f"{each.id}: {line}", markup=False, soft_wrap=True)


def _figures(job: Job) -> Iterator[str]:
    """Yields the key figures, one line each; the full result is in the recording and in `--json`."""
    result = job.result or {}
    schemes = [
        f"{name} {told['pooled']['three_sigma_arcsec']:.2f}"
        for name, told in result.items()
        if isinstance(told, dict) and "pooled" in told
    ]
    if schemes:
        floor = result.get("quantisation_floor_arcsec")
        least = f"; quantisation floor {floor:.2f}" if floor is not None else ""
        yield f"load error at rest, pooled 3 sigma in arcsec: {', '.join(schemes)}{least}"
    if reason := result.get("reason"):
        yield str(reason)
    if result.get("pending"):
        yield f"to use the model that it proposes: hdbridge ctl model {job.axis} pending"


def _print_object(found: SdoValue, json_file: Path | None) -> None:
    write_json(json_file, document("ctl-object", found))
    number = f"{found.index:04X}h:{found.subindex:02X}"
    whole = isinstance(found.value, int) and not isinstance(found.value, bool) and found.value >= 0
    also = f" ({found.value:#x})" if whole else ""
    console.print(f"{number} '{found.name}': {found.value}{also}  {found.type}", markup=False, soft_wrap=True)
