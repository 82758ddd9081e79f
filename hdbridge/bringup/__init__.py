"""Bring-up of an axis: what answers on the bus, and whether it is and does what the axis file says."""

from typing import Final

LISTEN_S: Final = 1.0
"""A scan listens for so long before it asks."""
ASK_TIMEOUT_S: Final = 0.02
"""Time for a node's first answer to a scan; one that has answered once gets longer for the rest."""
TORQUE_PERCENT: Final = 50.0
"""Most motor torque of `doctor`, of the rated one."""
