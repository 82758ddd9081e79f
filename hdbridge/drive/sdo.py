"""SDO client that reads and writes a node's objects in the caller's thread.

The SDO protocol is that of `canopen`; only its method of waiting is replaced. canopen's client needs a
notifier thread that feeds a queue and terminates for good when the interface goes down. Here, the caller's
thread receives until the answer arrives or a deadline on the given clock passes, and hands every other frame
to the network monitor. The client also retries whole transfers, limits the size of an answer, checks every
answer's length, and raises errors with advice.

It must not be used in the control cycle.
"""

import logging
import struct
from collections.abc import Callable, Iterable
from typing import Final

from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.client import SdoClient as CanopenSdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from hdbridge.drive.dictionary import find, integer_type
from hdbridge.drive.link import Frame, Link
from hdbridge.drive.monitor import NetworkMonitor
from hdbridge.drive.objects import COB_SDO_ANSWER, COB_SDO_REQUEST, STANDARD, Address, IntegerType
from hdbridge.errors import RESET, InputError, SdoError

_log = logging.getLogger(__name__)
DEFAULT_TIMEOUT_S: Final = 0.5
DEFAULT_ATTEMPTS: Final = 3
SIZE_CAP: Final = 4096
"""Maximum length of an object, bytes; the longest objects read are names and versions."""
_TIMEOUTS_PER_TRANSFER: Final = 20
_FRAME_BYTES: Final = 8
_ABORT: Final = 0x80
_ABORT_TIMED_OUT: Final = 0x0504_0000
_ABORT_OUT_OF_MEMORY: Final = 0x0504_0005
_HEADER: Final = struct.Struct("<BHB")

_ADVICE: Final = {
    0x0601_0000: "the drive does not support this access",
    0x0601_0002: "the object is read-only on this drive",
    0x0602_0000: "the drive does not have the object: check that drive.eds is the EDS of this drive",
    0x0604_0041: "the drive cannot map it to a PDO: choose another object",
    0x0604_0042: "the mapped objects do not fit the PDO",
    0x0609_0011: "the drive does not have this sub-index: check that drive.eds is the EDS of this drive",
    0x0609_0030: "the drive refuses the value: change it in the axis file",
    0x0609_0031: "the drive refuses the value as too high: lower it in the axis file",
    0x0609_0032: "the drive refuses the value as too low: raise it in the axis file",
    0x0800_0021: "another controller holds the drive (local or fieldbus): release it there",
    0x0800_0022: f"the drive refuses in its present state: disable it, or reset its fault: {RESET}",
}


ABSENT: Final = frozenset({0x0602_0000, 0x0609_0011})
"""Abort codes of a missing object."""


