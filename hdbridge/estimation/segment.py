"""What an identification is given: stretches of a measurement, in the order in which they were taken."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import Enum

import numpy as np

from hdbridge.effects import Channel, FloatArray, Start
from hdbridge.errors import InputError

MINIMUM_SAMPLES = 8


class Kind(Enum):
    """What the axis was doing. It decides which samples are near enough to standing to be used."""

    STANDSTILL = "standstill"
    SWEEP = "sweep"
    SINE = "sine"
    REVERSAL = "reversal"
    STEP = "step"
    """A fast move followed by a rest: only the rest is used."""
    MOVE = "move"
    """On the way somewhere: it carries the elastic state, and is used only where it is slow."""
    UNKNOWN = "unknown"

    @classmethod
    def named(cls, name: str) -> Kind:
        """The kind that a recording's leg of this name is; `UNKNOWN` for a name that says nothing."""
        aliases = {"precondition": cls.MOVE, "settle": cls.STEP}
        return aliases.get(name) or next((each for each in cls if each.value == name), cls.UNKNOWN)


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """One stretch of a measurement. All arrays have one length; uneven sampling is allowed.

    A segment follows the one before it: the axis moved straight from the last sample of that to the first of
    this, and the gear's elastic state came along. Where that is not so, say what the state was (``start``),
    that it is not known (``follows``), or give it another ``zero``: the encoders' zeros may have been lost in
    between.
    """

    time_s: FloatArray
    motor_deg: FloatArray
    """Motor angle, multi-turn degrees: the *commanded* one where there is one."""
    load_deg: FloatArray
    """Measured load angle, multi-turn degrees."""
    kind: Kind = Kind.UNKNOWN
    position_deg: FloatArray | None = None
    """Measured motor angle in addition to the commanded one, multi-turn degrees."""
    commanded: bool = True
    """False where ``motor_deg`` is measured: its chatter is then kept away from the hysteresis."""
    measured: Mapping[Channel, FloatArray] = field(default_factory=dict)
    """The measured channels that it has."""
    start: Start | None = None
    """The elastic state at the first sample where it is known and does not follow from the segment before."""
    follows: bool = True
    """False where nothing is known of the axis between the segment before and this one."""
    zero: int = 0
    """Segments of one number share one absolute zero."""
    name: str = "segment"
    """What complaints call it: a file, a leg."""

    def __post_init__(self) -> None:
        """InputError where the arrays do not fit together or hold what cannot be computed with."""
        count = len(self.time_s)
        arrays = {each.name: getattr(self, each.name) for each in fields(self)}
        arrays.update((channel.value, values) for channel, values in self.measured.items())
        for name, value in arrays.items():
            if not isinstance(value, np.ndarray):
                continue
            if value.shape != (count,):
                raise InputError(
                    f"{self.name}: {name} has shape {value.shape}, expected ({count},) like time_s; "
                    "give every channel one value per sample"
                )
            bad = np.flatnonzero(~np.isfinite(value))
            if len(bad):
                raise InputError(
                    f"{self.name}: {name} of sample {bad[0]} is {value[bad[0]]}; expected a finite "
                    "number: remove the sample or repair the file"
                )
        back = np.flatnonzero(np.diff(self.time_s) < 0)
        if len(back):
            raise InputError(
                f"{self.name}: time_s of sample {back[0] + 1} lies before that of sample {back[0]}; expected "
                "time to run forwards: sort the samples, or make two segments of them"
            )

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.time_s)
