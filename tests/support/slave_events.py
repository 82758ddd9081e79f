"""Random events on one slave, and the invariants that must always hold.

The checks examine the motor's demand and the frames that the master has sent, not the firmware: no demand
outside the limits, and no motion without a request since the last loss of drive or master.
"""

import struct
from random import Random
from typing import Any

import can

from hdbridge.cia301 import NmtState
from hdbridge.device.behaviour import Behaviour
from hdbridge.device.node import DriveNode
from hdbridge.device.powerstate import PowerStage
from hdbridge.sim.lockstep import LockstepBus, VirtualClock, lockstep_bench
from support.conformance import EDS
from support.ideal_motor import IdealMotor

LOW, HIGH = -20_000, 20_000
"""Software position limits (607Dh), counts."""
SPEED = 4000 * 8000 / 60.0
"""Maximum motor speed (6080h), counts/s."""
PERIOD_S = 0.004
WORDS = (0x00, 0x02, 0x06, 0x07, 0x0F, 0x0F, 0x0F, 0x1F, 0x3F, 0x5F, 0x10F, 0x80, 0x8F)
MODES = (0, 1, 1, 6, 7, 8, 8, 8, 3)


class TimedStage(PowerStage):
    """Power stage that takes some periods to switch on and may fail."""

    def __init__(self, takes: int = 0) -> None:
        self.takes, self.left, self.wanted = takes, 0, False

    def switch(self, on: bool) -> None:
        self.wanted, self.left = on, self.takes

    @property
    def is_on(self) -> bool:  # read at the command, then once per period
        self.left -= 1
        return self.wanted and self.left < 0

    def reset(self) -> None:
        self.error_code = 0


class WatchedMotor(IdealMotor):
    """Motor that checks every demand against the invariants."""

    def __init__(self, rng: Random) -> None:
        super().__init__(0)
        self.rng = rng
        self.laws: Laws | None = None

    def follow(self, start_counts: float, end_counts: float, substeps: int) -> None:
        assert self.laws is not None
        self.laws.demand(start_counts, end_counts, substeps * self.dt_s, self.dt_s)
        super().follow(start_counts, end_counts, substeps)

    def coast(self, substeps: int, braked: bool) -> None:
        assert self.laws is not None
        self.laws.released()
        super().coast(substeps, braked)


class Laws:
    """Checks of the motor's demand against the master's requests, which its frames alone determine."""

    def __init__(self) -> None:
        self.home = 0.0
        """Position of the user's zero, counts of the motor."""
        self.mode = 0
        """Mode of operation display (6061h)."""
        self.powered = False
        self.enabling = False
        """True if the last command was 'enable operation' and neither side has been lost since."""
        self.targets = self.set_points = False
        """True if a target, or a controlword with bit 4, has been sent since the last loss."""
        self.velocity = 0.0
        self.periods = self.moved = self.enabled = 0

    def asked(self, word: int) -> None:
        if not word & 0x80:
            self.enabling = word & 0x0F == 0x0F
        self.set_points |= bool(word & 0x10)

    def interrupted(self) -> None:
        """Records a loss of the master or the drive: everything must be requested again."""
        self.enabling = self.targets = self.set_points = False

    def released(self) -> None:
        """Records that the motor has no power."""
        self.powered = False
        self.velocity = 0.0

    def demand(self, start: float, end: float, duration_s: float, dt_s: float) -> None:
        self.periods += 1
        if not self.powered:
            assert self.enabling, "power without 'enable operation'"
            self.enabled += 1
            self.powered = True
            self.velocity = 0.0
        speed = (end - start) / duration_s
        braking = (
            abs(end - start) <= abs(self.velocity) * (duration_s + dt_s) and speed * self.velocity >= 0.0
        )
        if abs(end - start) > 1e-6:
            self.moved += 1
            assert abs(end - start) <= SPEED * (duration_s + dt_s), f"{speed:.0f} counts/s"
            asked = {1: self.set_points, 7: self.targets and self.set_points, 8: self.targets}.get(self.mode)
            assert asked or braking, f"motion in mode {self.mode} without a target"
            before = max(LOW - (start - self.home), (start - self.home) - HIGH, 0.0)
            outside = max(LOW - (end - self.home), (end - self.home) - HIGH, 0.0)
            assert outside <= before + 1.0 or braking, f"{end:.0f} counts"
        self.velocity = speed


