"""Bring-up of an axis: nodes on the bus, and checks of the axis against its axis file."""

from typing import Final

LISTEN_S: Final = 1.0
"""Time for which a scan listens before it sends requests; s."""
ASK_TIMEOUT_S: Final = 0.02
"""Time-out of a node's first answer to a scan, s; longer for a node that has answered once."""
TORQUE_PERCENT: Final = 50.0
"""Default motor torque limit of `doctor`, percent of the rated torque."""
