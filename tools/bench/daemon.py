"""Cost of clients for the daemon's control loop: CPU time of a turn and lateness, against idle and the bench.

    python tools/bench/daemon.py [--rounds 5] [--seconds 12] [--json FILE]

One run, rounds of three phases, one after the other:

  bench    `Cycle.tick` with compensation on the path of a move, in a process that does nothing else
  idle     the daemon, its axis on the same path, and nobody connected
  busy     the daemon with ten clients (four poll the state, five watch every sample, one streams set-points)
           and a live page, its flight recorder on

The daemon is `hdbridge run` with its own processes; its simulated drive lives in real time in the control
process (`daemon_realtime.py`), as the bench's does in the bench's. So the drive's cost is in all three. Both
processes have SCHED_FIFO and locked memory.

  cpu      CPU time of the process for a turn, from the kernel's schedstat
  busy     from the wake-up to the end of the turn, by the clock
  late     from the deadline to the wake-up

Figures are medians over the rounds, of phases in which the axis stayed enabled. A machine that stalls shows
in the lateness of all three: compare them with each other.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from daemon_loop import bench_cycle
from daemon_realtime import RealClock
from rundaemon import CONTROL, SERVICE, Clients, Cost, RunningDaemon, running

from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.client import Client
from hdbridge.control.realtime import prepare_realtime
from hdbridge.daemon.memory import Memory
from hdbridge.drive.drive import Drive
from hdbridge.errors import HdbridgeError
from hdbridge.files.profile import Profile
from hdbridge.sim.lockstep import SimulatedAxis, simulated_benches

HERE: Final = Path(__file__).resolve().parent
PATIENCE: Final = 5
"""Maximum number of attempts at a phase without a stop of the axis."""
KINDS: Final = ("bench", "idle", "busy")


@dataclass(frozen=True)
class Phase:
    """Figures of one phase, microseconds."""

    turns: int
    cpu_us: float
    busy_us: float
    busy_999_us: float
    late_us: float
    late_99_us: float
    late_999_us: float
    late_most_us: float
    skipped: int
    service_share: float = 0.0
    """Returns the CPU time of the service as a share of a processor."""

    @classmethod
    def of(cls, late_us: Any, busy_us: Any, cpu_us: float, skipped: int, service_share: float = 0.0) -> Phase:
        late = [float(each) for each in np.percentile(late_us, [50.0, 99.0, 99.9, 100.0])]
        busy = [float(each) for each in np.percentile(busy_us, [50.0, 99.9])]
        return cls(len(late_us), cpu_us, *busy, *late, skipped, service_share)


# -------------------------------------------------------------------- the bench


def bench_phase(seconds: float) -> Phase:
    """Runs one phase of the bench's cycle in this process; raises HdbridgeError if a stall stopped it."""
    profile = Profile.find("article")
    config = AxisConfig.load(profile.axis)
    clock = RealClock()
    axes = [SimulatedAxis(profile.truth, config.eds_path, config.drive.node_id)]
    with simulated_benches(axes, clock=clock) as (bus, _, _), prepare_realtime():
        drive = Drive(bus, config, clock, force=True)
        drive.boot()
        drive.enable()
        turn, cycle = bench_cycle(bus, TransmissionModel.load(profile.model), config, clock, drive.image)
        for _ in range(100):
            turn()
        turns = round(seconds / config.drive.cycle_s)
        late_s, busy_s = np.zeros(turns), np.zeros(turns)
        skipped = cycle.skipped
        begin_s = time.thread_time()
        for place in range(turns):
            turn()
            late_s[place], busy_s[place] = clock.late_s, time.monotonic() - clock.woke_s
        cpu_us = 1e6 * (time.thread_time() - begin_s) / turns
    return Phase.of(1e6 * late_s, 1e6 * busy_s, cpu_us, cycle.skipped - skipped)


def serve_bench() -> int:
    """Runs a phase for each line of input."""
    warnings.simplefilter("ignore")
    for line in sys.stdin:
        for _ in range(PATIENCE):
            with suppress(HdbridgeError):
                print(json.dumps(asdict(bench_phase(float(line)))), flush=True)
                break
        else:
            print("null", flush=True)
    return 0


class Bench:
    """Bench in a process of its own."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, __file__, "--bench"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def phase(self, seconds: float) -> Phase | None:
        """Returns the figures of a phase; None if the machine stalled too often."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(f"{seconds}\n")
        self.process.stdin.flush()
        found = json.loads(self.process.stdout.readline())
        return None if found is None else Phase(**found)

    def close(self) -> None:
        """Ends the process."""
        self.process.kill()
        self.process.wait()


# -------------------------------------------------------------------- the daemon


