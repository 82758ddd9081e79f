"""Checks of SDO: expedited, segmented and block transfers, and requests that a server must refuse."""

import struct
from binascii import crc_hqx
from collections.abc import Callable
from functools import partial
from typing import Final

from canopen.objectdictionary import datatypes

from hdbridge.cia301 import NmtCommand
from hdbridge.conformance.steps import aborts, parametrised, refuses, sends_nmt, waits
from hdbridge.conformance.tester import (
    ABSENT,
    COMMAND,
    LENGTH,
    RANGE,
    READ_ONLY,
    WRITE_ONLY,
    NodeTester,
    NotApplicableError,
    Step,
    Table,
    abort,
    abort_code,
    expedited,
    segmented,
    upload_request,
)

CHECKS: Final = Table()
check: Final = CHECKS.check
_SDO: Final = "CiA 301, 7.2.4"
_TOGGLE: Final = (0x05030000,)
_TEXTS: Final = (0x1008, 0x100A, 0x1009)
_STRINGS: Final = (datatypes.VISIBLE_STRING, datatypes.OCTET_STRING, datatypes.DOMAIN)
_NOWHERE: Final = 0x1F7F
"""Index that no device has, reserved for CiA 302 masters."""


def _mux(index: int, sub: int) -> bytes:
    return struct.pack("<HB", index, sub)


def _text(t: NodeTester) -> tuple[int, bytes]:
    """Returns a string of more than four bytes and its index."""
    for index in _TEXTS:
        if t.has(index) and len(data := t.upload(index)) > 4:
            return index, data
    raise NotApplicableError("no string of more than four bytes (1008h, 1009h, 100Ah)")


def _writable_text(t: NodeTester) -> tuple[int, int]:
    """Returns index and sub-index of a writable string of the EDS."""
    for each in t.variables():
        if each.data_type in _STRINGS and each.access_type in ("rw", "rww", "rwr") and each.index != 0x1F50:
            return each.index, each.subindex
    raise NotApplicableError("the EDS names no writable string")


def _segment(t: NodeTester, command: int, data: bytes = b"") -> bytes:
    return t.answer(bytes((command,)) + data.ljust(7, b"\0"))


def _open_upload(t: NodeTester) -> tuple[int, bytes]:
    """Begins a segmented upload; returns the index and the complete data."""
    index, data = _text(t)
    answer = t.answer(upload_request(index))
    t.equal(answer[0] & 0xE2, 0x40, "command of the response without the size bit")
    return index, data


def _number(t: NodeTester) -> tuple[int, int, int]:
    """Returns a writable object of two bytes or more: index, sub-index, size."""
    if t.has(0x1017):
        return 0x1017, 0, 2
    index, sub, bits = t.scratch()
    t.need(bits >= 16, "no writable object of two bytes")
    return index, sub, bits // 8


# ---------------------------------------------------------------- upload


@parametrised
def _is_expedited(t: NodeTester, index: int, size: int) -> None:
    expected = bytes((0x43 | (4 - size) << 2,)) + _mux(index, 0)
    t.equal(t.answer(upload_request(index))[:4], expected, "command and multiplexer")


@parametrised
def _answers(
    t: NodeTester, duration_s: float, expected: int, send: Callable[[NodeTester, bytes], object]
) -> None:
    """A request that ``send`` sends has this number of answers."""
    answers = t.heard_after(0x580 + t.node_id, duration_s, lambda: send(t, upload_request(0x1000)))
    t.equal(len(answers), expected, "number of answers")


@parametrised
def _repeats(t: NodeTester, count: int, act: Step = lambda _: None) -> None:
    """Repeated uploads of 1000h, each after ``act``, return the same value."""
    first = t.upload(0x1000)
    for _ in range(count):
        act(t)
        t.equal(t.upload(0x1000), first, "1000h")


def _is_usual(t: NodeTester) -> None:
    t.equal(len(t.upload(0x1000)), 4, "size of 1000h")


