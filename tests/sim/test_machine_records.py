"""Records of the plant without causes are unchanged, bit for bit."""

import hashlib
import math
import struct
from pathlib import Path

import pytest

from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth

PROFILES = Path(__file__).parents[2] / "profiles"


def fingerprint(truth: Truth) -> str:
    """Digest of the encoder and torque readings in sines, sweeps, holds and coasting."""
    machine = Machine(truth, 7)
    digest = hashlib.sha256()
    substeps = round(0.004 / machine.dt_s)
    position = 0.0

    def keep() -> None:
        digest.update(struct.pack("<qqi", machine.motor_counts, machine.load_counts, machine.torque_permille))

    def to(target: float) -> None:
        nonlocal position
        machine.follow(position, target, substeps)
        position = target
        keep()

    for cycle in range(400):
        to(2000 * math.sin(cycle * 0.02) + 3 * cycle)
    for _ in range(100):
        to(position)
    for _ in range(200):
        to(position - 7.3)
    for cycle in range(50):
        machine.coast(substeps, cycle > 20)
        keep()
    position = float(machine.motor_counts)
    for _ in range(300):
        to(position + 20)
    return digest.hexdigest()[:16]


# The first digest of each row is of a gear without tooth error, whose ratio is constant; it was recorded
# before the plant had causes and a momentary ratio. The digests are the same on any C library whose sine
# differs by too little to change a count.
@pytest.mark.parametrize(
    ("profile", "substep_ms", "without_teeth", "expected"),
    [
        ("article", 0.5, "d222eb2e8c162ca8", "e8f73a28f8bd3724"),
        ("article", 1.0, "c76b27860d3b1a6d", "8dd30db63332f57d"),
        ("demo", 0.5, "9b295d54d14b6536", "c8d5cf5377dbfd9c"),
    ],
)
def test_without_causes_records_are_unchanged(profile, substep_ms, without_teeth, expected):
    truth = Truth.load(PROFILES / profile).model_copy(update={"substep_ms": substep_ms})
    assert fingerprint(truth) == expected
    gear = truth.gear.model_copy(update={"motor_orders": ()})
    assert fingerprint(truth.model_copy(update={"gear": gear})) == without_teeth
