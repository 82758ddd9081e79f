"""Drives that conform to CiA 402 but differ in behaviour that the standard leaves to the firmware."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Final, Literal

from hdbridge.axis import AxisConfig
from hdbridge.device.behaviour import Behaviour, Controlword, HeartbeatConsumer
from hdbridge.device.node import DriveNode
from hdbridge.sim.truth import Truth


@dataclass(frozen=True)
class Character:
    """Behaviour of a drive's firmware, its quick stop option code, and the mode of the control cycle."""

    name: str
    behaviour: Behaviour = Behaviour()
    quick_stop_option: int = 2
    mode: Literal["csp", "ip"] = "csp"
    rude: bool = False
    """True for the drive of `support.rude`."""

    def of_axis(self, axis: AxisConfig) -> AxisConfig:
        update = {"quick_stop_option": self.quick_stop_option, "mode": self.mode}
        drive = axis.drive.model_copy(update=update)
        return axis.model_copy(update={"drive": drive})

    def of_truth(self, truth: Truth) -> Truth:
        return truth.model_copy(update={"firmware": self.behaviour})

    def __str__(self) -> str:
        return self.name


_RESTLESS: Final = {"controlword": Controlword.LEVEL, "holds_rpdo": True, "rpdo_before_tpdo": True}
_SLUGGISH: Final = {
    "status_delay_ms": 50.0,
    "sdo_delay_s": 2.0,
    "rpdo_timer": False,
    "heartbeat_consumer": HeartbeatConsumer.STOPS,
}
FRIENDLY: Final = Character("friendly")
RESTLESS: Final = Character("restless", Behaviour(**_RESTLESS), 6)
"""Drive that resumes whenever it can."""
SLUGGISH: Final = Character("sluggish", Behaviour(**_SLUGGISH), 6)
"""Drive that reports its state late."""
AWKWARD: Final = Character("awkward", Behaviour(**_RESTLESS, **_SLUGGISH), 2)
INTERPOLATED: Final = Character("interpolated", Behaviour(**_RESTLESS), 6, "ip")
"""Drive that resumes whenever it can, in interpolated position mode."""
RUDE: Final = Character("rude", quick_stop_option=6, rude=True)
CHARACTERS: Final = (FRIENDLY, RESTLESS, SLUGGISH, AWKWARD, INTERPOLATED)


def every_character() -> list[Character]:
    """Returns a character for each combination of all choices."""
    return list(_every_character())


def _every_character() -> Iterator[Character]:
    choices = {**_RESTLESS, **_SLUGGISH}
    for option in (2, 6):
        for taken in product((False, True), repeat=len(choices)):
            behaviour = dict(pair for pair, take in zip(choices.items(), taken, strict=True) if take)
            yield Character(", ".join((*behaviour, f"605Ah {option}")), Behaviour(**behaviour), option)


class PowerCount:
    """Counts how often a drive enters 'operation enabled'."""

    def __init__(self, node: DriveNode) -> None:
        self.times = 0
        firmware = node.firmware
        operate = firmware._operate

        def counted() -> None:
            self.times += 1
            operate()

        firmware._operate = counted  # type: ignore[method-assign]
