"""Switches the simulated axis to compiled code as soon as that pays off, if numba is installed.

numba comes with the extra ``hdbridge[fast]``. Loading numba takes a second, and the first compilation on a
computer takes twelve more; compiled code is kept on disk. A process therefore begins in Python and switches
to the compiled axis after enough substeps to pay for compiling. The results are the same.
"""

from __future__ import annotations

import copy
import importlib.util
import os
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from hdbridge.sim.axis import Axis
    from hdbridge.sim.compiled import CompiledAxis
    from hdbridge.sim.plant import Plant

    AnyAxis: TypeAlias = Axis | CompiledAxis

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
IntArray = np.ndarray[Any, np.dtype[np.int64]]

PAYS_AFTER_SUBSTEPS: Final = 140_000
"""Number of substeps after which compiling pays off: each substep takes 10 microseconds in Python, and
loading the compiled axis takes 1.4 s. A control cycle of 4 ms has eight substeps."""
SWITCH: Final = "HDBRIDGE_COMPILE"
"""Environment variable that disables compilation if it is ``0``."""
_PROOF_CYCLES: Final = 100
_PROOF_STEP_DEG: Final = 0.9


class _Waiting:
    """Counts this process's substeps until compiling pays off."""

    def __init__(self) -> None:
        self.left = PAYS_AFTER_SUBSTEPS

    def over(self, substeps: int) -> bool:
        """Counts substeps; returns True once the threshold is reached."""
        self.left -= substeps
        return self.left <= 0


waiting: Final = _Waiting()


def compiled_axis(axis: Axis) -> AnyAxis:
    """Returns the axis compiled in its current state, or the axis itself if compiling is not possible."""
    if os.environ.get(SWITCH) == "0" or importlib.util.find_spec("numba") is None:
        return axis
    from hdbridge.sim import compiled  # noqa: PLC0415 - takes half a second and needs numba

    try:
        made = compiled.CompiledAxis(axis)
    except compiled.Uncompilable:
        return axis
    plant = type(axis.plant)
    if plant not in _agreeing:
        _agreeing[plant] = _agree(copy.deepcopy(axis))
    return made if _agreeing[plant] else axis


_agreeing: Final[dict[type[Plant], bool]] = {}
"""Results of `_agree` on this computer, one per class of plant."""


def _agree(axis: Axis) -> bool:
    """Runs both axes back and forth; returns True if all results are identical bit for bit."""
    from hdbridge.sim import compiled  # noqa: PLC0415

    other = compiled.CompiledAxis(axis)
    limit_nm, place = axis.servo.limit_nm, axis.at_first()[0]
    for cycle in range(_PROOF_CYCLES):
        step_deg = _PROOF_STEP_DEG if cycle < _PROOF_CYCLES // 2 else -_PROOF_STEP_DEG
        step = step_deg * axis.motor_counts_per_deg
        ours = axis.drive(place, place + step, 8, limit_nm, 0.0, 0.0)
        if ours != other.drive(place, place + step, 8, limit_nm, 0.0, 0.0):
            return False
        place += step
    return True
