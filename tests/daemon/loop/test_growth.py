"""A cycle of the loop leaks no memory, so the loop can run for months."""

import gc
import math
import tracemalloc

from support.daemon import SteppedDaemon

from hdbridge.daemon.memory import CommandKind, RelayedFrame

TURNS = 240


def work(daemon: SteppedDaemon) -> None:
    """Moves, jogs, refused commands, and a service that reads."""
    for turn in range(TURNS):
        match turn % 40:
            case 0:
                daemon.post(CommandKind.MOVE, 0, a=1.0 if turn % 80 else -1.0, b=math.nan, c=math.nan)
            case 10:
                daemon.post(CommandKind.JOG, 0, a=2.0, b=0.05)
            case 20:
                daemon.post(CommandKind.MOVE, 0, a=math.inf)
            case 30:
                daemon.memory.outgoing.add(RelayedFrame(0, 0x201, b""))
                daemon.samples.read()
        daemon.turn()
    daemon.events.clear()
    gc.collect()


def test_nothing_grows(enabled: SteppedDaemon) -> None:
    # Otherwise each of the five collections traverses everything that the other tests have loaded.
    gc.freeze()
    try:
        for _ in range(2):
            work(enabled)
        tracemalloc.start()
        work(enabled)
        before, _ = tracemalloc.get_traced_memory()
        work(enabled)
        work(enabled)
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
        gc.unfreeze()
    # A leak of a hundred bytes per cycle would be some 20 MB a day.
    assert after - before < 16 * 2 * TURNS