class SdoAbortError(SdoError):
    """The node refused with an abort code, which also proves that it is present."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class _NoAnswerError(SdoCommunicationError):
    """The node did not answer in time."""


class _Channel(CanopenSdoClient):
    """canopen's SDO protocol, with reception in the caller's thread."""

    def __init__(self, link: Link, monitor: NetworkMonitor, node_id: int, od: ObjectDictionary) -> None:
        super().__init__(COB_SDO_REQUEST + node_id, COB_SDO_ANSWER + node_id, od)  # type: ignore[no-untyped-call]
        self.link = link
        self.recv: Callable[[float], Frame | None] = link.recv
        self.monitor = monitor
        self.timeout_s = DEFAULT_TIMEOUT_S
        self.transfer_ends_s = 0.0
        """Deadline of the whole transfer, because a node could answer every segment in time but never end the
        transfer."""
        self.unsolicited_answers = 0

    def send_request(self, request: bytes | bytearray) -> None:
        self.link.send(self.rx_cobid, bytes(request))

    def abort(self, abort_code: int = 0x0800_0000) -> None:
        self.send_request(struct.pack("<BHBL", _ABORT, 0, 0, abort_code))

    def request_response(self, sdo_request: bytes | bytearray) -> bytes:
        for stale in self.link.drain():
            self._set_aside(stale)
        command, index, sub = _HEADER.unpack_from(sdo_request)
        initiates = command >> 5 in (1, 2)
        self.send_request(sdo_request)
        deadline_s = min(self.link.now() + self.timeout_s, self.transfer_ends_s)
        # The second condition ends the wait on a bus that is never idle.
        while (frame := self.recv(deadline_s)) is not None and frame.time_s <= deadline_s:
            if frame.can_id != self.tx_cobid:
                self._set_aside(frame)
                continue
            answer = frame.data
            if len(answer) != _FRAME_BYTES:
                self.abort()
                raise SdoCommunicationError(f"the answer has {len(answer)} bytes instead of {_FRAME_BYTES}")
            if initiates and _HEADER.unpack_from(answer)[1:] != (index, sub):
                self._set_aside(frame)
                continue
            if answer[0] == _ABORT:
                raise SdoAbortedError(int.from_bytes(answer[4:], "little"))
            return answer
        self.abort(_ABORT_TIMED_OUT)
        raise _NoAnswerError(f"no answer within {self.timeout_s:g} s")

    def _set_aside(self, frame: Frame) -> None:
        if frame.can_id == self.tx_cobid:
            # A delayed answer to an earlier request, or an answer to another client.
            self.unsolicited_answers += 1
        else:
            self.monitor.dispatch(frame)

    def fetch(self, index: int, sub: int, cap: int) -> bytes:
        with self.open(index, sub, buffering=0) as stream:  # type: ignore[no-untyped-call]
            announced = stream.size
            data = bytearray()
            self._check_size(announced or 0, cap)
            while chunk := stream.read(7):
                data += chunk
                self._check_size(len(data), cap)
            if not stream._done:
                self.abort()
                raise SdoCommunicationError("the node sends empty segments without an end")
        if announced is not None and len(data) != announced:
            raise SdoCommunicationError(f"the node announced {announced} bytes and sent {len(data)}")
        return bytes(data)

    def _check_size(self, size: int, cap: int) -> None:
        if size > cap:
            self.abort(_ABORT_OUT_OF_MEMORY)
            raise SdoCommunicationError(f"the node sends more than the {cap} bytes that are taken")


class SdoClient:
    """Reads and writes the objects of one node. Not thread-safe; not for the control cycle.

    ``od`` is the node's object dictionary; None if the types of CiA 301 and CiA 402 suffice. ``recv`` is used
    in place of `Link.recv`.
    """

    def __init__(
        self,
        link: Link,
        monitor: NetworkMonitor,
        node_id: int,
        od: ObjectDictionary | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        attempts: int = DEFAULT_ATTEMPTS,
        recv: Callable[[float], Frame | None] | None = None,
    ) -> None:
        self.node_id = node_id
        self.od = ObjectDictionary() if od is None else od  # type: ignore[no-untyped-call]
        self.attempts = attempts
        self._channel = _Channel(link, monitor, node_id, self.od)
        self._channel.timeout_s = timeout_s
        self.recv = self._channel.recv = recv if recv is not None else link.recv

    @property
    def unsolicited_answers(self) -> int:
        """Number of unsolicited SDO answers: delayed ones, or answers to another client."""
        return self._channel.unsolicited_answers

    def has(self, index: int, sub: int = 0) -> bool:
        """Returns True if the EDS lists the object."""
        return find(self.od, index, sub) is not None

    def type_of(self, index: int, sub: int) -> IntegerType:
        """Returns an object's integer type by the EDS, else by the profile, else raises `SdoError`."""
        variable = find(self.od, index, sub)
        if variable is not None:
            kind = integer_type(variable)
            if kind is None:
                raise SdoError(
                    f"{self.describe(index, sub)}: is not an integer in the EDS (type {variable.data_type}h)"
                )
            return kind
        known = STANDARD.get((index, sub))
        if known is None:
            raise SdoError(
                f"{self.describe(index, sub)}: is in neither the EDS nor the profile; check drive.eds"
            )
        return known.type

    def describe(self, index: int, sub: int) -> str:
        """Describes an object, for example ``node 1, object 607Ah:00 'Target position'``.

        The name is that in the EDS, else that in the profile.
        """
        name = ""
        variable = find(self.od, index, sub)
        if variable is not None:
            name = variable.qualname
        elif (index, sub) in STANDARD:
            name = STANDARD[index, sub].name
        return f"node {self.node_id}, object {index:04X}h:{sub:02X}" + (f" '{name}'" if name else "")

    def read(self, index: int, sub: int = 0, type: IntegerType | None = None) -> int:  # noqa: A002
        """Reads an integer object; raises `SdoError` if that fails or the length is wrong."""
        kind = type or self.type_of(index, sub)
        data = self.read_bytes(index, sub)
        size = kind.bits // 8
        if len(data) < size or (len(data) > size and not self._is_extension(data, size, kind)):
            raise SdoError(
                f"{self.describe(index, sub)}: answered {len(data)} bytes, but {kind.value} has {size}; "
                "check that drive.eds is the EDS of this drive"
            )
        return kind.decode(data[:size])

    def write(
        self,
        index: int,
        sub: int,
        value: int,
        type: IntegerType | None = None,  # noqa: A002
        attempts: int | None = None,
    ) -> None:
        """Writes an integer object; raises `InputError` for a value out of range, `SdoError` on refusal.

        ``attempts`` replaces those of the client.
        """
        kind = type or self.type_of(index, sub)
        if not isinstance(value, int) or not kind.minimum <= value <= kind.maximum:
            raise InputError(
                f"{self.describe(index, sub)}: {value!r} is not an integer in "
                f"[{kind.minimum}, {kind.maximum}] ({kind.value}); nothing was written"
            )
        self._transfer("write", index, sub, kind.encode(value), attempts)

    def fetch(self, address: Address) -> int:
        return self.read(address.index, address.sub)

    def fetch_listed(self, addresses: Iterable[Address]) -> dict[Address, int]:
        """Reads the objects that the EDS lists."""
        return {each: self.fetch(each) for each in addresses if self.has(each.index, each.sub)}

    def store(self, address: Address, value: int, attempts: int | None = None) -> None:
        self.write(address.index, address.sub, value, attempts=attempts)

    def read_text(self, index: int) -> str:
        """Reads a string object; characters outside ASCII become question marks."""
        return (
            self.read_bytes(index, 0).decode("ascii", errors="replace").rstrip("\x00 ").replace("\ufffd", "?")
        )

    def read_bytes(self, index: int, sub: int) -> bytes:
        """Reads an object's raw bytes, at most `SIZE_CAP`; four for an expedited answer without a size."""
        return self._transfer("read", index, sub, None)

    def write_bytes(self, index: int, sub: int, data: bytes) -> None:
        """Writes raw bytes: up to four expedited, more segmented."""
        self._transfer("write", index, sub, data)

    def _transfer(
        self, doing: str, index: int, sub: int, data: bytes | None, attempts: int | None = None
    ) -> bytes:
        problem, attempts = "no attempt was made", attempts or self.attempts
        for _ in range(attempts):
            self._channel.transfer_ends_s = (
                self._channel.link.now() + _TIMEOUTS_PER_TRANSFER * self._channel.timeout_s
            )
            try:
                if data is None:
                    answer = self._channel.fetch(index, sub, SIZE_CAP)
                    self._log("sdo read", index, sub, data=answer.hex(" "))
                    return answer
                self._channel.download(index, sub, data)
                self._log("sdo write", index, sub, data=data.hex(" "))
            except SdoAbortedError as error:
                self._log(f"sdo {doing} refused", index, sub, abort=f"{error.code:08X}h")
                advice = _ADVICE.get(error.code, "see the drive's manual for this code")
                text = SdoAbortedError.CODES.get(error.code, "vendor-specific")
                raise SdoAbortError(
                    f"{self.describe(index, sub)}: {doing} refused with abort code "
                    f"{error.code:08X}h ({text}); {advice}",
                    error.code,
                ) from error
            except _NoAnswerError as error:
                problem = f"{error}; check that the node is powered and its node id and bit rate are right"
                self._log(f"sdo {doing} failed", index, sub, problem=str(error))
            except SdoCommunicationError as error:
                problem = f"{error}; check that no second SDO client is active"
                self._log(f"sdo {doing} failed", index, sub, problem=str(error))
            else:
                return b""
        times = f"{attempts} attempts" if attempts != 1 else "one attempt"
        raise SdoError(f"{self.describe(index, sub)}: {doing} failed after {times}: {problem}")

    def _log(self, event: str, index: int, sub: int, **facts: object) -> None:
        _log.debug(event, {"node": self.node_id, "object": f"{index:04X}h:{sub:02X}", **facts})

    @staticmethod
    def _is_extension(data: bytes, size: int, kind: IntegerType) -> bool:
        # Some drives answer every object with four bytes, which is harmless if the rest repeats the sign.
        fill = 0xFF if kind.signed and data[size - 1] & 0x80 else 0
        return len(data) <= 4 and all(byte in (fill, 0) for byte in data[size:])
