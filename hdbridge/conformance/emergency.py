"""Checks of EMCY, the error objects, stored parameters and identity."""

from typing import Final

from hdbridge.cia301 import NmtCommand
from hdbridge.conformance.network import lose_heartbeat
from hdbridge.conformance.steps import aborts, has_bits, holds, no_emergency, puts, reads, reset_node, waits
from hdbridge.conformance.tester import PDO_INVALID, RANGE, READ_ONLY, NodeTester, Step, Table, expedited

CHECKS: Final = Table()
check: Final = CHECKS.check
_EMCY: Final = "CiA 301, 7.2.7 and object 1014h"
_REGISTER: Final = "CiA 301, object 1001h"
_HISTORY: Final = "CiA 301, object 1003h"
_STORE: Final = "CiA 301, objects 1010h and 1011h"
_IDENTITY: Final = "CiA 301, objects 1000h and 1018h"
_NO_STORAGE: Final = (0x08000020, 0x08000022)
_SAVE: Final = b"save"
_LOAD: Final = b"load"


def _switch_off(t: NodeTester) -> None:
    t.write(0x1014, 0, t.read(0x1014) | PDO_INVALID, 4)


CHECKS.rows(
    _REGISTER,
    ("emcy.register", "1001h is 0 without an error", reset_node, holds(0x1001, 0, 0)),
    ("emcy.register.error", "An error sets bit 0 of 1001h", lose_heartbeat, has_bits(0x1001, 1, 1, "bit 0")),
    ("emcy.register.communication", "A communication error sets bit 4 of 1001h", lose_heartbeat,
     has_bits(0x1001, 16, 16, "bit 4")),
    ("emcy.register.read-only", "1001h cannot be written",
     aborts(expedited(0x1001, 0, b"\0"), READ_ONLY, "download to 1001h")),
)  # fmt: skip
CHECKS.rows(
    _EMCY,
    ("emcy.identifier", "1014h is 80h + node id by default", 0x1014, NodeTester.reset,
     lambda t: t.equal(f"{t.read(0x1014) & 0x7FF:03X}h", f"{0x80 + t.node_id:03X}h", "identifier")),
    ("emcy.frame", "An EMCY message has eight bytes", lose_heartbeat,
     lambda t: t.equal({len(frame.data) for frame in t.heard(0x80 + t.node_id)}, {8}, "length")),
    ("emcy.frame.register", "Byte 2 of an EMCY message is 1001h", lose_heartbeat,
     lambda t: t.equal(t.heard(0x80 + t.node_id)[-1].data[2], t.read(0x1001), "error register")),
    ("emcy.once", "An error is reported once", lose_heartbeat, waits(0.5),
     lambda t: t.equal(t.emergencies().count(0x8130), 1, "number of EMCY messages")),
    ("emcy.disabled", "1014h with bit 31 set sends no EMCY", 0x1014, lose_heartbeat,
     NodeTester.beat, waits(0.02), _switch_off, no_emergency(0.4)),
)  # fmt: skip


@check("emcy.identifier.other", "EMCY is sent with the identifier in 1014h", _EMCY, 0x1014)
def _(t: NodeTester) -> None:
    other = 0x80 + (t.node_id ^ 1 or 2)
    _switch_off(t)
    t.write(0x1014, 0, other, 4)
    t.be_supervised(50)
    heard = t.heard_after(other, 0.2, t.beat)
    t.true(heard, "no EMCY with the new identifier", "EMCY 8130h")


_clear_history: Final = puts(0x1003, 0, 0, 1)
CHECKS.rows(
    _HISTORY,
    ("emcy.history", "An error is the first entry of 1003h", 0x1003, lose_heartbeat,
     holds(0x1003, 1, 0x8130, 4)),
    ("emcy.history.count", "1003h:00 counts the errors", 0x1003, _clear_history, lose_heartbeat,
     holds(0x1003, 0, 1)),
    ("emcy.history.clear", "Writing 0 to 1003h:00 clears the history", 0x1003, lose_heartbeat,
     _clear_history, holds(0x1003, 0, 0)),
    ("emcy.history.write", "Any other value written to 1003h:00 is refused with abort 06090030h", 0x1003,
     aborts(expedited(0x1003, 0, b"\x01"), RANGE, "1003h:00 = 1")),
)  # fmt: skip


@check("emcy.history.order", "The newest error is in 1003h:01", _HISTORY, 0x1003)
def _(t: NodeTester) -> None:
    index, sub, bits = t.scratch()
    can_id = t.map_pdo(0x1400, ((index, sub, bits),), 255)
    lose_heartbeat(t)
    t.nmt(NmtCommand.START)
    t.send(can_id, b"")
    t.wait(0.05)
    t.need(t.emergencies()[-1:] == [0x8210], "a short RPDO is not EMCY 8210h")
    codes = [t.read(0x1003, place) & 0xFFFF for place in (1, 2)]
    t.send(can_id, bytes(t.upload(index, sub)))
    t.equal([f"{code:04X}h" for code in codes], ["8210h", "8130h"], "1003h:01 and 02")


