"""Stepping test by another master through the gateway, compared with the same test by a client of the daemon.

    python tools/bench/gateway.py [--steps 60] [--faults]

Both step the simulated axis of the article, compensated by its model, in simulated time, from the same seed.
The master is the PLC-like one of the tests; it sends a jerk-limited path in cyclic synchronous position mode.
Prints 3 sigma and mean of the load error at rest in each direction, their ratio, the response time to 'enable
operation', and the lag of the loop's set-point behind that of an ideal drive. ``--faults`` instead prints the
table of faults on the outer bus, with the time to stop.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from harness import parser
from support.gateway import COUNTS_PER_DEG, GatewayBench, gateway_bench
from support.gateway_faults import ROWS, measure
from support.service import play

from hdbridge.control.bench import axis_view
from hdbridge.motion import SetPoint
from hdbridge.units import ARCSEC_PER_DEG

STEP_DEG = 1.5
SETTLE_S = 0.4
MEAN_S = 0.1


class Errors:
    """Load errors at rest, arcsec, by direction."""

    def __init__(self) -> None:
        self.found: dict[int, list[float]] = {1: [], -1: []}

    async def take(self, bench: GatewayBench, direction: int, target_deg: float) -> None:
        reader = bench.daemon.memory.reader()
        await bench.wait(MEAN_S)
        samples, _ = reader.read()
        load_deg = float(np.mean(samples["axes"][:, 0]["load_position_deg"]))
        self.found[direction].append(ARCSEC_PER_DEG * (load_deg - target_deg))

    def report(self) -> str:
        parts = [
            f"{name} {3.0 * np.std(self.found[way]):.2f} ({np.mean(self.found[way]):+.2f})"
            for name, way in (("cw", 1), ("ccw", -1))
        ]
        return ", ".join(parts)

    @property
    def three_sigma(self) -> float:
        return 3.0 * float(np.std(self.found[1] + self.found[-1]))


def targets(steps: int) -> list[tuple[int, float]]:
    """Returns direction and target of each step; the first of each direction is not evaluated."""
    up = [(1, STEP_DEG * step) for step in range(steps + 2)]
    return up + [(-1, STEP_DEG * step) for step in range(steps, -1, -1)]


async def direct(bench: GatewayBench, steps: int) -> Errors:
    axis, token = bench.bridge.axes["axis1"], bench.bridge.lease.take("bench", force=True)
    await axis.enable(token)
    errors = Errors()
    for direction, target_deg in targets(steps):
        await axis.motion.move(token, target_deg)
        await bench.wait(SETTLE_S)
        await errors.take(bench, direction, target_deg)
    return errors


async def through(bench: GatewayBench, steps: int) -> tuple[Errors, float, float]:
    await bench.configure()
    await bench.wait(0.5)
    answered_s = await bench.enable()
    plc, limits = bench.plc, axis_view(bench.daemon.axes[0].config).limits
    path = SetPoint(limits, plc.period_s)
    path.reset(plc.target / COUNTS_PER_DEG)
    plc.plan = lambda _: round(COUNTS_PER_DEG * path.step())
    errors, lag_s = Errors(), 0.0
    reader = bench.daemon.memory.reader()
    for number, (direction, target_deg) in enumerate(targets(steps)):
        path.goto(target_deg)
        begun = len(plc.seen)
        await bench.until(lambda: path.at_rest, 30.0)
        if number == 3:
            lag_s = lag(bench, reader, begun)
        reader.read()
        await bench.wait(SETTLE_S)
        await errors.take(bench, direction, target_deg)
    assert not plc.emergencies
    return errors, answered_s, lag_s


def lag(bench: GatewayBench, reader: Any, begun: int) -> float:
    """Returns the best-fit delay of the loop's set-point relative to an ideal drive in the same mode, s."""
    samples, _ = reader.read()
    plc = bench.plc
    times = np.array([time_s for time_s, *_ in plc.seen]) + plc.period_s
    wanted = np.array([target for *_, target in plc.seen]) / COUNTS_PER_DEG
    at, place = 1e-9 * samples["time_ns"], samples["axes"][:, 0]["load_target_deg"]
    inside = (at > plc.seen[begun][0]) & (at < times[-1])
    delays = np.arange(0.0, 0.02, 1e-5)
    misfit = [np.sum((np.interp(at[inside] - delay, times, wanted) - place[inside]) ** 2) for delay in delays]
    return float(delays[int(np.argmin(misfit))])


def print_faults() -> None:
    def ms(time_s: float) -> str:
        return f"{1e3 * time_s:.0f}" if math.isfinite(time_s) else "-"

    print("| fault | EMCY | stands, ms | no power, ms |\n|---|---|---|---|")
    for row in ROWS:
        with tempfile.TemporaryDirectory() as folder:
            seen = measure(Path(folder), row)
        codes = ", ".join(f"{each:04X}h" for each in seen.codes) or "-"
        print(f"| {row.name} | {codes} | {ms(seen.stands_s)} | {ms(seen.unpowered_s)} |", flush=True)


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--steps", type=int, default=60)
    options.add_argument("--faults", action="store_true")
    given = options.parse_args()
    if given.faults:
        print_faults()
        return
    reference = 0.0
    for outer_ms in (None, 4.0, 10.0):
        with (
            tempfile.TemporaryDirectory() as folder,
            gateway_bench(Path(folder), 1e-3 * (outer_ms or 4.0)) as bench,
        ):

            async def run(bench: GatewayBench = bench, outer_ms: float | None = outer_ms) -> Any:
                async with bench.service.ready() as bridge:
                    bench.bridge = bridge
                    if outer_ms is None:
                        return await direct(bench, given.steps), 0.0, 0.0
                    return await through(bench, given.steps)

            errors, answered_s, lag_s = play(run())
            period_s = bench.daemon.period_s
        if outer_ms is None:
            reference = errors.three_sigma
            print(f"client of the daemon    3 sigma (mean), arcsec: {errors.report()}", flush=True)
            continue
        print(
            f"gateway, SYNC {outer_ms:g} ms    3 sigma (mean), arcsec: {errors.report()}; pooled "
            f"{errors.three_sigma / reference:.3f} x the client's; enabled after {1e3 * answered_s:.0f} ms; "
            f"set-point {lag_s / period_s:.2f} inner cycles behind an ideal drive",
            flush=True,
        )


if __name__ == "__main__":
    main()
