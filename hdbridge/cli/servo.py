"""Check of ``hdbridge doctor --servo``: the servo against the response in motion that the model holds."""

from __future__ import annotations

from typing import Final

from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.bringup.checks import Check, Verdict, failed, not_possible, passed
from hdbridge.commissioning.bringup.context import BringUpContext
from hdbridge.commissioning.calibration.motion import servo_check


def as_measured(context: BringUpContext) -> Verdict:
    """Runs the axis at constant speeds without and with its correction, and compares the response."""
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


SERVO: Final[Check[BringUpContext]] = Check(
    "servo", "servo as measured", as_measured, ("turn", "quick_stop", "off"), moves=True
)
