"""SDO server of a device (CiA 301): expedited, segmented and block transfers in both directions.

It does no I/O: the node passes eight data bytes and sends the returned answers.
"""

import struct
from binascii import crc_hqx
from enum import Enum, IntEnum
from typing import Final

from hdbridge.device.dictionary import MAX_STRING, Abort, Dictionary, Entry, SdoAbortError

_HEAD: Final = struct.Struct("<BHB")
_ABORT: Final = struct.Struct("<BHBI")
_TOGGLE: Final = 0x10


class _Client(IntEnum):
    """Client command specifiers, the upper three bits of a request."""

    DOWNLOAD_SEGMENT = 0
    DOWNLOAD = 1
    UPLOAD = 2
    UPLOAD_SEGMENT = 3
    ABORT = 4
    BLOCK_UPLOAD = 5
    BLOCK_DOWNLOAD = 6


class _Block(Enum):
    """Next step of a block transfer."""

    NONE = "none"
    SEGMENTS_IN = "segments of a download"
    END_IN = "end of a download"
    START_OUT = "start of an upload"
    ACKNOWLEDGE = "acknowledgement of a block of an upload"
    END_OUT = "end of an upload"


_MOST_SEGMENTS: Final = 127


class SdoServer:
    """SDO server for one client, with one transfer at a time."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self._entry: Entry | None = None
        self._buffer = b""
        self._uploading = False
        self._expected_size: int | None = None
        self._toggle = 0
        self._object = [0, 0]
        self._block = _Block.NONE
        self._block_size = _MOST_SEGMENTS
        self._sequence = 0
        """Number of segments of the current block received in order."""
        self._checks_crc = False
        self._sent = 0
        """Number of acknowledged bytes of a block upload."""

    def reset(self) -> None:
        """Discards the current transfer."""
        self._entry, self._block = None, _Block.NONE

    def respond(self, request: bytes) -> list[bytes]:
        """Returns the answers to a request of eight bytes."""
        if len(request) != 8:
            return []
        command = request[0]
        specifier = command >> 5
        try:
            if command == 0x80:
                self.reset()
                return []
            if self._block is _Block.SEGMENTS_IN:
                return self._take_segment(command, request)
            if specifier == _Client.BLOCK_DOWNLOAD:
                return [self._block_download(command, request)]
            if specifier == _Client.BLOCK_UPLOAD:
                return self._block_upload(command, request)
            self._block = _Block.NONE
            if specifier == _Client.UPLOAD:
                return [self._upload(self._open(request))]
            if specifier == _Client.DOWNLOAD:
                return [self._download(self._open(request), command, request[4:])]
            if specifier == _Client.UPLOAD_SEGMENT:
                return [self._upload_segment(command)]
            if specifier == _Client.DOWNLOAD_SEGMENT:
                return [self._download_segment(command, request)]
            if specifier == _Client.ABORT:
                self._entry = None
                return []
            _, *self._object = _HEAD.unpack_from(request)
            raise SdoAbortError(Abort.COMMAND)
        except SdoAbortError as abort:
            self.reset()
            return [_ABORT.pack(0x80, *self._object, abort.code)]

    def _open(self, request: bytes) -> Entry:
        """Opens the entry for a new transfer; discards an unfinished one, which the client has abandoned."""
        self._entry = None
        _, *self._object = _HEAD.unpack_from(request)
        return self._dictionary.open(self._object[0], self._object[1])

    def _upload(self, entry: Entry) -> bytes:
        data = entry.read()
        if 0 < len(data) <= 4:
            return _HEAD.pack(0x43 | (4 - len(data)) << 2, *self._object) + data.ljust(4, b"\0")
        self._begin(entry, uploading=True)
        self._buffer = data
        return _HEAD.pack(0x41, *self._object) + struct.pack("<I", len(data))

    def _upload_segment(self, command: int) -> bytes:
        self._check_segment(command, uploading=True)
        segment, self._buffer = self._buffer[:7], self._buffer[7:]
        answer = self._toggle | (7 - len(segment)) << 1 | (0 if self._buffer else 1)
        self._toggle ^= _TOGGLE
        if not self._buffer:
            self._entry = None
        return bytes([answer]) + segment.ljust(7, b"\0")

    def _download(self, entry: Entry, command: int, data: bytes) -> bytes:
        expedited, sized = command & 0x02, command & 0x01
        if expedited:
            own_size = entry.codec.size if entry.codec else 4
            size = 4 - (command >> 2 & 3) if sized else own_size
            entry.write(data[:size])
        else:
            self._begin_download(entry, struct.unpack("<I", data)[0] if sized else None)
        return _HEAD.pack(0x60, *self._object) + bytes(4)

    def _download_segment(self, command: int, request: bytes) -> bytes:
        entry = self._check_segment(command, uploading=False)
        self._buffer += request[1 : 8 - (command >> 1 & 7)]
        if len(self._buffer) > (MAX_STRING if self._expected_size is None else self._expected_size):
            raise SdoAbortError(Abort.TOO_LONG)
        if command & 1:
            if self._expected_size not in (None, len(self._buffer)):
                raise SdoAbortError(Abort.LENGTH)
            entry.write(self._buffer)
            self._entry = None
        answer = bytes([0x20 | self._toggle]) + bytes(7)
        self._toggle ^= _TOGGLE
        return answer

    # ---------------------------------------------------------------- block transfers

    def _block_download(self, command: int, request: bytes) -> bytes:
        if self._block is _Block.END_IN:
            return self._end_download(command, request)
        if command & 1:
            raise SdoAbortError(Abort.COMMAND)
        entry = self._open(request)
        self._begin_download(entry, struct.unpack_from("<I", request, 4)[0] if command & 2 else None)
        self._checks_crc = bool(command & 4)
        self._sequence, self._block = 0, _Block.SEGMENTS_IN
        return _HEAD.pack(0xA4, *self._object) + bytes((_MOST_SEGMENTS, 0, 0, 0))

    def _take_segment(self, command: int, request: bytes) -> list[bytes]:
        number, is_last = command & 0x7F, bool(command & 0x80)
        in_order = number == self._sequence + 1
        if in_order:
            self._sequence = number
            self._buffer += request[1:]
            most = MAX_STRING if self._expected_size is None else self._expected_size
            if len(self._buffer) >= most + 7:
                raise SdoAbortError(Abort.TOO_LONG)
        if not is_last and number < _MOST_SEGMENTS:
            return []
        answer = bytes((0xA2, self._sequence, _MOST_SEGMENTS)) + bytes(5)
        if is_last and in_order:
            self._block = _Block.END_IN
        self._sequence = 0
        return [answer]

    def _end_download(self, command: int, request: bytes) -> bytes:
        entry = self._entry
        if command & 0x03 != 1 or entry is None:
            raise SdoAbortError(Abort.COMMAND)
        data = self._buffer[: len(self._buffer) - (command >> 2 & 7)]
        if self._expected_size not in (None, len(data)):
            raise SdoAbortError(Abort.LENGTH)
        if self._checks_crc and crc_hqx(data, 0) != struct.unpack_from("<H", request, 1)[0]:
            raise SdoAbortError(Abort.CRC)
        entry.write(data)
        self.reset()
        return bytes((0xA1,)) + bytes(7)

    def _block_upload(self, command: int, request: bytes) -> list[bytes]:
        step = command & 0x03
        if step == 0:
            return [self._begin_block_upload(self._open(request), request[4])]
        if step == 3 and self._block is _Block.START_OUT:
            self._block = _Block.ACKNOWLEDGE
            return self._segments()
        if step == 2 and self._block is _Block.ACKNOWLEDGE:
            return self._acknowledged(request[1], request[2])
        if step == 1 and self._block is _Block.END_OUT:
            self.reset()
            return []
        raise SdoAbortError(Abort.COMMAND)

    def _begin_block_upload(self, entry: Entry, block_size: int) -> bytes:
        self._take_block_size(block_size)
        data = entry.read()
        self._begin(entry, uploading=True)
        self._buffer, self._sent = data, 0
        self._block = _Block.START_OUT
        return _HEAD.pack(0xC6, *self._object) + struct.pack("<I", len(data))

    def _take_block_size(self, size: int) -> None:
        if not 1 <= size <= _MOST_SEGMENTS:
            raise SdoAbortError(Abort.BLOCK_SIZE)
        self._block_size = size

    def _segments(self) -> list[bytes]:
        """Returns the segments of one block, starting at ``_sent``."""
        data, frames = self._buffer, []
        for number in range(1, self._block_size + 1):
            at = self._sent + 7 * (number - 1)
            is_last = at + 7 >= len(data)
            frames.append(bytes((number | 0x80 * is_last,)) + data[at : at + 7].ljust(7, b"\0"))
            if is_last:
                break
        self._sequence = len(frames)
        return frames

    def _acknowledged(self, number: int, block_size: int) -> list[bytes]:
        self._take_block_size(block_size)
        if number > self._sequence:
            raise SdoAbortError(Abort.SEQUENCE)
        self._sent += 7 * number
        data = self._buffer
        if self._sent < len(data) or (not data and number == 0):
            return self._segments()
        self._block = _Block.END_OUT
        empty = self._sent - len(data)
        return [struct.pack("<BH5x", 0xC1 | empty << 2, crc_hqx(data, 0))]

    def _begin_download(self, entry: Entry, size: int | None) -> None:
        self._expected_size = size
        if size is not None:
            entry.check_length(size)
        elif not entry.writable:
            raise SdoAbortError(Abort.READ_ONLY)
        self._begin(entry, uploading=False)

    def _begin(self, entry: Entry, *, uploading: bool) -> None:
        self._entry, self._uploading, self._buffer, self._toggle = entry, uploading, b"", 0

    def _check_segment(self, command: int, *, uploading: bool) -> Entry:
        if self._entry is None or self._uploading is not uploading:
            raise SdoAbortError(Abort.COMMAND)
        if command & _TOGGLE != self._toggle:
            raise SdoAbortError(Abort.TOGGLE)
        return self._entry
