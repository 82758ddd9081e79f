"""``hdbridge model``: history of an axis's model or twin: list, compare, commit, roll back."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from rich.text import Text
from typer import Argument, Option

from hdbridge.cli import options as opt
from hdbridge.cli.printing import print_table, say, write_json
from hdbridge.errors import InputError
from hdbridge.files.profile import Profile
from hdbridge.units import figure, with_interval

if TYPE_CHECKING:
    from hdbridge.axis.model.difference import Difference
    from hdbridge.axis.model.store import Store, Version

ReasonOption = Annotated[str, Option("--reason", help="Reason, for the log.")]
TwinOption = Annotated[bool, Option("--twin", help="The twins of the axis instead of its models.")]


def log(profile: opt.Profile, twin: TwinOption = False, json_file: opt.Json = None) -> None:
    """List every model of the profile, newest first, with dates and reasons."""
    store = _store(twin)
    versions = store.log(_folder(profile))
    write_json(
        json_file,
        {"schema": f"hdbridge.{store.noun}-log/1", f"{store.noun}s": [_version(each) for each in versions]},
    )
    if not versions:
        say(f"no {store.noun} yet: {store.first}")
    for each in versions:
        mark = "active" if each.active else "pending" if each.number is None else ""
        name = f"{each.number:4d}" if each.number else "   -"
        say(f"{name}  {mark:<8}{each.date}  {each.reason}")
        for step in each.activations:
            say(f"                {step.date}  {step.action}  {step.reason}")


def compare(
    profile: opt.Profile,
    before: Annotated[
        str | None, Argument(metavar="BEFORE", help="Number, `active` or `pending`; else the active one.")
    ] = None,
    after: Annotated[str | None, Argument(metavar="AFTER", help="The same; else the pending one.")] = None,
    twin: TwinOption = False,
    json_file: opt.Json = None,
) -> None:
    """Show the differences between two models, parameter by parameter."""
    from hdbridge.axis.model.store import ACTIVE, PENDING

    folder, store = _folder(profile), _store(twin)
    log = store.log(folder)
    names = {each.name for each in log} | ({ACTIVE} if any(each.active for each in log) else set())
    if after is None and before is None and PENDING not in names:
        others = f", or name two of: {', '.join(sorted(names))}" if len(names) > 1 else ""
        raise InputError(f"{folder}: there is no pending {store.noun} to compare with; {store.first}{others}")
    if before is None and ACTIVE not in names:
        later = store.find(folder, after or PENDING)
        earlier_name, old = f"no {store.noun}", None
    else:
        earlier = store.find(folder, before or ACTIVE)
        earlier_name, old = earlier.name, earlier.content
        later = store.find(folder, after or (PENDING if before is None or PENDING in names else ACTIVE))
    rows = _rows(old, later.content)
    write_json(
        json_file,
        {
            "schema": f"hdbridge.{store.noun}-diff/1",
            "before": earlier_name,
            "after": later.name,
            "parameters": [{**row._asdict(), "changed": row.changed} for row in rows],
        },
    )
    _print_diff(f"{earlier_name} → {later.name}", rows)


def commit(profile: opt.Profile, twin: TwinOption = False) -> None:
    """Make the pending model the active one; the previous model stays in the history."""
    store = _store(twin)
    number = store.commit(_folder(profile), _now())
    say(f"{store.noun} {number} is active")


def activate(
    profile: opt.Profile,
    version: Annotated[int, Argument(min=1, help="Its number in the log.")],
    reason: ReasonOption = "",
    twin: TwinOption = False,
) -> None:
    """Make a model of the history the active one."""
    store = _store(twin)
    number = store.activate(_folder(profile), version, reason, _now())
    say(f"{store.noun} {number} is active")


def rollback(profile: opt.Profile, reason: ReasonOption = "", twin: TwinOption = False) -> None:
    """Undo the last activation: the model before it is active again."""
    store = _store(twin)
    number = store.rollback(_folder(profile), reason, _now())
    say(f"{store.noun} {number} is active again")


def discard(profile: opt.Profile, twin: TwinOption = False) -> None:
    """Discard the pending model; its recording is kept."""
    store = _store(twin)
    store.discard(_folder(profile))
    say(f"the pending {store.noun} is discarded; its recording is kept")


def _store(twin: bool) -> Store[Any]:
    if twin:
        from hdbridge.twin.twin import TWINS

        return TWINS
    from hdbridge.axis.model.store import MODELS

    return MODELS


def _rows(before: Any, after: Any) -> list[Difference]:
    """Returns the differences between two models or two twins; ``before`` may be None."""
    from hdbridge.axis.model import TransmissionModel

    if isinstance(after, TransmissionModel):
        from hdbridge.axis.model.difference import diff

        return diff(before or after.only(()), after)
    from hdbridge.twin.twin import diff as diff_of_twins

    return diff_of_twins(before.truth if before else None, after.truth)


def _folder(profile: str) -> Path:
    """Returns the folder of an axis's models; InputError without an axis file, which may be invalid."""
    from hdbridge.files.yamlfile import read_yaml

    axis = Profile.find(profile).axis
    data = read_yaml(axis).data
    if not (isinstance(data, dict) and str(data.get("schema")).startswith("hdbridge.axis/")):
        raise InputError(f"{axis}: not an axis file; expected 'schema: hdbridge.axis/1' in it")
    return axis.parent


def _now() -> datetime:
    return datetime.now().astimezone()


def _print_diff(title: str, rows: Sequence[Difference]) -> None:
    """Prints the differences effect by effect, without the columns of a previous model if there was none."""
    compared = any(row.before is not None for row in rows if row.effect)
    columns = ("before", "after", "change", "± 95 %") if compared else ("value", "± 95 %")
    table: list[Sequence[str | Text]] = []
    effect = None
    for row in rows:
        if row.effect and row.effect != effect:
            effect = row.effect
            table += [(), (Text(effect, style="bold"),)]
        before, after, change, half_width = _cells(row)
        cells = (before, after, change, half_width) if compared else (after, half_width)
        table.append((f"{'  ' if row.effect else ''}{row.parameter}", *cells))
    print_table(("parameter", *columns), table, title)


def _cells(row: Difference) -> tuple[str, str, str, str]:
    """Returns before, after, change and half width, formatted."""
    change: Any = ""
    if row.changed and isinstance(row.before, int | float) and isinstance(row.after, int | float):
        change = row.after - row.before
    (before, _), (after, half_width), (change, _) = (
        _cell(each, row.half_width) for each in (row.before, row.after, change)
    )
    return before, after, f"+{change}" if change[:1].isdigit() else change, half_width


def _cell(value: Any, half_width: float | None) -> tuple[str, str]:
    """Formats a value and the half width of its interval, which determines the digits; else four digits."""
    if isinstance(value, float):
        return (figure(value), "-") if half_width is None else with_interval(value, half_width)
    return "-" if value is None else str(value), "-" if half_width is None else figure(half_width, 2)


def _version(each: Version[Any]) -> dict[str, Any]:
    return {
        "name": each.name,
        "number": each.number,
        "active": each.active,
        "date": each.date,
        "reason": each.reason,
        "file": str(each.path),
        "activations": [step.model_dump() for step in each.activations],
    }


COMMANDS: Final = {
    "model": {
        "log": log,
        "commit": commit,
        "activate": activate,
        "rollback": rollback,
        "discard": discard,
        "diff": compare,
    }
}