def moving(daemon: RunningDaemon) -> None:
    """Enables the axis and starts a long move; the client has disconnected on return."""
    with Client(str(daemon.socket), name="bench", timeout_s=60.0) as client, client.lease(force=True):
        (axis,) = client.axes.values()
        state = axis.state()
        if state.fault is not None or state.state in ("quick-stopped", "latched"):
            axis.reset()
        if axis.state().state != "enabled":
            axis.enable()
        here = axis.state().load_target_deg or 0.0
        axis.move(-300.0 if here > 0.0 else 300.0, velocity_deg_s=2.0, wait=False)


def measured(daemon: RunningDaemon, memory: Memory, seconds: float) -> Phase | None:
    """Returns the loop's own figures over a duration; None if the axis was stopped in it."""
    pids = daemon.pids()
    reader = memory.reader()
    reader.read()
    before, turns = {name: Cost.of(pid) for name, pid in pids.items()}, memory.status.loop_count
    begin_s = time.monotonic()
    found = []
    while time.monotonic() < begin_s + seconds:
        time.sleep(1.0)
        found.append(reader.read()[0])
    after, turns = {name: Cost.of(pid) for name, pid in pids.items()}, memory.status.loop_count - turns
    share = (after[SERVICE].cpu_s - before[SERVICE].cpu_s) / (time.monotonic() - begin_s)
    samples = np.concatenate(found)
    if not (samples["axes"]["state"] == ENABLED).all():
        return None
    return Phase.of(
        samples["late_us"],
        samples["busy_us"],
        1e6 * (after[CONTROL].cpu_s - before[CONTROL].cpu_s) / turns,
        int(samples["skipped"][-1]) - int(samples["skipped"][0]),
        share,
    )


ENABLED: Final = 3


def daemon_phase(
    daemon: RunningDaemon, memory: Memory, seconds: float, clients: Clients | None
) -> Phase | None:
    """Runs one phase of the daemon, with clients or without."""
    for _ in range(PATIENCE):
        try:
            moving(daemon)
        except HdbridgeError as error:
            print(f"  {error}", flush=True)
            time.sleep(1.0)
            continue
        if clients is not None:
            clients.say("on")
            time.sleep(4.0)  # until they are connected and the stream runs
        phase = measured(daemon, memory, seconds)
        if clients is not None:
            clients.say("off")
        if phase is not None:
            return phase
    return None


def table(phases: dict[str, list[Phase]]) -> str:
    """Returns medians and their ratios."""
    names = [name for name in Phase.__dataclass_fields__ if name != "turns"]
    medians = {
        kind: {name: statistics.median(getattr(each, name) for each in found) for name in names}
        for kind, found in phases.items()
        if found
    }
    lines = [
        f"{'':<14}" + "".join(f"{kind:>10}" for kind in medians) + f"{'busy/idle':>11}{'busy/bench':>11}"
    ]
    for name in names:
        values = {kind: medians[kind][name] for kind in medians}
        row = f"{name:<14}" + "".join(
            f"{value:>10.1f}" if name != "service_share" else f"{value:>10.2f}" for value in values.values()
        )
        for other in ("idle", "bench"):
            known = "busy" in values and values.get(other, 0.0) > 0.0 and name.endswith("us")
            row += f"{values['busy'] / values[other]:>10.2f}x" if known else f"{'':>11}"
        lines.append(row)
    lines.append("phases        " + "".join(f"{len(found):>10}" for found in phases.values() if found))
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=12.0, help="of each phase")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--bench", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.bench:
        return serve_bench()
    phases: dict[str, list[Phase]] = {kind: [] for kind in KINDS}
    bench = Bench()
    program = (str(HERE / "daemon_realtime.py"),)
    try:
        with (
            tempfile.TemporaryDirectory(prefix="bench-") as folder,
            running(Path(folder), "--moving", "stream", program=program) as (daemon, clients),
            daemon.memory() as memory,
        ):
            for number in range(options.rounds):
                for kind in KINDS:
                    if kind == "bench":
                        phase = bench.phase(options.seconds)
                    else:
                        wanted = clients if kind == "busy" else None
                        phase = daemon_phase(daemon, memory, options.seconds, wanted)
                    print(
                        f"round {number + 1}: {kind}: {phase or 'stopped by a stall each time'}", flush=True
                    )
                    if phase is not None:
                        phases[kind].append(phase)
            seen = clients.seen()
    finally:
        bench.close()
    print(table(phases))
    print("clients:", json.dumps(seen))
    if options.json is not None:
        found = {kind: [asdict(each) for each in phases[kind]] for kind in KINDS}
        options.json.write_text(json.dumps({**found, "clients": seen}, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
