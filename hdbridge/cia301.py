"""Constants of CiA 301 for the master and the simulated drive: NMT states and commands, 32-bit positions."""

from enum import IntEnum
from typing import Final

INT32_RANGE: Final = 1 << 32


class NmtCommand(IntEnum):
    """First byte of an NMT message."""

    START = 0x01
    STOP = 0x02
    PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NmtState(IntEnum):
    """Byte of a heartbeat."""

    INITIALISING = 0x00
    BOOT_UP = 0x00
    """Byte of a boot-up message; CiA 301 uses the value of INITIALISING."""
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


def wrap_int32(value: int) -> int:
    """Wraps an unbounded count to the range of a signed 32-bit object."""
    return (value + INT32_RANGE // 2) % INT32_RANGE - INT32_RANGE // 2
