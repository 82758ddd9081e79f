"""Data frames that are cheap to send."""

from __future__ import annotations

import can


def frame(can_id: int, data: bytes) -> can.Message:
    """An 11-bit data frame.

    Its data stay ``bytes``: a virtual bus copies a message deeply for each receiver, which takes 8 us longer
    with the ``bytearray`` that python-can makes of them. Every back end takes either.
    """
    message = can.Message(arbitration_id=can_id, is_extended_id=False, dlc=len(data))
    message.data = data  # type: ignore[assignment]
    return message
