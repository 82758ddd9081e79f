"""Binding of a model or twin to its axis, gear and drive."""

from collections.abc import Mapping
from typing import Any

from hdbridge.axis import AxisConfig, Identity, Teeth
from hdbridge.axis.model.file import Provenance
from hdbridge.errors import InputError


def binding(axis: AxisConfig, identity: Identity | None = None) -> dict[str, Any]:
    """Returns the provenance entries that bind a model to an axis."""
    return {
        "axis": axis.name,
        "drive": (identity or axis.drive.identity).model_dump(exclude_none=True),
        "gear": axis.gear.model_dump(include={"ratio", "teeth"}, exclude_none=True),
    }


def check_binding(
    provenance: Mapping[str, Any],
    axis: AxisConfig,
    identity: Identity | None,
    name: str,
    noun: str,
    instead: str,
) -> None:
    """Raises `InputError` if a model or twin belongs to another drive, axis or gear.

    ``identity`` is the identity read from the drive, by default that of the axis file. Values that the
    provenance or the drive lacks are not compared. The revision is never compared, because new firmware does
    not change a gear. ``noun`` ("model" or "twin") and ``instead`` (advice) are used in messages.
    """
    bound = Provenance.model_validate(provenance)

    def of_another(what: str, theirs: str, ours: str) -> InputError:
        return InputError(
            f"{name}: provenance.{what}: this {noun} was made for {theirs}, but the {what} here is "
            f"{ours} ({axis.path}); use the {noun} of this {what}, or {instead} (if it is the same gear, "
            f"correct provenance.{what} in the {noun}'s file)"
        )

    if bound.axis is not None and bound.axis != axis.name:
        raise of_another("axis", f"'{bound.axis}'", f"'{axis.name}'")
    teeth = bound.gear.teeth if bound.gear else None
    if teeth and axis.gear.teeth and teeth != axis.gear.teeth:
        raise of_another("gear", _teeth_words(teeth), _teeth_words(axis.gear.teeth))
    present = identity or axis.drive.identity
    for key in ("vendor_id", "product_code", "serial"):
        theirs, ours = getattr(bound.drive, key, None), getattr(present, key)
        if theirs is not None and ours is not None and theirs != ours:
            raise of_another("drive", f"{key} {theirs:#x}", f"{ours:#x}")


def _teeth_words(teeth: Teeth) -> str:
    return f"{teeth.flexspline}/{teeth.circular_spline} teeth, {teeth.output} output"
