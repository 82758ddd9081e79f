"""The doctor of the outer side: configuration and mistakes of a master, from its frames."""

import struct

import can
import pytest
from support.command import run_here
from support.conformance import gateway_slave

from hdbridge.daemon.gateway.trace import Trace
from hdbridge.drive.link import Frame

NODE = 5


class Outer:
    """A master on the bus of a gateway's slave, and the trace of everything that is sent there."""

    def __init__(self, tester, node) -> None:
        self.link, self.node, self.trace = tester.link, node, Trace(NODE, tester.od)
        self.lines = []
        self.frames = []

    def note(self, frame: Frame) -> None:
        self.frames.append(frame)
        self.lines += self.trace.take(frame)

    def send(self, can_id: int, data: bytes = b"") -> None:
        self.note(Frame(can_id, data, self.link.now()))
        self.link.send(can_id, data)
        self.listen()

    def listen(self, duration_s: float = 0.0) -> None:
        end_s = self.link.now() + duration_s
        while (frame := self.link.recv(end_s)) is not None:
            self.note(frame)

    def put(self, index: int, sub: int, value: int, size: int) -> None:
        raw = (value & (1 << 8 * size) - 1).to_bytes(size, "little").ljust(4, b"\0")
        self.send(0x605, struct.pack("<BHB", 0x23 | (4 - size) << 2, index, sub) + raw)

    def get(self, index: int, sub: int = 0) -> None:
        self.send(0x605, struct.pack("<BHB4x", 0x40, index, sub))

    def cycle(self, word: int, target: int, count: int = 1) -> None:
        for _ in range(count):
            self.send(0x205, struct.pack("<Hi", word, target))
            self.send(0x080)
            self.listen(0.004)

    def begin(self) -> None:
        for first, words in ((0x1400, (0x60400010, 0x607A0020)), (0x1800, (0x60410010, 0x60640020))):
            base = 0x200 if first == 0x1400 else 0x180
            self.put(first, 1, 0x80000000 | base + NODE, 4)
            self.put(first + 0x200, 0, 0, 1)
            for place, word in enumerate(words, start=1):
                self.put(first + 0x200, place, word, 4)
            self.put(first + 0x200, 0, 2, 1)
            self.put(first, 2, 1, 1)
            self.put(first, 1, base + NODE, 4)
        self.put(0x6060, 0, 8, 1)
        self.send(0, bytes((1, NODE)))
        self.get(0x6064)
        self.cycle(0x00, 1_000_000, 12)

    def enable(self) -> None:
        for word in (0x06, 0x07, 0x0F):
            self.cycle(word, 1_000_000, 3)

    @property
    def advice(self) -> list[str]:
        return [line.advice for line in self.lines if line.advice]


@pytest.fixture
def outer(tmp_path):
    with gateway_slave(tmp_path) as (tester, node):
        yield Outer(tester, node)


def test_a_correct_master_has_no_findings(outer):
    outer.begin()
    outer.enable()
    for k in range(50):
        outer.cycle(0x0F, 1_000_000 + 20 * k)
    texts = [line.text for line in outer.lines]
    assert outer.advice == []
    assert "NMT start" in texts
    assert any(text.endswith("switched on") for text in texts)
    assert any(text.endswith("operation enabled") for text in texts)
    configured = outer.trace.configured()
    assert any(text.startswith("6060h:00 'Modes of operation' = 8") for text in configured)
    assert any(text.startswith("SYNC every 4.000 ms") for text in configured)
    assert {each[-1] for each in configured if "COB-ID" in each} == {"h"}


def no_targets(outer):
    outer.begin()
    outer.enable()
    for _ in range(3):
        outer.send(0x080)
        outer.listen(0.004)


def held_reset(outer):
    outer.begin()
    outer.enable()
    outer.node.faults.raise_error(0x7500)
    outer.cycle(0x0F, 1_000_000, 60)
    outer.node.firmware._stage.reset = lambda: None
    outer.node.firmware._stage.is_resetting = True
    outer.cycle(0x8F, 1_000_000, 100)


def no_such_mode(outer):
    outer.put(0x6060, 0, 9, 1)


