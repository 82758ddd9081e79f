"""Start-up sequences of third-party masters, frame by frame, and the answers by CiA 301 and 402.

- Lely and ros2_canopen: boot procedure of CiA 302-2 with a configuration in the manner of dcfgen; then as the
  drive class `Motor402`: it enables with halt set and in no mode, homes, and polls 6061h
  (github.com/ros-industrial/ros2_canopen, canopen_402_driver/src/motor.cpp and default_homing_mode.cpp).
- A PLC in the manner of CODESYS SoftMotion: restores the defaults, disables every PDO before it maps, sets up
  homing by SDO, watches heartbeats. The exact order of its requests is not published.
- A PLC in the manner of TwinCAT with node guarding: leaves the mapping, and writes parameters of valid PDOs
  with the values that they have. The exact order is not published.

A line is a frame that is sent (>), one that must come next with its identifier (<), a remote frame (R), SDO
writes and reads (w, r), or SYNCs with an RPDO before each, until a frame matches (sync). A dot is any digit.
"""

import re
from contextlib import contextmanager

import can
import pytest
from support.conformance import EDS, gateway_bus
from support.ideal_motor import IdealMotor

from hdbridge.sim.lockstep import lockstep_bench

PERIOD_S = 0.004

LELY = """
> 000 8200
< 705 00
r 1000 00 92010...
r 1018 01 ........
r 1018 02 ........
r 1018 03 ........
w 1017 00 E803
w 1016 01 D0070100
w 1400 01 05020080
w 1400 02 01
w 1600 00 00
w 1600 01 10004060
w 1600 02 20007A60
w 1600 00 02
w 1400 01 05020000
w 1800 01 85010080
w 1800 02 01
w 1A00 00 00
w 1A00 01 10004160
w 1A00 02 20006460
w 1A00 00 02
w 1800 01 85010000
w 60C2 01 04
w 60C2 02 FD
w 6098 00 25
> 000 0105
> 701 05
r 6061 00 00
sync 0001 00000000 until 50......
sync 0601 00000000 until 31......
sync 0701 00000000 until 33......
sync 0F01 00000000 until 37.6
r 6502 00 E1000000
w 6060 00 06
sync 0F01 00000000 until 37.6
r 6061 00 06
r 6098 00 25
sync 1F00 00000000 until 37560000 0000
sync 0F01 00000000 until 37.600000000
w 6060 00 00
sync 0F01 00000000 until 37......
r 6061 00 00
w 6060 00 08
sync 0F01 00000000 until 37......
r 6061 00 08
sync 0F00 64000000 until 37..64000000
sync 0F00 C8000000 until 37..C8000000
> 701 05
w 6060 00 00
sync 0001 C8000000 until 50......
"""

SOFT_MOTION = """
> 000 8105
< 705 00
r 1000 00 92010...
r 1018 01 ........
w 1011 01 6C6F6164
> 000 8105
< 705 00
w 1005 00 80000000
w 1014 00 85000000
w 1016 01 C8007F00
w 1017 00 6400
w 1400 01 05020080
w 1401 01 05030080
w 1402 01 05040080
w 1800 01 850100C0
w 1801 01 850200C0
w 1802 01 850300C0
w 1600 00 00
w 1600 01 10004060
w 1600 02 20007A60
w 1600 00 02
w 1400 02 01
w 1400 01 05020000
w 1A00 00 00
w 1A00 01 10004160
w 1A00 02 20006460
w 1A00 00 02
w 1800 02 01
w 1800 03 0000
w 1800 05 0000
w 1800 01 85010040
w 60C2 01 04
w 60C2 02 FD
w 6060 00 08
> 000 0105
heartbeat 77F
sync 8000 00000000 until 50......
sync 0600 00000000 until 31......
sync 0700 00000000 until 33......
w 6098 00 25
w 6099 01 E8030000
w 6099 02 64000000
w 609A 00 10270000
w 607C 00 00000000
w 6060 00 06
sync 0700 00000000 until 33......
sync 0F00 00000000 until 37......
sync 1F00 00000000 until 375600000000
w 6060 00 08
sync 0F00 00000000 until 371200000000|375200000000
r 6061 00 08
sync 0F00 2C010000 until 37..2C010000
sync 0F00 58020000 until 37..58020000
quiet 0.3
< 085 0087|3081
> 000 0105
sync 0000 58020000 until 18......|50......
sync 8000 58020000 until 50......
"""

