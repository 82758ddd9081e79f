"""Samples and a machine for the tests of the flight recorder."""

from pathlib import Path
from typing import Any

import numpy as np

from hdbridge.axis import AxisConfig
from hdbridge.daemon.machinefile import RecorderSettings
from hdbridge.daemon.memory import AXIS_SAMPLE, Event, EventKind, sample_dtype
from hdbridge.daemon.recorder.flightfile import About, AxisAbout
from hdbridge.daemon.recorder.flightlog import FlightLog

AXIS = AxisConfig.load("profiles/demo")
PERIOD_S = 0.004
START_NS = 1_790_000_000_000_000_000
"""Time of day at time zero of the samples, ns since the epoch."""
ROOM = 10**12


def about(axes: int = 1) -> About:
    known = AxisAbout.of(AXIS)
    names = ("demo", "tilt", "roll", "lift", "wrist", "grip")
    return About(
        "cell",
        PERIOD_S,
        tuple(AxisAbout(each, known.ratio, known.text, known.identity) for each in names[:axes]),
    )


def samples(count: int, first: int = 1, axes: int = 1) -> Any:
    """Returns samples whose values all differ, so that a mix-up is detected."""
    random = np.random.default_rng([0, first])
    made = np.zeros(count, sample_dtype(axes))
    made["sequence"] = first + np.arange(count)
    made["cycle"] = first + np.arange(count)
    made["time_ns"] = (made["cycle"] * PERIOD_S * 1e9).astype(np.int64)
    for name in ("late_us", "busy_us", "bus_load"):
        made[name] = random.uniform(0.0, 100.0, count)
    for name in AXIS_SAMPLE.names or ():
        kind = AXIS_SAMPLE[name]
        size = (count, axes)
        made["axes"][name] = (
            random.normal(0.0, 100.0, size) if kind.kind == "f" else random.integers(0, 5, size).astype(kind)
        )
    made["axes"]["fault"] = 255
    made["axes"]["statusword"] = 0xFFFF
    made["axes"]["state"] = 3
    made["axes"]["flags"] = 1 | 8
    return made


def event(time_s: float, kind: EventKind = EventKind.STOPPED, text: str = "the axis was stopped") -> Event:
    return Event(1, int(time_s / PERIOD_S), int(time_s * 1e9), 0, kind, 0, 3, text)


class Clock:
    """Settable clock, which begins at the time of day of the samples."""

    def __init__(self) -> None:
        self.ns = START_NS

    def __call__(self) -> int:
        return self.ns


def flight_log(
    folder: Path, reported: list[str] | None = None, free: Any = None, axes: int = 1, **limits: float
):
    """Returns a flight log, which is the recorder without its thread, and its clock."""
    clock = Clock()
    settings = RecorderSettings(**{"free_mb": 0.0, **limits})
    notify = reported.append if reported is not None else (lambda _: None)
    free = free or (lambda _: ROOM)
    return FlightLog(folder, settings, about(axes), notify=notify, wall_ns=clock, free=free), clock
