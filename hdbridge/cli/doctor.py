"""``hdbridge doctor``: checks that the drive matches its axis file and that it stops on command."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from hdbridge.cli.interrupt import deferred_interrupt
from hdbridge.cli.options import JsonOption, console, note, say, write_json
from hdbridge.cli.session import Session, on_axis
from hdbridge.commissioning.bringup import TORQUE_PERCENT
from hdbridge.commissioning.bringup.checks import Check, Outcome, Verdict, failed, not_possible, passed
from hdbridge.errors import DriveError

if TYPE_CHECKING:
    from hdbridge.commissioning.bringup.checks import Row
    from hdbridge.commissioning.bringup.context import BringUpContext

_MARKS = {
    Outcome.PASS: "[green]pass[/green]        ",
    Outcome.FAIL: "[bold red]FAIL[/bold red]        ",
    Outcome.NOT_POSSIBLE: "[yellow]not possible[/yellow]",
}
_WARNING = (
    "The next checks switch the drive on and move the axis: up to a motor turn and an eighth each way (more "
    "with a ratio above 75), slowly, with at most {torque:g} % of the rated torque. Keep the way clear and a "
    "hardware emergency stop at hand. Move now?"
)
_FAST = (
    "After these, the last check runs the axis at up to 64 % of its speed limit in the middle of its "
    "travel, with its full torque."
)
DECLINED = "motion was not confirmed (on a terminal: answer y; in a script: --yes)"
LEFT_OUT = "left out by --no-motion"


@on_axis
def command(
    session: Session,
    torque_percent: Annotated[
        float,
        typer.Option(
            "--torque-percent",
            min=1.0,
            max=500.0,
            help="Highest motor torque, of the rated one; never above limits.torque_percent.",
        ),
    ] = TORQUE_PERCENT,
    yes: Annotated[bool, typer.Option("--yes", help="Move the axis without asking.")] = False,
    motion: Annotated[
        bool, typer.Option("--motion/--no-motion", help="--no-motion: only checks without power.")
    ] = True,
    servo: Annotated[
        bool,
        typer.Option(
            "--servo",
            help="Also run at up to 64 % of the speed limit and compare the servo with the model's response.",
        ),
    ] = False,
    json_file: JsonOption = None,
) -> None:
    """Check an axis before its first long motion: files, bus, drive, encoders, directions, ratio, stops.

    A failed check is followed by the line of the axis file to change, or what to do.

    Exit status 0 if all checks passed, 4 if one failed or motion was not confirmed, 2 if the first failure
    is a file, 3 if it is the bus. This is not a safety function: the emergency stop must be in hardware.
    """
    from hdbridge.commissioning.bringup.checks import run_checks
    from hdbridge.commissioning.bringup.context import BringUpContext
    from hdbridge.commissioning.bringup.doctor import CHECKS

    files = session.files
    refused: list[str] = []

    def permitted() -> str | None:
        if not motion:
            return LEFT_OUT
        if session.simulate or yes or _confirm(torque_percent, servo):
            return None
        refused.append(DECLINED)
        return DECLINED

    with BringUpContext(
        lambda: session.axis,
        lambda _axis: session.connected(),
        torque_percent=torque_percent,
        force=session.force,
        interruptible=deferred_interrupt,
    ) as context:
        checks = (*CHECKS, SERVO) if servo else CHECKS
        rows = run_checks(context, checks, permitted=permitted, tell=_tell)
    failures = [row for row in rows if row.verdict.outcome is Outcome.FAIL]
    write_json(
        json_file,
        {
            "schema": "hdbridge.doctor/1",
            "axis_file": str(files.axis),
            "simulated": session.simulate,
            "passed": not failures and not refused,
            "checks": [row.as_dict() for row in rows],
        },
    )
    if failures:
        first = failures[0]
        raise first.verdict.error(
            f"{files.axis}: {len(failures)} of {len(rows)} checks failed, first '{first.check.title}'; "
            "the lines below each give the remedy"
        )
    if refused:
        raise DriveError(f"{files.axis}: {DECLINED}")
    say("all right" if motion else "all right, as far as it can be checked without motion")


def _confirm(torque_percent: float, servo: bool) -> bool:
    if servo:
        note(_FAST)
    try:
        return typer.confirm(_WARNING.format(torque=torque_percent), err=True)
    except typer.Abort:  # no terminal, or end of input
        note("")
        return False


def _tell(row: Row[BringUpContext]) -> None:
    console.print(f"{_MARKS[row.verdict.outcome]}  {row.check.title:<25}", end=" ")
    say(row.verdict.measured)
    for remedy in row.verdict.remedies:
        say(f"              -> {remedy}")


def _servo_as_measured(context: BringUpContext) -> Verdict:
    """Runs the axis at constant speeds without and with its correction, and compares the response.

    The response in motion is the one that the model holds.
    """
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.commissioning.calibration.motion import servo_check

    path = context.axis.path.with_name("model.yaml")
    model = TransmissionModel.load(path) if path.exists() else None
    if model is None or model.response is None:
        return not_possible("there is no model with a response in motion: hdbridge motion --propose")
    with context.interruptible() as interrupted:
        found = servo_check(context.boot(), model, interrupted)
    text = (
        f"following lag {found.lag_ms:.1f} ms, {found.stored_lag_ms:.1f} when it was measured; "
        f"responses differ by {100.0 * found.difference:.0f} %"
    )
    figures = {
        "following_lag_ms": found.lag_ms,
        "stored_following_lag_ms": found.stored_lag_ms,
        "difference": found.difference,
    }
    if found.agrees:
        return passed(text, **figures)
    return failed(
        text, "restore the gains of the servo, or measure it again: hdbridge motion --propose", **figures
    )


SERVO: Final[Check[Any]] = Check(
    "servo", "servo as measured", _servo_as_measured, ("turn", "quick_stop", "off"), moves=True
)
