"""A keeper whose children stand in for the real ones."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from hdbridge.daemon.keeper import Keeper, Programs, Times
from hdbridge.daemon.logs import LogSettings, begin_log
from hdbridge.daemon.machine import Machine
from hdbridge.daemon.memory import Memory
from hdbridge.daemon.notify import Notifier
from hdbridge.daemon.start import Start

STANDIN = str(Path(__file__).with_name("standin.py"))

if __name__ == "__main__":
    begin_log(LogSettings())
    machine = Machine.find("article")
    programs = Programs((STANDIN, "control"), (STANDIN, "service"))
    with Memory.create(1, machine.cycle_s) as memory:
        keeper = Keeper(
            Start(machine, memory.fd, os.getpid()), memory, (), Notifier.of_environment(), programs,
            Times(hung_s=3.0, service_hung_s=4.0),
        )  # fmt: skip
        sys.exit(keeper.run())
