"""Master of raw frames, independent of the package's own master and of any CANopen library."""

import struct
from typing import Any

import can


class FrameMaster:
    """Writes and reads frames as bytes. Time passes only in `wait`."""

    def __init__(self, bus: can.BusABC, clock: Any, node_id: int = 1) -> None:
        self.bus, self.clock, self.node_id = bus, clock, node_id
        self.seen: list[tuple[int, bytes]] = []
        """All received frames: identifier and data."""

    # frames

    def send(self, can_id: int, data: bytes = b"") -> None:
        self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def messages(self) -> list[can.Message]:
        """Returns all received messages without waiting."""
        found = []
        while (message := self.bus.recv(0)) is not None:
            found.append(message)
        self.seen += [(each.arbitration_id, bytes(each.data)) for each in found]
        return found

    def take(self) -> list[tuple[int, bytes]]:
        """Returns identifier and data of all received frames without waiting."""
        return [(each.arbitration_id, bytes(each.data)) for each in self.messages()]

    def wait(self, seconds: float) -> list[tuple[int, bytes]]:
        self.clock.sleep_until(self.clock.now() + seconds)
        return self.take()

    def nmt(self, command: int, node_id: int | None = None) -> None:
        self.send(0x000, bytes([command, self.node_id if node_id is None else node_id]))

    # SDO

    def request(self, data: bytes) -> bytes:
        """Sends an SDO request of eight bytes and returns its answer."""
        (answer,) = self.requests(data)
        return answer

    def requests(self, data: bytes) -> list[bytes]:
        """Sends an SDO request of eight bytes and returns all its answers."""
        self.take()
        self.send(0x600 + self.node_id, data)
        return [data for can_id, data in self.take() if can_id == 0x580 + self.node_id]

    def write(self, index: int, sub: int, value: int, size: int) -> int:
        """Expedited download; returns the abort code, 0 for success."""
        raw = (value & (1 << 8 * size) - 1).to_bytes(size, "little").ljust(4, b"\0")
        answer = self.request(struct.pack("<BHB", 0x23 | (4 - size) << 2, index, sub) + raw)
        assert answer[1:4] == struct.pack("<HB", index, sub)
        if answer[0] == 0x80:
            return struct.unpack_from("<I", answer, 4)[0]
        assert answer[0] == 0x60
        return 0

    def put(self, index: int, sub: int, value: int, size: int) -> None:
        abort = self.write(index, sub, value, size)
        assert abort == 0, f"{index:04X}h:{sub:02X} := {value} aborted with {abort:08X}h"

    def read(self, index: int, sub: int = 0) -> int:
        """Expedited upload of a signed number of the object's width."""
        answer = self.request(struct.pack("<BHBI", 0x40, index, sub, 0))
        assert answer[0] & 0xE3 == 0x43, answer.hex()
        return int.from_bytes(answer[4 : 8 - (answer[0] >> 2 & 3)], "little", signed=True)

    def abort_of_read(self, index: int, sub: int = 0) -> int:
        """Returns the abort code of an upload, 0 for success."""
        answer = self.request(struct.pack("<BHBI", 0x40, index, sub, 0))
        return struct.unpack_from("<I", answer, 4)[0] if answer[0] == 0x80 else 0

    def map(self, first: int, number: int, can_id: int, *words: int, kind: int = 1) -> None:
        """Maps a PDO by the sequence of CiA 301, and leaves it disabled without ``words``.

        ``first`` is 1800h for TPDOs and 1400h for RPDOs.
        """
        communication, mapping = first + number - 1, first + 0x200 + number - 1
        self.put(communication, 1, can_id | 0x8000_0000, 4)
        self.put(mapping, 0, 0, 1)
        for sub, word in enumerate(words, 1):
            self.put(mapping, sub, word, 4)
        self.put(mapping, 0, len(words), 1)
        self.put(communication, 2, kind, 1)
        if words:
            self.put(communication, 1, can_id, 4)
