"""Gain objects of the servo: the CiA-402 parameter sets of its loops, if the drive has them."""

from collections.abc import Mapping
from typing import Final

from canopen.objectdictionary import ODVariable

from hdbridge.drive.dictionary import integer_type
from hdbridge.drive.sdo import SdoClient
from hdbridge.errors import SdoError

GAIN_OBJECTS: Final = (0x60F6, 0x60F9, 0x60FB)
"""Parameter sets of torque, velocity and position control (CiA 402-2)."""


def read_gains(sdo: SdoClient) -> dict[str, int]:
    """Reads the readable integer objects of `GAIN_OBJECTS` in the EDS; the keys are like ``60FBh:01``."""
    found = {}
    for index in GAIN_OBJECTS:
        entry = sdo.od.get(index)
        if entry is None:
            continue
        members = [entry] if isinstance(entry, ODVariable) else list(entry.subindices.values())[1:]
        for each in members:
            if integer_type(each) is None or not each.readable:
                continue
            try:
                found[f"{index:04X}h:{each.subindex:02X}"] = sdo.read(index, each.subindex)
            except SdoError:
                continue  # the EDS of a family lists objects that some of its drives lack
    return found


def changed_gains(then: Mapping[str, int], now: Mapping[str, int]) -> list[str]:
    """Returns one line of text for each gain object whose value has changed."""
    return [
        f"{name} is {now[name]}, was {value} when the response was measured"
        for name, value in then.items()
        if name in now and now[name] != value
    ]