# ---------------------------------------------------------------- identity


@check("identity.type", "1000h is read-only and has four bytes", _IDENTITY)
def _(t: NodeTester) -> None:
    value = t.upload(0x1000)
    t.equal(len(value), 4, "bytes")
    t.aborts(expedited(0x1000, 0, value), READ_ONLY, "download to 1000h")


@check("identity.entries", "1018h:00 is 1 to 4, and that number of entries exists", _IDENTITY)
def _(t: NodeTester) -> None:
    count = t.read(0x1018, 0)
    t.true(1 <= count <= 4, f"1018h:00 = {count}", "1 to 4")
    for sub in range(1, count + 1):
        t.equal(len(t.upload(0x1018, sub)), 4, f"bytes of 1018h:{sub:02X}")


CHECKS.rows(
    _IDENTITY,
    ("identity.vendor", "1018h:01 is not 0", reads(0x1018, 1, bool, "a number assigned by CiA")),
    ("identity.read-only", "1018h:01 cannot be written",
     lambda t: t.aborts(expedited(0x1018, 1, t.upload(0x1018, 1)), READ_ONLY, "download to 1018h:01")),
)  # fmt: skip


def _identity(sub: int, key: str, name: str) -> None:
    @check(
        f"identity.eds.{key.split('_', maxsplit=1)[0]}",
        f"1018h:{sub:02X} is the {name} of the EDS",
        "CiA 306, [DeviceInfo]",
    )
    def _(t: NodeTester) -> None:
        expected = t.need(getattr(t.eds.device_information, key), f"the EDS has no {name}")
        t.require(0x1018, sub)
        t.equal(f"{t.read(0x1018, sub):08X}h", f"{expected:08X}h", name)


_identity(1, "vendor_number", "vendor number")
_identity(2, "product_number", "product number")
_identity(3, "revision_number", "revision number")


# ---------------------------------------------------------------- stored parameters


def _storage(index: int, verb: str) -> None:
    name, entry = f"{index:04X}", (index, 1)
    CHECKS.rows(
        _STORE,
        (f"store.{name}.capability", f"{name}h:01 says that parameters can be {verb}", entry,
         reads(index, 1, lambda value: value & 3, "bit 0 or bit 1")),
        (f"store.{name}.signature", f"{name}h:01 refuses a wrong signature", entry,
         aborts(expedited(index, 1, b"evil"), _NO_STORAGE, "signature 'evil'")),
        (f"store.{name}.entries", f"{name}h:00 is 1 to 127", entry,
         reads(index, 0, lambda value: 1 <= value <= 127, "1 to 127")),
    )  # fmt: skip


_storage(0x1010, "saved")
_storage(0x1011, "restored")


def _saved(t: NodeTester, value: int) -> None:
    t.require(0x1010, 1)
    t.require(0x1011, 1)
    t.put(0x1017, 0, value, 2)
    t.download(0x1010, 1, _SAVE)


def _forget(t: NodeTester) -> None:
    t.download(0x1011, 1, _LOAD)
    reset_node(t)


def _stored(name: str, text: str, *act: Step) -> None:
    @check(f"store.{name}", text, _STORE, stores=True)
    def _(t: NodeTester) -> None:
        _saved(t, 700)
        for step in act:
            step(t)
        found = t.read(0x1017)
        _forget(t)
        t.equal(found, 700, "1017h")


_stored("save", "Saved parameters survive a reset", reset_node)
_stored(
    "unsaved", "Parameters that were not saved do not survive a reset", puts(0x1017, 0, 800, 2), reset_node
)
_stored(
    "load.later", "Default values become valid at the next reset, not at once",
    lambda t: t.download(0x1011, 1, _LOAD),
)  # fmt: skip


@check("store.load", "Default values are valid after the reset", _STORE, stores=True)
def _(t: NodeTester) -> None:
    _forget(t)
    before = t.read(0x1017)
    _saved(t, before + 300)
    _forget(t)
    t.equal(t.read(0x1017), before, "1017h")


@check("store.evil", "A wrong signature saves nothing", _STORE, (0x1010, 1), stores=True)
def _(t: NodeTester) -> None:
    before = t.read(0x1017)
    t.put(0x1017, 0, before + 300, 2)
    t.ask(expedited(0x1010, 1, b"evas"))
    reset_node(t)
    t.equal(t.read(0x1017), before, "1017h")
