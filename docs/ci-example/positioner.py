"""Move the load of a CiA-402 axis to an angle, in cyclic synchronous position mode. Plain python-can."""

import argparse
import struct
import sys
import time

import can

MOTOR_COUNTS_PER_DEG = 50 * 8000 / 360  # of the load: gear ratio, counts per motor turn
LOAD_COUNTS_PER_DEG = 2_880_000 / 360
CYCLE_S = 0.010
SPEED_DEG_S = 15.0
ANSWER_S = 0.3  # a drive that has not answered for so long is lost
WATCHDOG_MS = 500  # the drive stops on its own when set-points are missing for this long
LARGEST_STEP_DEG = 1.0  # of the load encoder, from one cycle to the next
ENABLED, FAULT = 0x27, 0x08


class Stopped(Exception):
    """The axis was stopped, or stopped on its own; the text gives the reason."""


class Axis:
    def __init__(self, bus: can.BusABC, node_id: int = 1) -> None:
        self.bus, self.node_id = bus, node_id
        self.status = self.motor = self.load = 0
        self.last_load = None
        self.deadline = time.monotonic()

    def start(self) -> None:
        """Configure the drive and bring it to 'operation enabled', standing."""
        self.write(0x60C2, 1, round(1000 * CYCLE_S), 1)
        self.write(0x60C2, 2, -3, 1)
        self.write(0x1400, 5, WATCHDOG_MS, 2)
        self.write(0x6060, 0, 8, 1)  # cyclic synchronous position
        self.send(0x000, bytes([1, self.node_id]))
        self.cycle(0x00)
        for word in (0x06, 0x07, 0x0F):
            for _ in range(3):
                self.cycle(word)
        if self.status & 0x6F != ENABLED:
            raise Stopped(f"not enabled: statusword {self.status:04X}h")

    def move_to(self, load_deg: float) -> None:
        """At constant speed; raises Stopped when something is wrong, with the axis stopped."""
        goal, target = round(load_deg * MOTOR_COUNTS_PER_DEG), self.motor
        step = round(SPEED_DEG_S * CYCLE_S * MOTOR_COUNTS_PER_DEG)
        try:
            while target != goal:
                target += max(-step, min(step, goal - target))
                self.cycle(0x0F, target)
                self.check()
            for _ in range(50):  # settle
                self.cycle(0x0F, target)
                self.check()
        except Stopped:
            for _ in range(20):
                self.send(0x080)
                self.set_point(0x02, self.motor)  # quick stop
                time.sleep(CYCLE_S)
            raise

    def stop(self) -> None:
        """Switch off."""
        for _ in range(3):
            self.cycle(0x00)

    def check(self) -> None:
        if self.status & 0x4F == FAULT:
            raise Stopped("the drive reports a fault")
        if self.status & 0x6F != ENABLED:
            raise Stopped("the drive has switched off")
        if abs(self.load - self.last_load) > LARGEST_STEP_DEG * LOAD_COUNTS_PER_DEG:
            raise Stopped("the load encoder jumped")

    def cycle(self, word: int, target: int | None = None) -> None:
        """SYNC, both TPDOs, RPDO."""
        while (left := self.deadline - time.monotonic()) > 0:
            time.sleep(left)
        self.deadline = time.monotonic() + CYCLE_S
        while self.bus.recv(0) is not None:
            pass  # what came between the cycles
        self.send(0x080)
        first = self.answer(0x180 + self.node_id, 8)
        second = self.answer(0x280 + self.node_id, 8)
        self.status, self.motor, _ = struct.unpack("<Hih", first)
        self.last_load, (self.load, _) = self.load, struct.unpack("<ii", second)
        self.set_point(word, self.motor if target is None else target)

    def set_point(self, word: int, target: int) -> None:
        self.send(0x200 + self.node_id, struct.pack("<Hi", word, target))

    def write(self, index: int, subindex: int, value: int, size: int) -> None:
        """An object of the drive, by SDO."""
        data = value.to_bytes(size, "little", signed=value < 0).ljust(4, b"\0")
        self.send(0x600 + self.node_id, struct.pack("<BHB", 0x23 | (4 - size) << 2, index, subindex) + data)
        if self.answer(0x580 + self.node_id, 8)[0] != 0x60:
            raise Stopped(f"the drive refuses object {index:04X}h:{subindex:02X}")

    def send(self, can_id: int, data: bytes = b"") -> None:
        self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def answer(self, can_id: int, length: int) -> bytes:
        """The data of the next frame with an identifier; others pass, and a boot-up message is an end."""
        end = time.monotonic() + ANSWER_S
        while (left := end - time.monotonic()) > 0:
            message = self.bus.recv(left)
            if message is None or message.is_extended_id or message.is_remote_frame or message.is_error_frame:
                continue
            if message.arbitration_id == 0x700 + self.node_id and message.data == b"\0":
                raise Stopped("the drive restarted")
            if message.arbitration_id == can_id and len(message.data) == length:
                return bytes(message.data)
        raise Stopped("the drive does not answer")


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--interface", default="socketcan")
    parser.add_argument("--channel", default="can0")
    parser.add_argument("load_deg", type=float)
    given = parser.parse_args(arguments)
    with can.Bus(interface=given.interface, channel=given.channel) as bus:
        axis = Axis(bus)
        try:
            axis.start()
            axis.move_to(given.load_deg)
            axis.stop()
        except (Stopped, can.CanError) as reason:
            print(f"stopped: {reason}")
            return 1
    print(f"the load stands at {axis.load / LOAD_COUNTS_PER_DEG:.3f} deg")
    return 0


if __name__ == "__main__":
    sys.exit(main())
