"""Code that several processes have compiled and kept on disk runs together in one."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("numba")

ARTICLE = Path(__file__).parents[2] / "profiles" / "article"
NAME = """
import sys, numba
from numba.core.itanium_mangler import mangle_type
from hdbridge.sim import compiled
from hdbridge.sim.plant import Plant
compiled._register()
for room in map(int, sys.argv[1:]):
    print(mangle_type(numba.from_dtype(compiled._layout_of(Plant, room))))
"""
MOVE = """
import math, sys
from hdbridge.sim import fast
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth
fast.waiting.left = 0
truth = Truth.load(sys.argv[1])
for dead_time_ms in map(float, sys.argv[2:]):
    servo = truth.servo.model_copy(update={"dead_time_ms": dead_time_ms})
    readings = []
    for may_compile in (True, False):
        machine = Machine(truth.model_copy(update={"servo": servo}), 0, may_compile=may_compile)
        place = 0.0
        for cycle in range(200):
            step = 20.0 * math.sin(cycle / 10.0)
            machine.follow(place, place + step, 8)
            place += step
            readings.append((machine.motor_counts, machine.load_counts, machine.torque_nm))
        print(type(machine._axis).__name__)
    print(readings[:200] == readings[200:])
"""


def said(program: str, *arguments: object, **environment: str) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.splitlines()


def test_layout_names_are_unique_and_stable_between_processes(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["", "16", "32"])
    exec(NAME, {})
    small, large = capsys.readouterr().out.splitlines()
    assert small != large
    assert said(NAME, 32) == [large]


@pytest.mark.slow
def test_layouts_that_two_processes_compiled_run_side_by_side_in_a_third(tmp_path: Path) -> None:
    """A dead time of 11 ms takes more room than one of 1 ms."""
    for dead_times in ([1.0], [11.0], [1.0, 11.0, 1.0], [11.0, 1.0]):
        output = said(MOVE, ARTICLE, *dead_times, NUMBA_CACHE_DIR=str(tmp_path), HDBRIDGE_COMPILE="1")
        assert output == ["CompiledAxis", "Axis", "True"] * len(dead_times)
