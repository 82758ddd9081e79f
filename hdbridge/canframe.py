"""CAN message of the control cycle, cheap to create and to copy, for both ends of the bus."""

import can
from can.typechecking import Channel


class DataFrame(can.Message):
    """Data frame with an 11-bit identifier; must not be modified after sending.

    A python-can bus accepts it like any message. Its deep copy is cheap, because python-can's virtual bus
    makes one for each receiver.
    """

    __slots__ = ()
    # Constant attributes are stored once, in the class.
    is_extended_id = is_remote_frame = is_error_frame = False
    is_fd = bitrate_switch = error_state_indicator = False

    def __init__(self, can_id: int, data: bytes | bytearray, channel: Channel | None = None) -> None:
        # Sets the same attributes as the base class, without its checks.
        self.arbitration_id = can_id
        self.data = bytearray(data)
        self.dlc = len(data)
        self.channel = channel
        self.timestamp = 0.0
        self.is_rx = True

    def __deepcopy__(self, memo: object) -> can.Message:
        return DataFrame(self.arbitration_id, self.data, self.channel)