CHECKS.rows(
    _SDO,
    *((f"sdo.upload.{size}", f"{index:04X}h is uploaded expedited, with its size in bytes, {size}", index,
       _is_expedited(index, size)) for index, size in ((0x1000, 4), (0x1001, 1), (0x1017, 2))),
    ("sdo.answer.length", "An answer has eight bytes", lambda t: t.answer(upload_request(0x1000))),
    ("sdo.answer.once", "A request has one answer", _answers(0.05, 1, NodeTester.answer)),
    ("sdo.answer.time", "50 uploads in a row are answered in time", _repeats(50)),
    ("sdo.operational", "SDO works during PDO traffic", sends_nmt(NmtCommand.START),
     _repeats(10, NodeTester.sync)),
    ("sdo.other-node", "Requests to another node are not answered",
     _answers(0.1, 0, lambda t, data: t.send(0x600 + t.node_id % 127 + 1, data))),
    ("sdo.extended", "Requests with a 29-bit identifier are not answered",
     _answers(0.1, 0, lambda t, data: t.send_special(0x600 + t.node_id, data))),
    ("sdo.short", "A request of fewer than eight bytes disturbs nothing",
     lambda t: t.ask(b"\x40\0\x10", 0.05), _is_usual),
)  # fmt: skip


@check("sdo.upload.segmented", "A long string is uploaded in segments, with its size", _SDO)
def _(t: NodeTester) -> None:
    index, data = _text(t)
    answer = t.answer(upload_request(index))
    t.equal(answer[0], 0x41, "command")
    t.equal(struct.unpack_from("<I", answer, 4)[0], len(data), "announced size")


