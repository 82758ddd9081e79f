"""Harness of the tools that measure random axes: command line, benches, calibrations."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from hdbridge.axis import AxisConfig
from hdbridge.commissioning.calibration import Calibration, Journal, calibrate
from hdbridge.control.bench import Bench
from hdbridge.drive.drive import Drive
from hdbridge.motion.procedures.plan import Plan
from hdbridge.records.recording import Recording
from hdbridge.sim.lockstep import simulated_bench
from hdbridge.sim.truth import Truth

DEMO = Path(__file__).parents[1] / "profiles" / "demo"
DATE = datetime(2026, 1, 1, tzinfo=UTC)


def parser(text: str, axes: int, first: int = 1, workers: int | None = None) -> argparse.ArgumentParser:
    """Returns a parser with the common options: number of axes, first seed, and optionally processes."""
    made = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--axes", type=int, default=axes)
    made.add_argument("--first", type=int, default=first, help="seed of the first axis")
    if workers is not None:
        made.add_argument("--workers", type=int, default=workers)
    return made


def seeds(options: argparse.Namespace) -> range:
    """Returns the seeds of the axes."""
    return range(options.first, options.first + options.axes)


def drawn_orders(rng: np.random.Generator, count: int) -> list[dict[str, Any]]:
    """Draws motor orders of 1 to 10 with amplitudes of 0.8 to 14 arcsec, as in a truth file."""
    return [
        {
            "order": int(order),
            "amplitude_arcsec": float(np.exp(rng.uniform(math.log(0.8), math.log(14.0)))),
            "phase_deg": float(rng.uniform(-180.0, 180.0)),
        }
        for order in sorted(rng.choice(np.arange(1, 11), count, replace=False))
    ]


@contextmanager
def simulated(axis: AxisConfig, truth: Truth, seed: int) -> Iterator[tuple[Drive, Any]]:
    """Boots a simulated axis over frames; yields its drive and its clock."""
    with (
        simulated_bench(truth, axis.eds_path, axis.drive.node_id, seed) as (bus, clock, _),
        Drive(bus, axis, clock) as drive,
    ):
        drive.boot()
        yield drive, clock


def recorded(drive: Drive, plan: Plan) -> Recording:
    """Runs a plan on the bench, task by task, and joins the recordings."""
    bench = Bench(drive)
    runs = [bench.run(task.procedure) for task in plan.tasks(bench.view).tasks]
    return Recording.joined([Recording(run.record, run.segments, run.axis, run.ratio) for run in runs])


def calibrated(
    axis: AxisConfig, truth: Truth, plan: str, seed: int, folder: Path
) -> tuple[Calibration, float]:
    """Calibrates an axis without a model, stepping test included; returns the result and the axis time, s."""
    with simulated(axis, truth, seed) as (drive, clock):
        return calibration(drive, Plan.load(plan), folder), clock.now()


def calibration(drive: Drive, plan: Plan, folder: Path) -> Calibration:
    """Calibrates a booted axis without a model, stepping test included; ``folder`` becomes its profile."""
    content = drive.axis.model_dump(mode="json", by_alias=True, exclude_none=True)
    (folder / "axis.yaml").write_text(yaml.safe_dump(content))
    journal = Journal.create(folder / "recording", drive.axis, plan, DATE, drive.identity)
    return calibrate(drive, journal, folder, DATE)
