"""Conversion of samples to the columns that clients receive. Pure."""

from collections.abc import Collection, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hdbridge.client.messages import AxisColumns, ControlState, Event, Samples
from hdbridge.units import ARCSEC_PER_DEG

_STATES: Final = [each.value for each in ControlState]
_AS_THEY_ARE: Final = (
    "load_target_deg", "load_position_deg", "motor_position_deg", "motor_torque_nm", "velocity_deg_s",
    "correction_arcsec", "predicted_arcsec", "loop_arcsec", "weight", "reading0", "reading1",
)  # fmt: skip


def columns(
    samples: NDArray[np.void],
    names: Sequence[str],
    *,
    every: int = 1,
    wanted: Collection[str] | None = None,
    events: Sequence[Event] = (),
    lost: int = 0,
) -> Samples:
    """Returns a batch as columns: the cycles whose number ``every`` divides, of the ``wanted`` axes.

    ``names`` are the axes in the order of the samples. NaN stays NaN here and becomes ``null`` in JSON.
    """
    if every > 1:
        samples = samples[samples["cycle"] % every == 0]
    # Not validated, because these are the daemon's own values, thousands per second.
    return Samples.model_construct(
        time_s=(samples["time_ns"] / 1e9).tolist(),
        cycle=samples["cycle"].tolist(),
        late_us=_plain(samples["late_us"]),
        busy_us=_plain(samples["busy_us"]),
        bus_load=[*_plain(samples["bus_load"])],
        skipped=samples["skipped"].tolist(),
        axes={
            name: _axis(samples["axes"][:, place])
            for place, name in enumerate(names)
            if wanted is None or name in wanted
        },
        events=list(events),
        lost=lost,
    )


def _axis(rows: NDArray[Any]) -> AxisColumns:
    found: dict[str, Any] = {name: rows[name].tolist() for name in _AS_THEY_ARE}
    error_arcsec = ARCSEC_PER_DEG * (rows["load_position_deg"] - rows["load_target_deg"])
    return AxisColumns.model_construct(
        state=[_STATES[each] for each in rows["state"].tolist()], error_arcsec=error_arcsec.tolist(), **found
    )


def _plain(column: NDArray[Any]) -> list[float]:
    return [float(each) for each in column.astype(float)]