GUARDING = """
> 000 8205
< 705 00
r 1000 00 92010...
r 1018 01 ........
r 1018 02 ........
w 100C 00 6400
w 100D 00 03
w 1402 01 05040000
w 1402 02 01
w 1802 01 85030000
w 1802 02 01
w 1802 03 0000
R 705
< 705 7F
R 705
< 705 FF
w 6060 00 08
> 000 0105
R 705
< 705 05
R 705
< 705 85
r 6061 00 08
r 1001 00 00
r 603F 00 0000
"""


class Master:
    """Plays the lines of a start-up sequence on a bus."""

    def __init__(self, bus, clock):
        self.bus, self.clock = bus, clock
        self.heard = []
        self.beat, self.beat_s = None, 0.0

    def send(self, can_id, data=b"", **kind):
        self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False, **kind))
        self.listen()

    def listen(self):
        while (message := self.bus.recv(0)) is not None:
            self.heard.append((message.arbitration_id, bytes(message.data)))

    def wait(self, duration_s):
        self.clock.sleep_until(self.clock.now() + duration_s)
        self.listen()

    def next(self, can_id):
        """Returns the next frame with an identifier, within a second; earlier frames are discarded."""
        for _ in range(250):
            for place, (heard_id, data) in enumerate(self.heard):
                if heard_id == can_id:
                    del self.heard[: place + 1]
                    return data
            self.wait(PERIOD_S)
        raise AssertionError(f"no frame {can_id:03X}h")

    def sdo(self, command, index, sub, data=b""):
        self.send(0x605, bytes((command, index & 0xFF, index >> 8, sub)) + data.ljust(4, b"\0"))
        answer = self.next(0x585)
        assert answer[1:4] == bytes((index & 0xFF, index >> 8, sub))
        assert answer[0] != 0x80, f"{index:04X}h:{sub:02X} aborted with {answer[4:][::-1].hex()}"
        return answer

    def sync(self, rpdo, until):
        for _ in range(250):
            if self.beat is not None and self.clock.now() >= self.beat_s:
                self.beat_s = self.clock.now() + 0.1
                self.send(self.beat, b"\5")
            self.heard.clear()
            self.send(0x205, rpdo)
            self.send(0x080)
            self.wait(PERIOD_S)
            words = [data for can_id, data in self.heard if can_id == 0x185]
            assert len(words) == 1
            if re.match(until, words[0].hex().upper()):
                return
        raise AssertionError(f"not {until}: {words[0].hex()}")

    def play(self, script):
        for number, line in enumerate(script.strip().splitlines(), start=1):
            kind, first, *rest = line.split()
            try:
                self._play(kind, first, rest)
            except AssertionError as error:
                raise AssertionError(f"line {number}, {line}: {error}") from None

    def _play(self, kind, first, rest):
        if kind == ">":
            self.send(int(first, 16), bytes.fromhex(rest[0]))
        elif kind == "R":
            self.send(int(first, 16), is_remote_frame=True)
        elif kind == "<":
            data = self.next(int(first, 16)).hex().upper()
            assert re.match(rest[0], data), data
        elif kind == "w":
            data = bytes.fromhex(rest[1])
            self.sdo(0x23 | (4 - len(data)) << 2, int(first, 16), int(rest[0], 16), data)
        elif kind == "r":
            answer = self.sdo(0x40, int(first, 16), int(rest[0], 16))
            size = len(rest[1]) // 2
            assert answer[0] == 0x43 | (4 - size) << 2
            assert re.fullmatch(rest[1], answer[4 : 4 + size].hex().upper()), answer.hex()
        elif kind == "sync":
            self.sync(bytes.fromhex(first + rest[0]), "".join(rest[2:]))
        elif kind == "heartbeat":
            self.beat = int(first, 16)
        else:
            assert kind == "quiet"
            self.wait(float(first))


@contextmanager
def simulated_drive(_):
    with lockstep_bench(IdealMotor(100_000), EDS, 5) as bench:
        yield bench


@pytest.mark.parametrize("script", [LELY, SOFT_MOTION, GUARDING], ids=["Lely", "SoftMotion", "guarding"])
@pytest.mark.parametrize("node", [gateway_bus, simulated_drive])
def test_another_makers_master_starts_and_moves_it(tmp_path, node, script):
    with node(tmp_path) as (bus, clock, _):
        Master(bus, clock).play(script)
