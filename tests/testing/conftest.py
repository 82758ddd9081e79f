"""A program, independent of hdbridge, that moves the simulated drive in lockstep by raw frames."""

import shutil
import struct
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from support.rawmaster import FrameMaster

from hdbridge.files.profile import bundled_profile
from hdbridge.testing import SimulatedDrive, simulated_drive

PERIOD_S = 0.004
STEP_COUNTS = 40
"""Motion of the motor per cycle: 9 deg/s at the load of the profile 'article'."""


class Program(FrameMaster):
    """Raw frames of CiA 301 and CiA 402 on a bus of python-can."""

    def __init__(self, drive: SimulatedDrive) -> None:
        super().__init__(drive.open_bus(), drive)
        self.drive, self.target = drive, 0

    def start(self) -> None:
        """Enables the drive in cyclic synchronous position, with its own watchdogs set."""
        for index, subindex, value, size in (
            (0x6060, 0, 8, 1), (0x1017, 0, 50, 2), (0x1400, 5, 20, 2),
            (0x6065, 0, 2000, 4), (0x6066, 0, 20, 2),
        ):  # fmt: skip
            self.put(index, subindex, value, size)
        self.send(0x000, b"\x01\x01")
        for word in (0x00, 0x06, 0x06, 0x07, 0x07, 0x0F, 0x0F):
            self.cycle(word, step=0)
        assert self.drive.state == "operation enabled"

    def cycle(self, word: int = 0x0F, step: int = STEP_COUNTS) -> list[can.Message]:
        """Runs one period: SYNC, its TPDOs, which are returned, and an RPDO."""
        self.take()
        self.send(0x080)
        answers = self.messages()
        self.target += step
        self.send(0x201, struct.pack("<Hi", word, self.target))
        self.drive.sleep(PERIOD_S)
        return answers

    def move(self, cycles: int) -> list[list[can.Message]]:
        return [self.cycle() for _ in range(cycles)]


@pytest.fixture
def second_axis(tmp_path: Path) -> Path:
    """Provides a profile of node 2."""
    folder = tmp_path / "second"
    shutil.copytree(bundled_profile("article"), folder)
    axis = folder / "axis.yaml"
    axis.write_text(
        axis.read_text(encoding="utf-8").replace("node_id: 1\n", "node_id: 2\n"), encoding="utf-8"
    )
    return folder


@pytest.fixture
def drive() -> Iterator[SimulatedDrive]:
    with simulated_drive("article", bus="lockstep") as made:
        yield made


@pytest.fixture
def program(drive: SimulatedDrive) -> Program:
    """Provides a program whose drive is enabled and moves at constant speed."""
    made = Program(drive)
    made.start()
    made.move(30)
    made.seen.clear()
    return made
