"""Effects that are errors of an encoder, as the plant has them; see `hdbridge.twin.translation`."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Final

from hdbridge.effects import (
    ChannelSkew,
    CountLoss,
    LoadOrders,
    MotorEncoderEccentricity,
    MotorOrder,
    SubdivisionalError,
)
from hdbridge.twin.draft import ARCSEC_PER_RAD, Draft, Said, none
from hdbridge.twin.gear_effects import gear_load_orders

RADIUS_MM: Final = 20.0
"""Of a disc's graduation, where nobody says: only the eccentricity's ratio to it is seen."""
LATEST_MS: Final = 100.0
SMALL_ARCSEC: Final = 0.05
"""What is lost in a translation and smaller than this is not worth a note: a tenth of a usual count."""
_LIMITS: Final = {
    "sine_offset": 0.5, "cosine_offset": 0.5, "gain_mismatch": 0.5, "phase_mismatch_deg": 45.0,
    "third_harmonic": 0.3,
}  # fmt: skip


def motor_eccentricity(effect: MotorEncoderEccentricity, draft: Draft) -> Said:
    """The disc of the motor encoder; the drive holds its reading, so the load runs by the opposite.

    A disc reads (e / r) sin(a - a0) too much, so the load is that much behind, divided by the ratio.
    """
    # -sin(a - a0) = cos(a + 90 deg - a0), and the same for twice the angle.
    disc = _disc(effect.orders, draft.ratio, lambda phase_deg: 90.0 - phase_deg)
    draft.part("motor", "encoder")["disc"] = disc
    return Said("motor.encoder.disc", (f"radius assumed as {RADIUS_MM:g} mm",))


def load_orders(effect: LoadOrders, draft: Draft) -> Said:
    """The load encoder's disc where it is known to be that, else a pitch error of the spline."""
    if effect.origin != "load_encoder":
        said = gear_load_orders(effect.orders, draft)
        unknown = ("origin unknown: taken for the gear's",) if effect.origin == "unknown" else ()
        return Said(said.counterpart, (*unknown, *said.notes))
    few = [each for each in effect.orders if each.order <= 2]
    more = [each for each in effect.orders if each.order > 2]
    # sin(a - a0) = cos(a - a0 - 90 deg)
    draft.part("load", "encoder")["disc"] = _disc(few, 1.0, lambda phase_deg: -90.0 - phase_deg)
    notes = [f"radius assumed as {RADIUS_MM:g} mm"]
    if more:
        gear_load_orders(more, draft)
        notes.append("orders beyond 2 go to gear.load_orders: a disc has none")
    return Said("load.encoder.disc", tuple(notes))


def _disc(orders: Iterable[MotorOrder], ratio: float, at_deg: Any) -> dict[str, Any]:
    disc: dict[str, Any] = {"radius_mm": RADIUS_MM}
    for each in orders:
        off_um = each.amplitude_arcsec * ratio / ARCSEC_PER_RAD * RADIUS_MM * 1000.0
        at = math.remainder(at_deg(each.phase_deg), 360.0)
        if each.order == 1:
            disc |= {"eccentricity_um": off_um, "eccentric_at_deg": at}
        else:
            disc |= {"ovality_um": off_um, "oval_at_deg": 0.5 * at}
    return disc


def channel_skew(effect: ChannelSkew, draft: Draft) -> Said:
    """The other encoder's reading is old: where the load is read later, the motor's reading is."""
    delay_ms = effect.delay_ms
    late = "motor" if delay_ms > 0.0 else "load"
    draft.part(late, "encoder")["late_ms"] = min(abs(delay_ms), LATEST_MS)
    notes = []
    if abs(delay_ms) > LATEST_MS:
        notes.append(f"no more than {LATEST_MS:g} ms")
    rest_ms2 = effect.second_order_ms2 - delay_ms**2
    most = 0.5e-6 * abs(rest_ms2) * draft.axis.limits.acceleration_deg_s2 * 3600.0
    if most > SMALL_ARCSEC:
        notes.append(
            f"a pure delay: up to {most:.2g} arcsec of the model's part by acceleration are not of a delay"
        )
    return Said(f"{late}.encoder.late_ms", tuple(notes))


def subdivisional_error(effect: SubdivisionalError, draft: Draft) -> Said:
    """Offsets, gain, phase and third harmonic of the signals, to first order.

    The angle read from (1 + g) sin p - t sin 3p + s and cos(p + d) + t cos 3p + c is off by
    s cos p - c sin p + g/2 sin 2p - d/2 cos 2p - t sin 4p, in radians of a line.
    """
    line_arcsec = ARCSEC_PER_RAD / effect.lines_per_turn
    signals: dict[str, float] = {"lines_per_turn": effect.lines_per_turn}
    lost_arcsec = 0.0
    for each in effect.orders:
        part = each.amplitude_arcsec / line_arcsec
        cosine, sine = (part * of(math.radians(each.phase_deg)) for of in (math.cos, math.sin))
        if each.order == 1:
            signals |= {"sine_offset": cosine, "cosine_offset": sine}
        elif each.order == 2:
            signals |= {"gain_mismatch": -2.0 * sine, "phase_mismatch_deg": math.degrees(-2.0 * cosine)}
        else:
            signals["third_harmonic"] = sine
            lost_arcsec = abs(cosine) * line_arcsec
    notes = []
    if lost_arcsec > SMALL_ARCSEC:
        notes.append(f"{lost_arcsec:.2g} arcsec of the fourth order are no third harmonic of either signal")
    for name, limit in _LIMITS.items():
        if abs(signals.get(name, 0.0)) > limit:
            notes.append(f"{name} held at {limit:g}: {signals[name]:.2g} is no signal any more")
            signals[name] = math.copysign(limit, signals[name])
    draft.part("load", "encoder")["signals"] = signals
    return Said("load.encoder.signals", tuple(notes))


def count_loss(effect: CountLoss, draft: Draft) -> Said:
    """Counts of the load encoder, lost at the same times after it is switched on."""
    counts_per_arcsec = draft.axis.load_encoder.counts(1.0) / 3600.0
    losses = [
        {"time_s": each.time_s, "counts": round(each.size_arcsec * counts_per_arcsec)}
        for each in effect.steps
        if each.time_s >= 0.0
    ]
    if not losses:
        return none("it was before the record's time zero, and is in the encoders' zero by now")
    draft.part("load", "encoder")["losses"] = losses
    return Said(
        "load.encoder.losses", ("each time again, so long after the axis is switched on; whole counts",)
    )
