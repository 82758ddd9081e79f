"""Cost of the flight recorder: CPU time per message, fraction of a core, bytes per hour.

    python tools/bench/recorder.py [--seconds 120]

For one axis and for six, a machine in motion is recorded, second by second as in the daemon, onto the disk of
the temporary folder. The axes alternately move and rest; angles are whole counts, and the load encoder is
noisy. CPU time is that of the thread, without that of the disk.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from harness import parser

from hdbridge.daemon.machinefile import RecorderSettings
from hdbridge.daemon.memory import sample_dtype
from hdbridge.daemon.recorder.flightfile import About, AxisAbout
from hdbridge.daemon.recorder.flightlog import Batch, FlightLog
from hdbridge.daemon.recorder.reading import read

RATIO, RATE_HZ = 50.0, 250
MOTOR_COUNTS, LOAD_COUNTS = 8_000, 2_880_000


def at_work(seconds: int, axes: int) -> Any:
    """Returns samples of axes that alternately move for 2 s and rest for 1 s."""
    random = np.random.default_rng(1)
    count = seconds * RATE_HZ
    samples = np.zeros(count, sample_dtype(axes))
    samples["sequence"] = samples["cycle"] = 1 + np.arange(count)
    samples["time_ns"] = (1 + np.arange(count)) * (10**9 // RATE_HZ) + random.integers(-50_000, 50_000, count)
    samples["late_us"] = random.gamma(2.0, 30.0, count)
    samples["busy_us"] = random.gamma(20.0, 20.0, count)
    samples["bus_load"] = 0.2
    time_s = np.arange(count) / RATE_HZ
    for place in range(axes):
        axis = samples["axes"][:, place]
        phase = (time_s + 0.5 * place) % 3.0
        speed = np.where(phase < 2.0, 10.0 * np.sin(np.pi * phase / 2.0) ** 2, 0.0)
        speed *= np.where((time_s + 0.5 * place) // 3.0 % 2, -1.0, 1.0)
        target = np.cumsum(speed) / RATE_HZ
        axis["state"], axis["power"], axis["fault"], axis["statusword"] = 3, 4, 255, 0x1237
        axis["mode"] = speed != 0.0
        axis["flags"] = 1 | 2 | 8
        axis["load_target_deg"], axis["velocity_deg_s"] = target, speed
        error = 13.0 * np.cos(2.0 * np.radians(RATIO * target)) + 30.0 * np.sign(speed)
        axis["predicted_arcsec"] = axis["correction_arcsec"] = error
        axis["issued_deg"] = RATIO * (target - error / 3600.0)
        axis["motor_target_deg"] = _counted(axis["issued_deg"], MOTOR_COUNTS)
        axis["motor_position_deg"] = _counted(axis["issued_deg"], MOTOR_COUNTS)
        axis["load_position_deg"] = _counted(target + random.normal(0.0, 0.3 / 3600.0, count), LOAD_COUNTS)
        axis["motor_torque_nm"] = np.round(random.normal(0.05, 0.01, count), 3) * np.sign(speed)
        axis["weight"] = 1.0
        axis["reading0"] = axis["reading1"] = np.nan
    return samples


def _counted(angle_deg: Any, counts: int) -> Any:
    return np.round(angle_deg * counts / 360.0) * 360.0 / counts


def as_recorded(samples: Any, folder: Path) -> tuple[float, int]:
    """Returns the recorder's CPU time, s, and the number of bytes written."""
    axes = samples["axes"].shape[1]
    about = About("bench", 1.0 / RATE_HZ, tuple(AxisAbout(f"axis{each}", RATIO) for each in range(axes)))
    settings = RecorderSettings(free_mb=0.0, file_s=86_400.0, file_mb=4000.0)
    log = FlightLog(folder, settings, about)
    begun = time.thread_time()
    for first in range(0, len(samples), RATE_HZ):
        for at in range(first, first + RATE_HZ, RATE_HZ // 50):
            log.put(Batch(samples[at : at + RATE_HZ // 50]))
        log.flush()
    log.close()
    taken = time.thread_time() - begun
    return taken, sum(each.stat().st_size for each in folder.iterdir())


def measured(axes: int, seconds: int) -> dict[str, float]:
    """Returns all figures for a machine with this number of axes."""
    samples = at_work(seconds, axes)
    messages = len(samples) * (1 + axes)
    with tempfile.TemporaryDirectory() as folder:
        taken_s, size = as_recorded(samples, Path(folder))
        (path,) = Path(folder).iterdir()
        begun = time.thread_time()
        read(path)
        reading_s = time.thread_time() - begun
    return {
        "axes": axes,
        "us_per_message": 1e6 * taken_s / messages,
        "percent_of_core": 100.0 * taken_s / seconds,
        "mb_per_hour": 3600.0 * size / seconds / 1e6,
        "reading_us_per_message": 1e6 * reading_s / messages,
    }


def main() -> None:
    """Measures the recorder for each number of axes and prints the figures."""
    given = parser(__doc__)
    given.add_argument("--seconds", type=int, default=120)
    seconds = given.parse_args().seconds
    for axes in (1, 6):
        print(", ".join(f"{name} {value:.3g}" for name, value in measured(axes, seconds).items()))


if __name__ == "__main__":
    main()
