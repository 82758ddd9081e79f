"""The processes that replay side by side give what one alone gives, and end with the one that began them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
from support.exercised import record_of

from hdbridge.axis import AxisConfig
from hdbridge.records.recording import Recording
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.truth import Truth
from hdbridge.twin.misfit import Replays, prepare
from hdbridge.twin.parameters import with_values

DEMO = Path(__file__).parents[2] / "profiles" / "demo"
WORK = """
import sys
from hdbridge.axis import AxisConfig
from hdbridge.records.recording import Recording
from hdbridge.sim.truth import Truth
from hdbridge.twin.misfit import prepare
from hdbridge.twin.misfit import Replays
truth = Truth.load(sys.argv[1])
data = prepare(Recording.load(sys.argv[2]), AxisConfig.load(sys.argv[1]), truth)
with Replays(data, 2) as replays:
    while replays([truth, truth]):
        print("replayed", flush=True)
"""


def moves(bench: Exercise) -> None:
    bench.move(400.0, 600.0, 6000.0)
    bench.hold(1.5)


def recorded() -> Recording:
    return Recording(record_of(Truth.load(DEMO), moves), axis="demo", ratio=50.0)


def test_two_processes_give_what_one_gives() -> None:
    truth = Truth.load(DEMO)
    truths = [with_values(truth, {"Coulomb friction": each}) for each in (0.034, 0.05)]
    data = prepare(recorded(), AxisConfig.load(DEMO), truth)
    with Replays(data, 1) as alone, Replays(data, 2) as together:
        for few in (False, True):
            ones, others = (each.rough(truths) if few else each(truths) for each in (alone, together))
            for one, other in zip(ones, others, strict=True):
                assert all(np.array_equal(one[name], other[name]) for name in one)


def test_workers_end_when_the_process_that_began_them_is_killed(tmp_path: Path) -> None:
    recorded().save(tmp_path / "recording")
    command = [sys.executable, "-c", WORK, str(DEMO), str(tmp_path / "recording")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "replayed\n"
        process.kill()
        # The workers have its standard output too: it ends when the last of them has ended.
        process.communicate()
