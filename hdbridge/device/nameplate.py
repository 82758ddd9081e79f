"""Data that distinguish simulated drives: serial number, encoders, gear, rated torque."""

from dataclasses import dataclass
from typing import Final

from hdbridge.device.dictionary import Dictionary

LOAD_OBJECT: Final = (0x60E4, 1)
MOTOR_POSITION: Final = (0x6064, 0)
"""Position actual value, which is always that of the motor. As ``load_object`` it means that the axis has no
load encoder."""


@dataclass(frozen=True)
class Nameplate:
    """Values of the read-only objects 1018h:04, 6076h, 608Fh, 6091h, 6092h, 60E6h and 60E9h."""

    serial: int = 1
    motor_counts_per_turn: int = 8000
    load_counts_per_turn: int = 2_880_000
    gear_motor_turns: int = 50
    gear_load_turns: int = 1
    rated_torque_mnm: int = 320
    load_object: tuple[int, int] = LOAD_OBJECT
    """Index and sub-index of the load encoder's object."""

    def engrave(self, dictionary: Dictionary) -> None:
        """Writes these values to the dictionary, as current values and as defaults."""
        # Positions are motor counts. If gear ratio or feed is missing, they do not include the gear.
        motor_turns, load_turns = self.gear_motor_turns, self.gear_load_turns
        if (0x6091, 1) not in dictionary or (0x6092, 1) not in dictionary:
            motor_turns = load_turns = 1
        for key, value in {
            (0x1018, 4): self.serial,
            (0x6076, 0): self.rated_torque_mnm,
            (0x608F, 1): self.motor_counts_per_turn,
            (0x6091, 1): motor_turns,
            (0x6091, 2): load_turns,
            (0x6092, 1): self.motor_counts_per_turn * motor_turns,
            (0x6092, 2): load_turns,
            (0x60E6, 1): self.load_counts_per_turn,
            (0x60E9, 1): self.load_counts_per_turn,
        }.items():
            dictionary[key].default = dictionary[key].value = value