class Story:
    """One slave with its master, and the events on both."""

    def __init__(self, rng: Random, bus: LockstepBus, clock: VirtualClock, node: DriveNode, stage: TimedStage,
                 motor: WatchedMotor, laws: Laws) -> None:  # fmt: skip
        self.rng, self.bus, self.clock, self.node = rng, bus, clock, node
        self.stage, self.motor, self.laws = stage, motor, laws
        self.target = 0
        self.errors: set[int] = set()
        """Error codes that were reported and not yet ended by 'error reset'."""

    def send(self, can_id: int, data: bytes, **kind: Any) -> None:
        self.bus.send(can.Message(arbitration_id=can_id, data=data, **{"is_extended_id": False, **kind}))
        self.listen()

    def listen(self) -> None:
        """Records an EMCY or a boot-up message as a loss, unless 6007h = 0 makes the drive ignore it."""
        while (message := self.bus.recv(0)) is not None:
            code = struct.unpack_from("<H", message.data)[0] if message.arbitration_id == 0x081 else 0
            known = code in (0x0000, 0x8210, 0x8220, *self.errors)  # a wrong RPDO length is no loss
            emergency = message.arbitration_id == 0x081 and not known
            self.errors = set() if message.arbitration_id == 0x081 and not code else self.errors | {code}
            ignored = code >> 8 in (0x81, 0x87) and self.node.dictionary.value(0x6007) == 0
            if (emergency and not ignored) or (message.arbitration_id == 0x701 and message.data[0] == 0):
                self.laws.interrupted()
        self.laws.mode = self.node.dictionary.value(0x6061)

    def wait(self, seconds: float) -> None:
        self.clock.sleep_until(self.clock.now() + seconds)
        self.listen()

    def put(self, index: int, sub: int, value: int, size: int) -> None:
        raw = (value & (1 << 8 * size) - 1).to_bytes(size, "little").ljust(4, b"\0")
        self.send(0x601, struct.pack("<BHB", 0x23 | (4 - size) << 2, index, sub) + raw)

    def configure(self) -> None:
        for index, sub, value, size in (
            (0x607D, 1, LOW, 4), (0x607D, 2, HIGH, 4), (0x1016, 1, 0x7F0064, 4), (0x6060, 0, 8, 1),
        ):  # fmt: skip
            self.put(index, sub, value, size)
        self.send(0, b"\x01\x01")

    def cycle(self, word: int) -> None:
        """Sends an RPDO and SYNC, and waits for one period."""
        self.laws.asked(word)
        self.laws.targets = True
        self.send(0x201, struct.pack("<Hi", word, self.target))
        self.send(0x080, b"")
        self.wait(PERIOD_S)

    def word(self, word: int) -> None:
        self.laws.asked(word)
        self.put(0x6040, 0, word, 2)

    def walk(self) -> None:
        self.send(0, b"\x01\x01")
        for word in (0x00, 0x80, 0x06, 0x07, 0x0F):
            self.target = self.node.firmware.motion.actual_position()
            self.cycle(word)
            self.cycle(word)

    def happen(self) -> None:
        """Makes one random event."""
        rng = self.rng
        kind = rng.randrange(30)
        if kind < 2 or 20 <= kind < 23:
            self.walk()
        elif kind < 5 or 23 <= kind < 30:
            step = rng.choice((-300, -50, -1, 0, 1, 40, 250))
            for _ in range(rng.randint(1, 8)):
                self.target += step
                self.cycle(0x0F)
        elif kind == 5:
            self.word(rng.choice(WORDS))
        elif kind == 6:
            self.put(0x6060, 0, rng.choice(MODES), 1)
        elif kind == 7:
            target = rng.choice((0, 5000, -5000, 10**6, -(10**6), 2**31 - 1, rng.randint(LOW, HIGH)))
            self.laws.targets = True
            self.put(rng.choice((0x607A, 0x60C1)), 0 if rng.random() < 0.5 else 1, target, 4)
        elif kind == 8:
            self.word(0x0F)
            self.word(rng.choice((0x1F, 0x3F, 0x5F)))
        elif kind == 9:
            command = rng.choice((1, 1, 2, 128, 129, 130))
            cyclic = self.node.nmt is NmtState.OPERATIONAL and self.laws.mode in (7, 8)
            self.send(0, bytes((command, 1)))
            self.lost(command in (2, 129, 130) or (command == 128 and cyclic))
            if command in (129, 130):
                self.configure()
        elif kind == 10:
            self.wait(rng.choice((0.001, 0.01, 0.05, 0.2)))
        elif kind == 11:
            self.send(0x77F, b"\x05")
        elif kind == 12:
            self.node.faults.raise_error(rng.choice((0x2310, 0x4310, 0x8611)))
            self.node.poll(self.clock.now())
        elif kind == 13:
            self.stage.error_code = rng.choice((0, 0x3210))
        elif kind == 14:
            self.stage.takes = rng.choice((0, 0, 1, 5))
        elif kind == 15:
            faults = self.node.faults
            lost = (faults.boot_up, faults.open_enable_input, lambda: faults.lose_master(0x8130))
            event = rng.choice((*lost, faults.leave_operational))
            cyclic = self.node.nmt is NmtState.OPERATIONAL and self.laws.mode in (7, 8)
            event()
            self.node.poll(self.clock.now())
            self.lost(event != faults.leave_operational or cyclic)
            self.configure()
        elif kind == 16:
            index = rng.choice((0x605A, 0x605B, 0x605C, 0x605D, 0x605E, 0x6007))
            self.put(index, 0, rng.randint(0, 8), 2)
        elif kind == 17:
            data = bytes(rng.randint(0, 255) for _ in range(rng.randint(0, 8)))
            can_id = rng.choice((0x080, 0x201, 0x301, 0x601, 0x000, 0x181))
            if can_id == 0x201 and len(data) >= 6:
                if (word := data[0] | data[1] << 8) & 0x8F == 0x0F:  # any other takes effect only at SYNC
                    self.laws.asked(word)
                self.laws.set_points |= bool(word & 0x10)
                self.laws.targets = True
            if can_id == 0x601 and len(data) == 8 and data[1:4] in (b"\x7d\x60\x01", b"\x7d\x60\x02"):
                return
            self.send(can_id, data)
        elif kind == 18:
            self.send(rng.choice((0x080, 0x201, 0x601)), bytes(8), is_extended_id=True)
        else:
            self.bus_failed()
        self.laws.home = 0.0 - self.node.firmware.motion.home_counts

    def bus_failed(self) -> None:
        self.node.bus_failed()
        self.lost(True)

    def lost(self, really: bool) -> None:
        """Records a loss of the master, unless 6007h = 0 makes the drive ignore it."""
        if really and self.node.dictionary.value(0x6007):
            self.laws.interrupted()


def play_events(seed: int, count: int) -> Laws:
    """Plays random events on a slave; AssertionError if an invariant is violated. Returns the checks with
    their counts.
    """
    rng = Random(seed)
    laws, motor, stage = Laws(), WatchedMotor(rng), TimedStage()
    behaviour = Behaviour.model_validate(
        {
            "controlword": rng.choice(("edge", "level")),
            "sync_timeout_periods": rng.choice((0.0, 3.0)),
            "holds_rpdo": rng.random() < 0.2,
            "rpdo_before_tpdo": rng.random() < 0.5,
            "measures_period": rng.random() < 0.5,
        }
    )
    motor.laws = laws
    with lockstep_bench(motor, EDS, behaviour=behaviour, stage=stage) as (bus, clock, node):
        story = Story(rng, bus, clock, node, stage, motor, laws)
        story.configure()
        story.walk()
        for _ in range(count):
            story.happen()
    return laws
