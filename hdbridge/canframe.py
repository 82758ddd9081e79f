"""The message of every cycle, cheap to make and to copy, for both ends of the bus."""

from __future__ import annotations

import can
from can.typechecking import Channel


class DataFrame(can.Message):
    """A data frame with an 11-bit identifier, nothing else; not to be changed once it is sent.

    A bus of python-can takes it as any message. Its virtual bus makes a deep copy for each receiver.
    """

    __slots__ = ()
    # What never differs is said once, of all of them.
    is_extended_id = is_remote_frame = is_error_frame = False
    is_fd = bitrate_switch = error_state_indicator = False

    def __init__(self, can_id: int, data: bytes | bytearray, channel: Channel | None = None) -> None:
        # What the base class makes of the same, without asking for what cannot be.
        self.arbitration_id = can_id
        self.data = bytearray(data)
        self.dlc = len(data)
        self.channel = channel
        self.timestamp = 0.0
        self.is_rx = True

    def __deepcopy__(self, memo: object) -> can.Message:
        return DataFrame(self.arbitration_id, self.data, self.channel)
