"""NMT states and commands, as CiA 301 numbers them."""

from enum import IntEnum


class Nmt(IntEnum):
    """NMT states, as a heartbeat reports them."""

    INITIALISING = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


class NmtCommand(IntEnum):
    """NMT commands."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130