def stored_by_lss(outer):
    for part in range(4):
        value = outer.node.dictionary.value(0x1018, part + 1)
        outer.send(0x7E5, struct.pack("<BI3x", 0x40 + part, value))
    outer.send(0x7E5, b"\x11\x09" + bytes(6))
    outer.send(0x7E5, b"\x17" + bytes(7))
    texts = [each.text for each in outer.lines]
    assert texts[-3:-1] == ["LSS: a node is selected by its identity", "LSS node id 9"]


@pytest.mark.parametrize(
    ("does", "words"),
    [
        (
            lambda o: (o.begin(), o.enable(), o.listen(0.012), o.cycle(0x0F, 1_000_000)),
            "SYNC must be periodic",
        ),
        (no_targets, "send a target before every SYNC"),
        (
            lambda o: (
                o.begin(),
                o.cycle(0x06, 1_000_000, 3),
                o.cycle(0x07, 5_000_000, 3),
                o.cycle(0x0F, 5_000_000, 3),
            ),
            "the target is 4000000 increments from 6064h",
        ),
        (lambda o: (o.begin(), o.enable(), o.cycle(0x0F, 1_500_000)), "the axis is not faster than 607Fh"),
        (
            lambda o: (o.begin(), o.cycle(0x00, 2_000_000_000)),
            "the software limits (607Dh) are -14400000 to 14400000",
        ),
        (lambda o: (o.begin(), o.cycle(0x0F, 1_000_000, 2)), "no transition from switch on disabled"),
        (held_reset, "bit 7 acts by its rising edge"),
        (
            lambda o: (o.begin(), o.cycle(0x80, 1_000_000, 5), o.cycle(0x8F, 1_000_000, 5)),
            "bit 7 acts by its rising edge",
        ),
        (lambda o: (o.begin(), o.send(0x205, b"\x06\0")), "6 bytes are mapped in 1600h"),
        (lambda o: o.put(0x1A00, 0, 0, 1), "to change a PDO: set bit 31"),
        (no_such_mode, "the modes are 1, 6, 7, 8 (6502h)"),
        (lambda o: o.put(0x2345, 0, 1, 1), "use the EDS of 'hdbridge gateway eds'"),
        (lambda o: o.put(0x605A, 0, 9, 2), "expected 0 to 8"),
        (
            lambda o: (o.put(0x1016, 1, 126 << 16 | 100, 4), o.get(0x6041), o.listen(1.5), o.get(0x6041)),
            "let the master send its heartbeat",
        ),
        (
            lambda o: (
                o.begin(),
                o.put(0x1017, 0, 10, 2),
                o.send(0, bytes((128, NODE))),
                o.listen(0.05),
                o.send(0x205, bytes(6)),
            ),
            "NMT start first",
        ),
        (stored_by_lss, "the node id that lasts is that of the machine file"),
    ],
    ids=lambda each: each if isinstance(each, str) else "",
)
def test_each_mistake_is_reported_once_with_its_remedy(outer, does, words):
    does(outer)
    found = [each for each in outer.advice if words in each]
    assert len(found) == 1, outer.lines[-8:]


def test_the_command_reads_a_bus_log(outer, tmp_path):
    no_such_mode(outer)
    with can.CanutilsLogWriter(tmp_path / "bus.log") as writer:
        for frame in outer.frames:
            writer(can.Message(arbitration_id=frame.can_id, data=frame.data, timestamp=frame.time_s,
                               is_extended_id=False))  # fmt: skip
    (tmp_path / "machine.yaml").write_text(
        "schema: hdbridge.machine/1\nname: between\naxes:\n  - profile: article\n"
        "gateway:\n  bus: {interface: socketcan, channel: can1}\n  nodes: {article: 5}\n"
    )
    done = run_here(
        tmp_path, "gateway", "doctor", "machine.yaml", "--log", "bus.log", "--json", "trace.json", status=4
    )
    assert "refused with" in done.stdout
    assert "the modes are 1, 6, 7, 8 (6502h)" in done.stdout
    assert "mistakes of the other master: 1; the first: the modes" in done.stderr
    done = run_here(tmp_path, "gateway", "doctor", "machine.yaml", "--log", "none.log", status=2)
    assert "none.log: no such file" in done.stderr
