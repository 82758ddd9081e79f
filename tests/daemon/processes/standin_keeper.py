"""A keeper with stand-ins for its children."""

import os
import sys
from pathlib import Path
from types import SimpleNamespace

from hdbridge.daemon.keeper import Keeper, Notifier, Programs, Times
from hdbridge.daemon.logs import LogSettings, begin_log
from hdbridge.daemon.memory import Memory
from hdbridge.daemon.start import Start
from hdbridge.drive.interfacelock import InterfaceLock

STANDIN = str(Path(__file__).with_name("standin.py"))
CYCLE_S = 0.004

if __name__ == "__main__":
    begin_log(LogSettings())
    # Only the attributes that the keeper uses; a complete machine takes each process a second to load.
    machine = SimpleNamespace(
        name="article",
        axes=(SimpleNamespace(name="article"),),
        limits=SimpleNamespace(restarts_per_minute=3),
        gateway=True if "HDBRIDGE_TEST_WITH_GATEWAY" in os.environ else None,
    )
    programs = Programs((STANDIN, "control"), (STANDIN, "service"), (STANDIN, "gateway"))
    lock = InterfaceLock("socketcan", "can0", Path(os.environ["HDBRIDGE_TEST_LOCKS"]))
    lock.acquire()
    with Memory.create(1, CYCLE_S) as memory:
        keeper = Keeper(
            Start(machine, memory.fd, os.getpid()), memory, (), Notifier.of_environment(), programs,
            Times(
                hung_s=3.0, service_hung_s=4.0, gateway_hung_s=4.0,
                collected_s=float(os.environ.get("HDBRIDGE_TEST_COLLECTED_S", "10")),
            ), lock,
        )  # fmt: skip
        sys.exit(keeper.run())
