"""Conversion of the service's state to messages of the API."""

from __future__ import annotations

import math
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

from hdbridge.axis.channels import BY_KEY
from hdbridge.client import messages
from hdbridge.daemon.loop.faultlog import fault_of
from hdbridge.daemon.loop.states import STOPPED, AxisState
from hdbridge.daemon.memory import NO_FAULT, OuterCell, SampleFlag
from hdbridge.daemon.service.eventlog import MODES, STATES, reset_hint, stop_hint
from hdbridge.drive.emergencies import gateway_error
from hdbridge.drive.states import State
from hdbridge.drive.supervision import ROWS, Fault
from hdbridge.units import ARCSEC_PER_DEG

if TYPE_CHECKING:
    from hdbridge.daemon.memory import OuterCells
    from hdbridge.daemon.service.axis import ServiceAxis
    from hdbridge.daemon.service.lease import Lease
    from hdbridge.daemon.setting import CompensationSetting

GATEWAY_DEAD_NS: Final = 2_000_000_000
_NUMBERS: Final = (
    "velocity_deg_s", "motor_target_deg", "motor_position_deg", "motor_torque_nm", "correction_arcsec",
    "predicted_arcsec", "weight",
)  # fmt: skip
"""Numbers of a sample that `messages.AxisState` has under the same name."""
_FLAGS: Final = {
    str(each.name).lower(): each
    for each in SampleFlag
    if each.name in {"AT_REST", "COMPENSATING", "LIMITED", "MEMORY_KNOWN", "CHANGING", "UNDERRUN"}
}
"""Flags of a sample that `messages.AxisState` has under the same name, in lower case."""


def lease_state(lease: Lease, now_s: float) -> messages.LeaseState:
    """Returns the state of the lease."""
    holder = lease.holder
    if holder is None:
        return messages.LeaseState(held=False, timeout_s=lease.timeout_s)
    since = datetime.fromtimestamp(datetime.now(UTC).timestamp() - (now_s - holder.taken_s), UTC)
    return messages.LeaseState(
        held=True,
        client=holder.client,
        since=since,
        remaining_s=max(holder.expires_s - now_s, 0.0) if math.isfinite(holder.expires_s) else None,
        timeout_s=lease.timeout_s,
    )


def model_in_use(in_use: CompensationSetting) -> messages.ModelInUse | None:
    """Returns the model in use and its age; None without a model."""
    if not in_use.model.effects:
        return None
    date = _date(in_use.model.provenance.get("date"))
    age_s = max((datetime.now(UTC) - date).total_seconds(), 0.0) if date is not None else None
    return messages.ModelInUse(
        version=in_use.version,
        file=str(in_use.file or ""),
        date=date,
        age_s=age_s,
        reason=str(in_use.model.provenance.get("reason", "")),
        effects=[each.name for each in in_use.model.effects],
    )


def outer_state(
    cells: OuterCells, node_id: int, alive_ns: int, latency_s: tuple[float, float] | None
) -> messages.OuterState:
    """Returns the state of an axis as seen by the outer master.

    ``alive_ns`` is the time of the gateway process's last heartbeat. ``latency_s`` holds median and 99th
    percentile of the time from an outer SYNC to the drive's first frame with its target.
    """
    view, (median_s, most_s) = cells.view, latency_s or (None, None)
    period_s = 1e-9 * cells[OuterCell.PERIOD_NS]
    return messages.OuterState(
        node_id=cells[OuterCell.NODE_ID] or node_id,
        alive=time.monotonic_ns() - alive_ns < GATEWAY_DEAD_NS,
        nmt=view.nmt,
        statusword=view.statusword,
        error_code=view.error_code,
        error=gateway_error(view.error_code) if view.error_code else None,
        period_s=period_s or None,
        jitter_s=1e-9 * cells[OuterCell.JITTER_NS] if period_s else None,
        latency_s=median_s,
        latency_99_s=most_s,
    )


def axis_state(axis: ServiceAxis, outer: messages.OuterState | None) -> messages.AxisState:
    """Returns the state of an axis; ``outer`` is that of its node in a gateway."""
    link, config, following = axis.link, axis.axis.config, axis.following
    flags = int(link.value("flags"))
    known = link.core.newest is not None
    in_use = axis.models.in_use

    def number(field: str) -> float | None:
        value = link.value(field)
        return value if known and math.isfinite(value) else None

    target, load = number("load_target_deg"), number("load_position_deg")
    error = None if target is None or load is None else ARCSEC_PER_DEG * (load - target)
    readings = {BY_KEY[key].value: number(f"reading{place}") for place, key in enumerate(config.channels)}
    return messages.AxisState(
        name=axis.name,
        profile=str(axis.axis.profile.folder),
        node_id=config.drive.node_id,
        ratio=config.gear.ratio,
        state=STATES[link.state],
        power=link.power,
        mode=MODES[int(link.value("mode"))],
        load_target_deg=target,
        load_position_deg=load,
        **{name: number(name) for name in _NUMBERS},
        **{name: bool(flags & flag) for name, flag in _FLAGS.items()},
        error_arcsec=error,
        readings=readings,
        scheme=in_use.scheme,
        limits=messages.Limits.model_validate(config.limits, from_attributes=True),
        fault=_fault(axis),
        model=model_in_use(in_use),
        load_loop=messages.LoadLoopState(
            configured=axis.axis.load_loop is not None,
            on=in_use.load_loop,
            correction_arcsec=link.value("loop_arcsec"),
            doubt=axis.loop_doubt if flags & SampleFlag.LOOP_DOUBTED else None,
        ),
        adaptation=following.state if following is not None else messages.AdaptationState(),
        outer=outer,
        advice=list(following.advice) if following is not None else [],
        queued=axis.motion.queued,
    )


def _fault(axis: ServiceAxis) -> messages.Fault | None:
    """Returns the cause of a latched stop or a drive fault; None without either."""
    link, (event, date) = axis.link, axis.stopped or (None, None)
    code = int(link.value("fault")) if link.core.newest is not None else NO_FAULT
    fault = fault_of(code)
    latched = link.state in STOPPED
    if not latched and link.power is not State.FAULT:
        return None
    if fault is None and event is not None:
        fault = fault_of(event.code)
    if fault is None and not latched:
        fault = Fault.DRIVE_FAULT
    if event is not None:
        text, hint = event.text, stop_hint(event, axis.name)
    elif fault is not None:
        text, hint = fault.value, ROWS[fault].hint
    else:
        text, hint = "quick stop by command", reset_hint(axis.name)
    return messages.Fault(
        name=fault.name if fault is not None else "COMMAND",
        text=text,
        hint=hint,
        cycle=event.cycle if event is not None else None,
        date=date,
        needs_verification=link.state is AxisState.LATCHED,
    )


def _date(value: object) -> datetime | None:
    """Returns a date of a provenance; None if invalid."""
    try:
        date = datetime.fromisoformat(str(value))
    except ValueError:
        return None
    return date if date.tzinfo is not None else date.replace(tzinfo=UTC)
