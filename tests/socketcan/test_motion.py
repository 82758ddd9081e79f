"""Ripple and path error through a whole daemon on a real CAN stack: moves, and streams of set-points.

As a script it prints the figures at the given speeds:

    PYTHONPATH=tests:. tools/socketcan.sh --slowed 400 .venv/bin/python -m tests.socketcan.test_motion 38 76
"""

import math
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import pytest
from support import patience
from support.daemon_bench import OURS, Cable
from support.running import running

from hdbridge import TransmissionModel
from hdbridge.axis import AxisConfig
from hdbridge.client import Client
from hdbridge.client.sync import Axis
from hdbridge.control.bench import axis_view
from hdbridge.errors import HdbridgeError
from hdbridge.motion.procedures.moves import MoveTo, Sample
from hdbridge.motion.procedures.path_test import PathRun

KNOT_S: Final = 0.02
EVEN_S: Final = 1.2
COLUMNS: Final = ("load_target_deg", "load_position_deg", "motor_position_deg", "velocity_deg_s")
VARIANTS: Final = ("none", "static", "filtered")


class Recorder:
    """Live samples of one axis."""

    def __init__(self, client: Client, axis: Axis) -> None:
        self._client, self._axis = client, axis
        self._rows: list[tuple[float, ...]] = []
        self._skipped = 0
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        name = self._axis.name
        with suppress(HdbridgeError):  # the daemon ends
            for batch in self._client.live(axes=[name]):
                assert batch.lost == 0
                self._skipped = batch.skipped[-1]
                self._rows += zip(*(getattr(batch.axes[name], each) for each in COLUMNS), strict=True)

    def of(self, motion: Callable[[], object], rest_deg: float) -> np.ndarray:
        """Returns the samples from the beginning of a motion until it has rested at its end.

        Repeats a motion in which this machine stalled: a skipped period stops the path for as long.
        """
        while True:
            self._axis.move(-20.0)
            self._axis.move(0.0)  # the gear's hysteresis begins in the same state
            skipped = self._skipped
            samples = self._samples(motion, rest_deg)
            if self._skipped == skipped:
                return samples

    def _samples(self, motion: Callable[[], object], rest_deg: float) -> np.ndarray:
        begin = len(self._rows)
        motion()
        patience.until(lambda: sum(row[0] == rest_deg for row in self._rows[begin:]) > 100, lambda: "rest")
        return np.array(self._rows[begin:], dtype=[(each, float) for each in COLUMNS])


@contextmanager
def moving_axis(folder: Path, profile: Path) -> Iterator[tuple[Axis, Recorder]]:
    """Provides an enabled axis of a daemon on the cable."""
    (folder / "machine.yaml").write_text(
        f"schema: hdbridge.machine/1\nname: fast\naxes: [{{profile: {profile}}}]\n"
        f"bus: {{interface: socketcan, channel: {OURS}}}\n",
        encoding="utf-8",
    )
    cable = Cable(profile)
    cable.plug()
    try:
        with running(folder, folder, name="fast") as daemon:
            daemon.until_notified("READY=1")
            daemon.until_axis("disabled")
            with Client(str(daemon.socket)) as client, client.lease():
                axis = client.axis(AxisConfig.load(profile).name)
                axis.enable()
                try:
                    yield axis, Recorder(client, axis)
                except BaseException:
                    print(*daemon.events_since(), sep="\n")
                    raise
    finally:
        cable.unplug()


def figures(folder: Path, speeds: tuple[float, ...]) -> dict[str, np.ndarray]:
    """Returns ripple and path error, arcsec rms, shape (speeds, 2, variants), of moves and of streams."""
    # Not with the other tests of this folder: scipy takes seconds to load in user-mode-linux.
    from support.raised import measured_response, raised_profile, ripple_arcsec

    from hdbridge.commissioning.calibration.path import path_errors

    found = {"goto": np.empty((len(speeds), 2, 3)), "streamed": np.empty((len(speeds), 2, 3))}
    profile = raised_profile(folder / "fast")
    with (profile / "axis.yaml").open("a", encoding="utf-8") as file:
        file.write("\nrealtime: {priority: 7, cpus: [0]}\n")
    model = TransmissionModel.load(profile / "model.yaml")
    models = (model.only(()), model, replace(model, response=measured_response(profile)))
    with moving_axis(folder, profile) as (axis, recorder):
        limits = axis_view(AxisConfig.load(profile)).limits
        for place, speed in enumerate(speeds):
            far_deg = math.ceil(speed * (EVEN_S + speed / limits.acceleration_deg_s2))
            runs: dict[str, list[np.ndarray]] = {"goto": [], "streamed": []}
            for used in models:
                used.save(profile / "model.yaml")
                axis.activate_model("active")
                for name, motion in (("goto", goto), ("streamed", streamed)):
                    path = MoveTo(far_deg, speed, acceleration_deg_s2=0.6 * limits.acceleration_deg_s2)
                    runs[name].append(recorder.of(partial(motion, axis, path, limits), far_deg))
            for name, variants in runs.items():
                found[name][place, 0] = [ripple_arcsec(each, speed) for each in variants]
                errors = path_errors([[path_run(each)] for each in variants], model.ratio, 0.0)
                found[name][place, 1] = [each.path_arcsec for (each,) in errors]
    return found


def goto(axis: Axis, path: MoveTo, _: object) -> None:
    axis.move(path.load_deg, velocity_deg_s=path.velocity_deg_s, acceleration_deg_s2=path.acceleration_deg_s2)


def streamed(axis: Axis, path: MoveTo, limits: object) -> None:
    way = path.path(0.0, limits)
    with axis.stream() as stream:
        stream.put((t, way.at(t)) for t in np.arange(0.0, way.duration_s + 2.0 * KNOT_S, KNOT_S).tolist())


def path_run(samples: np.ndarray) -> PathRun:
    """Returns the samples in motion, and the samples of the rest after it."""
    rows = [Sample(0.004 * at, row[0], math.nan, row[2], row[1], 0.0) for at, row in enumerate(samples)]
    moved = np.flatnonzero(np.diff(samples["load_target_deg"]))
    return PathRun("", tuple(rows[moved[0] : moved[-1] + 2]), tuple(rows[moved[-1] + 2 :]))


@pytest.mark.slow  # 50 s of CPU time
def test_the_filtered_correction_removes_the_ripple(tmp_path: Path) -> None:
    for name, found in figures(tmp_path, (76.0,)).items():
        ripple, path = found[0]
        assert ripple[1] > 0.5 * ripple[0], (name, found)
        assert ripple[2] < 0.12 * ripple[0], (name, found)
        assert path[2] < 0.5 * path[1] < 0.5 * path[0], (name, found)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        speeds = tuple(map(float, sys.argv[1:]))
        for way, found in figures(Path(name), speeds).items():
            for speed, rows in zip(speeds, found.tolist(), strict=True):
                cells = (
                    f"{label} {one:.2f}" for row in rows for label, one in zip(VARIANTS, row, strict=True)
                )
                print(f"{way} {speed:g} deg/s, ripple and path error: {', '.join(cells)}")
