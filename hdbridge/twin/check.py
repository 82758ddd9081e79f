"""Detects changes of an axis since its twin was made, and names their causes.

The misfit to a new recording is compared with the misfit of the twin's fit. The latter equals the noise if
the twin has the axis's values, and is larger if the twin merely replays the motion; both kinds of twin are
therefore checked in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hdbridge.axis import AxisConfig
from hdbridge.errors import InputError
from hdbridge.records.recording import Recording
from hdbridge.sim.truth import Truth
from hdbridge.twin.fit import free_parameters
from hdbridge.twin.mechanics import measured_mechanics
from hdbridge.twin.misfit import CHANNELS, Data, Replays, Values, coarse, noise_floor, prepare
from hdbridge.twin.naming import GROWN, Finding, explain, findings, growth, scales_by_kind, shifted
from hdbridge.twin.parameters import BY_NAME, Parameter, by_cause, coordinates
from hdbridge.units import figure

CHECK_S = 17.0
"""Total duration of the pieces of a longer recording that a check uses."""
NOTICEABLE = 2.5
"""Change of a parameter that a recording must reveal, in units of the parameter's least change. If the
recording does not reveal it, the parameter's cause is reported as not observable."""
Z_SCORE = 3.0
"""Number of standard errors by which a measured change must differ from zero to count as a change, or from a
noticeable change to count as none."""
WARMTH = "temperature"
OWN = ("load friction", WARMTH, "current limit", "velocity feed-forward")
"""Parameters that a check fits in addition to those fitted for a twin. The temperature is left out if both
the twin and the recording contain it."""


@dataclass(frozen=True, slots=True)
class Check:
    """Result of a check: the changes, and the growth of the misfit that remains after them."""

    changes: tuple[Finding, ...]
    growth_before: Mapping[str, float]
    """Ratio, by channel, of the twin's misfit on this recording to its misfit on its own recordings."""
    growth_after: Mapping[str, float]
    """Ratio as in `growth_before`, but for the twin with the changes."""
    unseen: tuple[str, ...] = ()
    """Causes whose noticeable changes (`NOTICEABLE`) would not show in this motion or with this twin."""
    blind: bool = False
    """True if no noticeable change of any cause would show."""

    @property
    def sentence(self) -> str:
        """Summary in words: changes, channels with increased misfit, and causes that would not be visible."""
        causes = ", ".join(self.unseen)
        found = [f"This recording would not show a change in: {causes}"] if causes else []
        if self.changes:
            found.insert(0, f"Changed since the twin was made: {'. '.join(map(str, self.changes))}")
        elif self.unexplained:
            found.insert(
                0, "Something has changed since the twin was made that no change of a cause explains"
            )
        elif self.blind:
            found = ["The twin explains too little of this axis to show a change"]
        else:
            but = f", unless it is one of these, which this recording does not show: {causes}"
            found = [f"Nothing has changed since the twin was made{but if causes else ''}"]
        found[1:1] = [
            f"The twin leaves {figure(times, 3)} times as much of the {name} as when it was made"
            for name, times in self.unexplained.items()
        ]
        return f"{'. '.join(found)}."

    @property
    def unexplained(self) -> dict[str, float]:
        """Channels whose misfit has grown in spite of the changes, with their ratios."""
        return {name: times for name, times in self.growth_after.items() if times > GROWN}


def check(
    recording: Recording,
    axis: AxisConfig,
    twin: Truth,
    progress: Callable[[float], None] = lambda _: None,
    workers: int | None = None,
) -> Check:
    """Reports the changes between a twin and the axis in the recording.

    For a twin with the axis's values, a change is given as a value; for any other twin, as a ratio.
    InputError if the twin was not fitted, or the recording has no command.
    """
    about: Any = twin.provenance.get("fit")
    if not isinstance(about, dict):
        raise InputError(
            f"the truth '{twin.name}' has no uncertainty (provenance.fit); expected a twin that "
            "was fitted: make one with hdbridge twin"
        )
    whole = prepare(recording, axis, twin)
    data = coarse(whole, CHECK_S)
    floor, noise = noise_floor(data), about["noise"]
    scale = {name: max(noise.get(name, 0.0), floor[name]) for name in CHANNELS}
    was = scales_by_kind(data, about.get("misfit", {}), scale)
    # A recorded temperature is an input, not a change of the axis.
    known_warmth = BY_NAME[WARMTH].path in twin.intervals and all(
        each.commands.start_c is not None for each in data.pieces
    )
    parameters = free_parameters(twin, [each for each in OWN if not (known_warmth and each == WARMTH)])
    groups = by_cause(parameters)
    ratio = Values.of(twin) is Values.REPLAY
    shown = _factors(about, whole) if ratio else {}
    settled = {BY_NAME[name].cause for name in shown}
    with Replays(data, workers) as replays:
        unseen = tuple(
            cause
            for cause, own in groups.items()
            if cause not in settled and not _shows(replays, twin, own, was)
        )
        found = explain(replays, twin, parameters, was, progress, shown, ratio=ratio)
    changes = findings(found, groups, twin, ratio=ratio)
    blind = len(unseen) == len(groups)
    unseen = tuple(each for each in unseen if each not in found.causes)
    return Check(changes, found.growth_before, found.growth_after, unseen, blind)


def _factors(about: Mapping[str, Any], data: Data) -> dict[str, float]:
    """Returns the factors by which measured parameters have changed since the twin was made.

    A factor is 1 if a noticeable change is improbable. Parameters for which neither is certain are left out.
    """
    found, now = {}, measured_mechanics(data, about.get("speed_rad_s", 0.0))
    for name, (value, error) in about.get("mechanics", {}).items():
        if name in now:
            factor, relative = now[name].value / value, math.hypot(now[name].relative, error / value)
            size, least = abs(math.log(factor)), BY_NAME[name].least_change
            if size > max(least, Z_SCORE * relative):
                found[name] = factor
            elif size + Z_SCORE * relative < NOTICEABLE * least:
                found[name] = 1.0
    return found


def _shows(replays: Replays, twin: Truth, own: Sequence[Parameter], was: Mapping[str, Any]) -> bool:
    """Returns True if the recording reveals a noticeable change of at least one of the parameters ``own``.

    A change is revealed if the twin no longer explains the recording after this change, whatever its sign.
    The twin's own residual may hide a change or add to it, so the changed twin is compared with the recording
    rather than with the unchanged twin.
    """
    for each in own:
        (now,) = coordinates(twin, [each])
        moved = [shifted(twin, each, sign * NOTICEABLE * each.least_change) for sign in (-1.0, 1.0)]
        moved = [there for there in moved if abs(coordinates(there, [each])[0] - now) > each.least_change]
        grown = [growth(replays.data, found, was) for found in replays(moved)]
        if grown and min(max(by_channel.values(), default=0.0) for by_channel in grown) > GROWN:
            return True
    return False