@check("sdo.upload.segmented.toggle", "The toggle bit of upload segments alternates from 0", _SDO)
def _(t: NodeTester) -> None:
    _, data = _open_upload(t)
    for place in range((len(data) + 6) // 7):
        toggle = (place & 1) << 4
        t.equal(_segment(t, 0x60 | toggle)[0] & 0x10, toggle, "toggle bit")


@check(
    "sdo.upload.segmented.last",
    "Only the last segment has bit c set, and n is the number of its unused bytes",
    _SDO,
)
def _(t: NodeTester) -> None:
    _, data = _open_upload(t)
    count = (len(data) + 6) // 7
    for place in range(count):
        answer = _segment(t, 0x60 | (place & 1) << 4)
        last = place == count - 1
        t.equal(answer[0] & 1, int(last), f"bit c of segment {place + 1} of {count}")
        t.equal(7 - (answer[0] >> 1 & 7), len(data) - 7 * place if last else 7, "bytes in the segment")


def _is_served(t: NodeTester) -> None:
    """Fails unless a request is answered; repeats the request if the first one only ends an old transfer."""
    answer = t.ask(upload_request(0x1000))
    if answer is None or answer[0] == 0x80:
        answer = t.answer(upload_request(0x1000))
    t.equal(answer[:4], b"\x43" + _mux(0x1000, 0), "response")


def _cancel(t: NodeTester) -> None:
    """Ends any transfer."""
    t.ask(abort(), 0.02)


def _abort_upload(t: NodeTester) -> None:
    index, _ = _open_upload(t)
    t.equal(t.ask(abort(index, 0), 0.05), None, "answer to the abort")


CHECKS.rows(
    _SDO,
    ("sdo.upload.toggle-error", "A wrong toggle bit in an upload causes abort 05030000h", _open_upload,
     aborts(b"\x70" + bytes(7), _TOGGLE, "segment with the wrong toggle bit")),
    ("sdo.upload.after-abort", "After an abort the transfer has ended", _open_upload,
     lambda t: _segment(t, 0x70), aborts(b"\x60" + bytes(7), COMMAND, "segment after the abort")),
    ("sdo.upload.no-initiate", "An upload segment without initiation causes abort 05040001h", _cancel,
     aborts(b"\x60" + bytes(7), COMMAND, "segment without initiation")),
    ("sdo.upload.client-abort", "An abort by the client is not answered and ends the transfer", _abort_upload,
     aborts(b"\x60" + bytes(7), COMMAND, "segment after the abort")),
    ("sdo.upload.restart", "A new request is served after an unfinished transfer", _open_upload,
     lambda t: _segment(t, 0x60), _is_served),
    ("sdo.upload.abandoned", "A transfer abandoned a second ago blocks nothing", _open_upload,
     waits(1.0), _is_served),
)  # fmt: skip


# ---------------------------------------------------------------- refusals


def _write_only(t: NodeTester) -> bytes:
    for each in t.variables():
        if each.access_type == "wo":
            return upload_request(each.index, each.subindex)
    raise NotApplicableError("the EDS names no write-only object")


def _too_long(t: NodeTester) -> bytes:
    index, sub, size = _number(t)
    t.need(size < 4, "the writable object has four bytes already")
    return expedited(index, sub, bytes(4))


def _too_short(t: NodeTester) -> bytes:
    index, sub, size = _number(t)
    return expedited(index, sub, bytes(size - 1))


CHECKS.rows(
    _SDO,
    ("sdo.abort.no-object.upload", "Upload of a missing object is refused with abort 06020000h",
     aborts(upload_request(_NOWHERE), ABSENT[:1])),
    ("sdo.abort.no-object.download", "Download to a missing object is refused with abort 06020000h",
     aborts(expedited(_NOWHERE, 0, b"\0"), ABSENT[:1])),
    ("sdo.abort.no-sub.upload", "Upload of a missing sub-index is refused with abort 06090011h",
     aborts(upload_request(0x1018, 200), ABSENT[1:])),
    ("sdo.abort.no-sub.download", "Download to a missing sub-index is refused with abort 06090011h",
     aborts(expedited(0x1018, 200, bytes(4)), ABSENT[1:])),
    ("sdo.abort.read-only", "Download to a read-only object is refused with abort 06010002h",
     aborts(expedited(0x1000, 0, bytes(4)), READ_ONLY)),
    ("sdo.abort.const", "Download to sub-index 0 of 1018h is refused with abort 06010002h",
     aborts(expedited(0x1018, 0, b"\x04"), READ_ONLY)),
    ("sdo.abort.write-only", "Upload of a write-only object is refused with abort 06010001h",
     lambda t: t.aborts(_write_only(t), WRITE_ONLY)),
    ("sdo.abort.too-long", "A download of too many bytes is refused with abort 06070010h or 06070012h",
     lambda t: t.aborts(_too_long(t), LENGTH)),
    ("sdo.abort.too-short", "A download of too few bytes is refused with abort 06070010h or 06070013h",
     lambda t: t.aborts(_too_short(t), LENGTH)),
    ("sdo.abort.command", "An unknown command specifier causes abort 05040001h",
     aborts(b"\xe0\0\x10\0" + bytes(4), COMMAND)),
    ("sdo.abort.long-segmented", "A segmented download of too many bytes is refused at its start",
     aborts(segmented(0x1017, 0, 9), LENGTH)),
    ("sdo.abort.multiplexer", "An abort names the object",
     lambda t: t.equal(t.answer(upload_request(_NOWHERE, 3))[:4], b"\x80" + _mux(_NOWHERE, 3),
                       "command and multiplexer")),
    ("sdo.abort.next", "A refused request does not disturb the next one",
     lambda t: t.refuses(upload_request(_NOWHERE), "upload of a missing object"), _is_usual),
)  # fmt: skip


@check("sdo.abort.value", "A refused value is not stored", _SDO)
def _(t: NodeTester) -> None:
    index, sub, size = _number(t)
    before = t.upload(index, sub)
    t.refuses(expedited(index, sub, b"\x01" * (size - 1)), "download with a byte too few")
    t.equal(t.upload(index, sub), before, f"{index:04X}h")


# ---------------------------------------------------------------- download


@parametrised
def _downloads(t: NodeTester, request: Callable[[int, int, bytes], list[bytes]]) -> None:
    """The requests of ``request`` write a different value, which is read back; the old one is restored."""
    index, sub, size = _number(t)
    before = t.upload(index, sub)
    value = ((int.from_bytes(before, "little") + 100) & 0x7FFF).to_bytes(size, "little")
    for place, each in enumerate(request(index, sub, value)):
        answer = t.answer(each)
        t.true(answer[0] != 0x80, f"request {place + 1}: {answer.hex(' ')}", "the download is carried out")
    found = t.upload(index, sub)
    t.download(index, sub, before)
    t.equal(found, value, f"{index:04X}h")


def _last_segment(data: bytes) -> bytes:
    return bytes(((7 - len(data)) << 1 | 1,)) + data.ljust(7, b"\0")


CHECKS.rows(
    _SDO,
    ("sdo.download.expedited", "An expedited download with its size is carried out",
     _downloads(lambda index, sub, data: [expedited(index, sub, data)])),
    ("sdo.download.expedited.no-size", "An expedited download without a size is carried out",
     _downloads(lambda index, sub, data: [b"\x22" + _mux(index, sub) + data.ljust(4, b"\0")])),
    ("sdo.download.segmented", "A number may be sent in a segment",
     _downloads(lambda index, sub, data: [segmented(index, sub, len(data)), _last_segment(data)])),
    ("sdo.download.segmented.no-size", "A segmented download without a size is carried out",
     _downloads(lambda index, sub, data: [b"\x20" + _mux(index, sub) + bytes(4), _last_segment(data)])),
    ("sdo.download.segmented.toggle-error", "A wrong toggle bit in a download causes abort 05030000h",
     lambda t: t.answer(segmented(*_number(t))),
     aborts(b"\x1b" + bytes(7), _TOGGLE, "segment with the wrong toggle bit")),
    ("sdo.download.no-initiate", "A download segment without initiation causes abort 05040001h", _cancel,
     aborts(b"\x01" + bytes(7), COMMAND, "segment without initiation")),
)  # fmt: skip


@check("sdo.download.response", "The response to a download is 60h with the multiplexer and zeros", _SDO)
def _(t: NodeTester) -> None:
    index, sub, _ = _number(t)
    answer = t.answer(expedited(index, sub, t.upload(index, sub)))
    t.equal(answer, b"\x60" + _mux(index, sub) + bytes(4), "response")


@check(
    "sdo.download.segmented.size", "Segments whose total differs from the announced size are refused", _SDO
)
def _(t: NodeTester) -> None:
    index, sub, size = _number(t)
    t.need(size >= 2, "the writable object has one byte")
    before = t.upload(index, sub)
    answer = t.answer(segmented(index, sub, size))
    t.equal(answer[0], 0x60, "response to the initiation")
    t.refuses(bytes(((7 - size + 1) << 1 | 1,)) + bytes(7), "a byte too few")
    t.equal(t.upload(index, sub), before, f"{index:04X}h")


@check("sdo.download.client-abort", "A download aborted by the client changes nothing", _SDO)
def _(t: NodeTester) -> None:
    index, sub, size = _number(t)
    before = t.upload(index, sub)
    t.answer(segmented(index, sub, size))
    t.equal(t.ask(abort(index, sub), 0.05), None, "answer to the abort")
    t.equal(t.upload(index, sub), before, f"{index:04X}h")


@check("sdo.download.text", "A string is downloaded in several segments", _SDO)
def _(t: NodeTester) -> None:
    index, sub = _writable_text(t)
    before = t.upload(index, sub)
    t.download(index, sub, b"conformance test")
    found = t.upload(index, sub)
    t.download(index, sub, before or b" ")
    t.equal(found, b"conformance test", f"{index:04X}h:{sub:02X}")


@check("sdo.download.text.toggle", "The toggle bit of download responses alternates from 0", _SDO)
def _(t: NodeTester) -> None:
    index, sub = _writable_text(t)
    before = t.upload(index, sub)
    t.answer(segmented(index, sub, 14))
    answers = [_segment(t, 0x00, b"ABCDEFG"), _segment(t, 0x11, b"HIJKLMN")]
    t.download(index, sub, before or b" ")
    t.equal([answer[0] for answer in answers], [0x20, 0x30], "commands")


# ---------------------------------------------------------------- block transfers


def _block_request(index: int, size: int = 127) -> bytes:
    """Returns the request of a block upload with blocks of ``size`` segments."""
    return b"\xa4" + _mux(index, 0) + bytes((size, 0, 0, 0))


def _need_block_transfers(t: NodeTester, answer: bytes) -> None:
    t.need(answer[0] != 0x80, f"block transfers are refused: abort {abort_code(answer):08x}h")


def _block_upload(t: NodeTester, size: int = 127) -> tuple[bytes, bytes]:
    """Begins a block upload; returns the response and the object's data."""
    index, data = _text(t)
    answer = t.answer(_block_request(index, size))
    _need_block_transfers(t, answer)
    t.equal(answer[0] & 0xE1, 0xC0, "command of the response")
    return answer, data


def _segments(t: NodeTester, *acknowledged: int) -> list[bytes]:
    """Begins or acknowledges a block (segments received, size of the next block); returns its segments."""
    request = bytes((0xA2, *acknowledged)) if acknowledged else b"\xa3"
    send = partial(t.send, 0x600 + t.node_id, request.ljust(8, b"\0"))
    return [frame.data for frame in t.heard_after(0x580 + t.node_id, 0.05, send)]


def _whole_block(t: NodeTester) -> tuple[list[bytes], bytes]:
    """Uploads all segments in one block; returns them and the answer to their acknowledgement."""
    segments = _segments(t)
    end = t.answer(bytes((0xA2, len(segments), 127)) + bytes(5))
    t.ask(b"\xa1" + bytes(7), 0.02)
    return segments, end


@check("sdo.block.upload", "A block upload transfers the whole object", _SDO)
def _(t: NodeTester) -> None:
    answer, data = _block_upload(t)
    if answer[0] & 2:
        t.equal(struct.unpack_from("<I", answer, 4)[0], len(data), "announced size")
    segments, end = _whole_block(t)
    t.equal([each[0] & 0x7F for each in segments], [*range(1, len(segments) + 1)], "sequence numbers")
    t.equal([each[0] >> 7 for each in segments], [0] * (len(segments) - 1) + [1], "last-segment bits")
    t.equal(end[0] & 0xE3, 0xC1, "command of the end")
    found = b"".join(each[1:] for each in segments)
    t.equal(found[: len(found) - (end[0] >> 2 & 7)], data, "data")


@check("sdo.block.upload.crc", "The checksum of a block upload is right", _SDO)
def _(t: NodeTester) -> None:
    answer, data = _block_upload(t)
    t.need(answer[0] & 4, "the server has no checksum")
    _, end = _whole_block(t)
    t.equal(struct.unpack_from("<H", end, 1)[0], crc_hqx(data, 0), "checksum")


@check("sdo.block.upload.size-1", "Blocks of one segment are possible", _SDO)
def _(t: NodeTester) -> None:
    _, data = _block_upload(t, 1)
    segments = _segments(t)
    t.equal(len(segments), 1, "segments in the first block")
    t.equal(segments[0][1:], data[:7].ljust(7, b"\0"), "data of the first segment")
    second = _segments(t, 1, 1)
    _cancel(t)
    t.equal(second[0][0] & 0x7F, 1, "sequence number in the second block")
    t.equal(second[0][1 : 1 + len(data[7:14])], data[7:14], "data of the second block")


@check("sdo.block.upload.repeat", "Unacknowledged segments are sent again", _SDO)
def _(t: NodeTester) -> None:
    _, data = _block_upload(t)
    _segments(t)
    t.need(len(data) > 7, "the string fits into one segment")
    again = _segments(t, 1, 127)
    _cancel(t)
    t.true(again, "no segments", "those after the first")
    t.equal(again[0][1 : 1 + len(data[7:14])], data[7:14], "data of the first segment sent again")


CHECKS.rows(
    _SDO,
    *((f"sdo.block.upload.size-{size}", f"A block size of {size} is refused with abort 05040002h",
       _block_upload, _cancel,
       lambda t, size=size: t.aborts(_block_request(_text(t)[0], size), (0x05040002,), f"block size {size}"))
      for size in (0, 128)),
    ("sdo.block.upload.sequence", "Acknowledging segments that were not sent causes abort 05040003h",
     _block_upload, lambda t: t.aborts(
         bytes((0xA2, len(_segments(t)) + 1, 127)) + bytes(5), (0x05040003,), "acknowledgement")),
    ("sdo.block.upload.missing", "Block upload of a missing object is refused with abort 06020000h",
     _block_upload, _cancel, aborts(_block_request(_NOWHERE), ABSENT[:1], "block upload")),
)  # fmt: skip


def _begin_block_download(t: NodeTester, *, crc: bool) -> tuple[int, int]:
    """Begins a block download; returns 1 if the server has a checksum, else 0, and the object's size."""
    index, sub, own = _number(t)
    answer = t.answer(bytes((0xC2 | crc << 2,)) + _mux(index, sub) + struct.pack("<I", own))
    _need_block_transfers(t, answer)
    t.equal(answer[0] & 0xE3, 0xA0, "command of the response")
    t.true(1 <= answer[4] <= 127, f"block size {answer[4]}", "1 to 127")
    return answer[0] >> 2 & 1, own


def _block_download(t: NodeTester, *, crc: bool, spoil: int = 0, skipped: bool = False) -> bytes:
    """Downloads the current value of an object in one block; returns the answer to the end of the
    transfer.
    """
    index, sub, size = _number(t)
    data = t.upload(index, sub)
    server_crc, size = _begin_block_download(t, crc=crc)
    t.need(server_crc or not spoil, "the server has no checksum")
    if skipped:
        answer = t.answer(b"\x82" + data.ljust(7, b"\0"))
        t.equal((answer[0], answer[1]), (0xA2, 0), "response and number of segments received in order")
    answer = t.answer(b"\x81" + data.ljust(7, b"\0"))
    t.equal((answer[0], answer[1]), (0xA2, 1), "response and number of segments received in order")
    return t.answer(struct.pack("<BH5x", 0xC1 | (7 - size) << 2, (crc_hqx(data, 0) ^ spoil) if crc else 0))


@parametrised
def _downloaded(t: NodeTester, *, crc: bool = True, skipped: bool = False) -> None:
    t.equal(_block_download(t, crc=crc, skipped=skipped)[0], 0xA1, "command of the end")


def _crc_is_checked(t: NodeTester) -> None:
    answer = _block_download(t, crc=True, spoil=1)
    t.equal(answer[:1] + answer[4:], b"\x80" + struct.pack("<I", 0x05040004), "command and abort code")


def _end_block_download(t: NodeTester) -> None:
    _begin_block_download(t, crc=False)
    t.ask(b"\x81" + bytes(7), 0.05)
    _cancel(t)


CHECKS.rows(
    _SDO,
    ("sdo.block.download", "A block download is carried out", _downloaded()),
    ("sdo.block.download.no-crc", "A block download without a checksum is carried out",
     _downloaded(crc=False)),
    ("sdo.block.download.crc", "A wrong checksum causes abort 05040004h", _crc_is_checked),
    ("sdo.block.download.sequence", "A segment out of order is not accepted and may be sent again",
     _downloaded(skipped=True)),
    ("sdo.block.download.read-only", "Block download to a read-only object is refused with abort 06010002h",
     _end_block_download,
     aborts(b"\xc2" + _mux(0x1000, 0) + struct.pack("<I", 4), READ_ONLY, "block download")),
)  # fmt: skip


CHECKS.add(
    "sdo.channel", "1200h names the default identifiers of the SDO server", "CiA 301, object 1200h",
    (0x1200, 1), lambda t: t.equal([t.read(0x1200, sub) & 0x7FF for sub in (1, 2)],
                                   [0x600 + t.node_id, 0x580 + t.node_id], "1200h"),
)  # fmt: skip
CHECKS.add(
    "sdo.range", "A value outside an object's range is refused with abort 06090030h to 06090032h", _SDO,
    (0x1800, 2), refuses(0x1800, 2, b"\xf5", RANGE),
)  # fmt: skip
