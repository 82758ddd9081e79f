"""When the simulated axis is compiled: where numba is installed, and once that pays.

numba comes with the extra ``hdbridge[fast]``. Loading it takes a second, and compiling twelve more the first
time on a machine; what is compiled is kept on disk. So a process begins in Python and goes on with the
compiled axis after so many steps of the mechanics as would have paid for it; the numbers are the same.
"""

from __future__ import annotations

import copy
import importlib.util
import os
from typing import TYPE_CHECKING, Any, Final, Protocol, runtime_checkable

import numpy as np

if TYPE_CHECKING:
    from hdbridge.sim.axis import Axis, Told
    from hdbridge.sim.plant import Plant

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
IntArray = np.ndarray[Any, np.dtype[np.int64]]

PAYS_AFTER_SUBSTEPS: Final = 140_000
"""Steps of the mechanics that take as much longer in Python as loading the compiled axis takes: 10
microseconds each, where loading takes 1.4 s. A control cycle of 4 ms has eight."""
SWITCH: Final = "HDBRIDGE_COMPILE"
"""Environment variable: ``0`` keeps everything in Python."""
_PROOF_CYCLES: Final = 100
_PROOF_STEP_DEG: Final = 0.9


class AnyAxis(Protocol):
    """`Axis`, compiled or not."""

    def drive(
        self,
        start_counts: float,
        end_counts: float,
        substeps: int,
        limit_nm: float,
        noise_deg: float,
        outer_nm: float,
    ) -> Told: ...
    def roll(
        self, brake_nm: float, substeps: int, limit_nm: float, noise_deg: float, outer_nm: float
    ) -> Told: ...
    def hold(self, torque_nm: float) -> None: ...


@runtime_checkable
class EvenAxis(AnyAxis, Protocol):
    """`Axis` that goes through many cycles by itself; see `compiled.CompiledAxis`."""

    def drive_all(
        self,
        counts: FloatArray,
        substeps: IntArray,
        limit_nm: float,
        noise_deg: FloatArray,
        outer_nm: FloatArray,
        held_nm: FloatArray,
        told: FloatArray,
    ) -> Told: ...


class _Waiting:
    """Counts this process's substeps until compiling pays."""

    def __init__(self) -> None:
        self.left = PAYS_AFTER_SUBSTEPS

    def over(self, substeps: int) -> bool:
        """So many more; whether enough have been run."""
        self.left -= substeps
        return self.left <= 0


waiting: Final = _Waiting()


def compiled_axis(axis: Axis) -> AnyAxis:
    """The axis, compiled from the state in which it is; as it was where that is not possible."""
    if os.environ.get(SWITCH) == "0" or importlib.util.find_spec("numba") is None:
        return axis
    from hdbridge.sim import compiled  # noqa: PLC0415 - takes half a second, and the extra

    try:
        made = compiled.CompiledAxis(axis)
    except compiled.Uncompilable:
        return axis
    plant = type(axis.loops.plant)
    if plant not in _agreeing:
        _agreeing[plant] = _agree(copy.deepcopy(axis))
    return made if _agreeing[plant] else axis


_agreeing: Final[dict[type[Plant], bool]] = {}
"""Whether, on this machine, Python and the compiled axis agree bit for bit; tried once for each plant."""


def _agree(axis: Axis) -> bool:
    """Move back and forth with both, and compare all that they say."""
    from hdbridge.sim import compiled  # noqa: PLC0415

    other = compiled.CompiledAxis(axis)
    limit_nm, place = axis.loops.servo.limit_nm, axis.at_first()[0]
    for cycle in range(_PROOF_CYCLES):
        step_deg = _PROOF_STEP_DEG if cycle < _PROOF_CYCLES // 2 else -_PROOF_STEP_DEG
        step = step_deg * axis.motor_counts_per_deg
        ours = axis.drive(place, place + step, 8, limit_nm, 0.0, 0.0)
        if ours != other.drive(place, place + step, 8, limit_nm, 0.0, 0.0):
            return False
        place += step
    return True
