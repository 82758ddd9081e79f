"""The SDO server of the simulated drive (CiA 301): expedited and segmented transfers in both directions.

Bytes in, bytes out: the node passes eight data bytes and sends what comes back. Block transfers are refused.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Final

from hdbridge.device.dictionary import MAX_STRING, Abort, Dictionary, Entry, SdoAbortError

_HEAD: Final = struct.Struct("<BHB")
_ABORT: Final = struct.Struct("<BHBI")
_TOGGLE: Final = 0x10


class _Client(IntEnum):
    """Client command specifiers: the upper three bits of a request."""

    DOWNLOAD_SEGMENT = 0
    DOWNLOAD = 1
    UPLOAD = 2
    UPLOAD_SEGMENT = 3
    ABORT = 4


class SdoServer:
    """One transfer at a time, as one client needs it."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self._entry: Entry | None = None
        self._buffer = b""
        self._uploading = False
        self._expected_size: int | None = None
        self._toggle = 0
        self._object = [0, 0]

    def reset(self) -> None:
        """Forget a transfer that has begun."""
        self._entry = None

    def respond(self, request: bytes) -> bytes | None:
        """The answer to a request of eight bytes, or None where none is due."""
        if len(request) != 8:
            return None
        command = request[0]
        specifier = command >> 5
        try:
            if specifier == _Client.UPLOAD:
                return self._upload(self._open(request))
            if specifier == _Client.DOWNLOAD:
                return self._download(self._open(request), command, request[4:])
            if specifier == _Client.UPLOAD_SEGMENT:
                return self._upload_segment(command)
            if specifier == _Client.DOWNLOAD_SEGMENT:
                return self._download_segment(command, request)
            if specifier == _Client.ABORT:
                self._entry = None
                return None
            _, *self._object = _HEAD.unpack_from(request)
            raise SdoAbortError(Abort.COMMAND)
        except SdoAbortError as abort:
            self._entry = None
            return _ABORT.pack(0x80, *self._object, abort.code)

    def _open(self, request: bytes) -> Entry:
        """Begin a transfer; one that was under way is forgotten, as the client evidently has."""
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
            self._expected_size = struct.unpack("<I", data)[0] if sized else None
            if self._expected_size is not None:
                entry.check_length(self._expected_size)
            elif not entry.writable:
                raise SdoAbortError(Abort.READ_ONLY)
            self._begin(entry, uploading=False)
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

    def _begin(self, entry: Entry, *, uploading: bool) -> None:
        self._entry, self._uploading, self._buffer, self._toggle = entry, uploading, b"", 0

    def _check_segment(self, command: int, *, uploading: bool) -> Entry:
        if self._entry is None or self._uploading is not uploading:
            raise SdoAbortError(Abort.COMMAND)
        if command & _TOGGLE != self._toggle:
            raise SdoAbortError(Abort.TOGGLE)
        return self._entry
