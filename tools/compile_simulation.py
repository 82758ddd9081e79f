"""Compiles the loops of the simulated axis and caches them on disk, for tests in several processes."""

from __future__ import annotations

from hdbridge.files.profile import bundled_profile
from hdbridge.sim import fast
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth

CYCLES = 8
SUBSTEPS = 8


def compile_all() -> None:
    """Compiles each method that contains a loop, for both kinds of plant, by calling it."""
    fast.waiting.left = 0
    for loaded in (False, True):
        machine = Machine(Truth.load(bundled_profile("article")), 0, may_compile=True, loaded=loaded)
        machine.follow(0.0, 1.0, SUBSTEPS)
        machine.follow_all([1.0] * (CYCLES + 1), [SUBSTEPS] * CYCLES)
        machine.coast(SUBSTEPS, braked=False)


if __name__ == "__main__":
    compile_all()
