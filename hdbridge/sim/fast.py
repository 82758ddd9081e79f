"""When the loops and mechanics are compiled: where numba is installed, and once that pays.

numba comes with the extra ``hdbridge[fast]``. Loading it takes a second, and compiling ten more the first
time on a machine; what is compiled is kept on disk. So a process begins in Python and goes on with the
compiled loops after so many steps of the mechanics as would have paid for it; the numbers are the same.
"""

from __future__ import annotations

import copy
import importlib.util
import os
from typing import TYPE_CHECKING, Any, Final, Protocol, runtime_checkable

import numpy as np

from hdbridge.sim.loops import Loops, Seen, Slow

if TYPE_CHECKING:
    from hdbridge.sim.heat import Heat
    from hdbridge.sim.plant import Plant

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
IntArray = np.ndarray[Any, np.dtype[np.int64]]

PAYS_AFTER_SUBSTEPS: Final = 140_000
"""Steps of the mechanics that take as much longer in Python as loading the compiled loops takes: 10
microseconds each, where loading takes 1.4 s. A control cycle of 4 ms has eight."""
SWITCH: Final = "HDBRIDGE_COMPILE"
"""Environment variable: ``0`` keeps everything in Python."""
_PROOF_CYCLES: Final = 100
_PROOF_STEP_DEG: Final = 0.9


class AnyLoops(Protocol):
    """`Loops`, compiled or not."""

    def power_on(self, slow: Slow) -> float: ...
    def begin_demand(self, demand_deg: float) -> None: ...
    def hold(self, torque_nm: float) -> None: ...
    def follow(self, demand_deg: float, demand_deg_s: float, substeps: int, slow: Slow) -> Seen: ...
    def coast(self, brake_nm: float, substeps: int, slow: Slow) -> Seen: ...


@runtime_checkable
class EvenLoops(AnyLoops, Protocol):
    """`Loops` that go through many cycles by themselves; see `compiled.CompiledLoops`."""

    def follow_all(
        self,
        demand_deg: FloatArray,
        demand_deg_s: FloatArray,
        substeps: IntArray,
        heat: Heat,
        limit_nm: float,
        outer_nm: FloatArray,
        held_nm: FloatArray,
    ) -> tuple[FloatArray, FloatArray]: ...


class _Waiting:
    """Counts this process's substeps until compiling pays."""

    def __init__(self) -> None:
        self.left = PAYS_AFTER_SUBSTEPS

    def over(self, substeps: int) -> bool:
        """So many more; whether enough have been run."""
        self.left -= substeps
        return self.left <= 0


waiting: Final = _Waiting()


def compiled_loops(loops: Loops) -> AnyLoops:
    """The loops, compiled from the state in which they are; as they were where that is not possible."""
    if os.environ.get(SWITCH) == "0" or importlib.util.find_spec("numba") is None:
        return loops
    from hdbridge.sim import compiled  # noqa: PLC0415 - takes half a second, and the extra

    try:
        made = compiled.CompiledLoops(loops)
    except compiled.Uncompilable:
        return loops
    plant = type(loops.plant)
    if plant not in _agreeing:
        _agreeing[plant] = _agree(copy.deepcopy(loops))
    return made if _agreeing[plant] else loops


_agreeing: Final[dict[type[Plant], bool]] = {}
"""Whether, on this machine, Python and the compiled loops agree bit for bit; tried once for each plant."""


def _agree(loops: Loops) -> bool:
    """Move back and forth with both, and compare all that they say."""
    from hdbridge.sim import compiled  # noqa: PLC0415

    other = compiled.CompiledLoops(loops)
    slow = (loops.plant.now.temperature_c, 1.0, loops.servo.limit_nm, 0.0, 0.0)
    place_deg = loops.power_on(slow)
    if other.power_on(slow) != place_deg:
        return False
    for cycle in range(_PROOF_CYCLES):
        step_deg = _PROOF_STEP_DEG if cycle < _PROOF_CYCLES // 2 else -_PROOF_STEP_DEG
        speed_deg_s = step_deg / (8 * loops.dt_s)
        if loops.follow(place_deg, speed_deg_s, 8, slow) != other.follow(place_deg, speed_deg_s, 8, slow):
            return False
        place_deg += step_deg
    return True
