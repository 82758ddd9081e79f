"""Measure the adaptation: an axis whose gear changes over an hour of work, and load encoders that fail.

python tools/bench/adaptation.py [--minutes 60] [--faulty-minutes 10]

The simulated axis of the article steps without a pause over real frames; within an hour its loop's offset
grows by a fifth, and its second order by 3 arcsec. Each line is one run: three sigma of the load's
*true* error at rest over eight neighbouring stepping tests (256 stands): the first, the largest, the last.
"""

from __future__ import annotations

import argparse
import math

from harness import parser
from support.adapting import FAULTS, FLOOR_ARCSEC, Work, at_work, truth_of

from hdbridge.daemon.machinefile import AdaptationSettings

NEIGHBOURS = 8
LEAST_MIN = 8
"""Shortest run with as many stepping tests, minutes."""
ON = AdaptationSettings(mode="on")


def line(name: str, work: Work, until_s: float, told: str) -> None:
    """Prints the row of one run in the table."""
    three_sigma = work.three_sigma_arcsec(NEIGHBOURS)
    figures = " | ".join(f"{each:.2f}" for each in (three_sigma[0], max(three_sigma), three_sigma[-1]))
    print(f"| {name} | {until_s / 60.0:.0f} | {figures} | {told} |", flush=True)


def measure(name: str, settings: AdaptationSettings | None, until_s: float) -> None:
    """Measures a run without faults."""
    with at_work(truth_of(3600.0), settings) as work:
        work.until(until_s)
        told = "nothing" if work.adaptation is None else f"{len(work.history)} changes of the model"
        line(name, work, until_s, told)


def measure_fault(name: str, until_s: float) -> None:
    """Measures a run in which the load encoder fails halfway."""
    with at_work(truth_of(3600.0), ON) as work:
        work.until(0.5 * until_s)
        failed_s = work.time_s
        work.faults.load_reading = FAULTS[name](work)
        work.until(until_s)
        frozen = next((each for each in work.history if each["event"] == "frozen"), None)
        told = "never frozen"
        if frozen is not None:
            told = f"frozen after {frozen['axis_time_s'] - failed_s:.0f} s: {frozen['reason']}"
        line(f"on, {name} halfway", work, until_s, told)


def minutes(text: str) -> float:
    """Returns the duration of a run given on the command line; 0 for none."""
    found = float(text)
    if found and not LEAST_MIN <= found < math.inf:
        raise argparse.ArgumentTypeError(f"found {text}; expected {LEAST_MIN} or more, or 0 for no run")
    return found


def main() -> None:
    options = parser(__doc__)
    for name, default, of in (("--minutes", 60, "without faults"), ("--faulty-minutes", 10, "with a fault")):
        about = f"axis time of each run {of}: {LEAST_MIN} or more; 0: none (default {default})"
        options.add_argument(name, type=minutes, default=default, help=about)
    given = options.parse_args()
    print(f"Floor {FLOOR_ARCSEC:.2f} arcsec, 1.3 x floor {1.3 * FLOOR_ARCSEC:.2f} arcsec.\n")
    print("| adaptation | minutes | first | largest | last | told |\n|---|---|---|---|---|---|")
    if given.minutes:
        measure("off", None, 60.0 * given.minutes)
        measure("on", ON, 60.0 * given.minutes)
    if given.faulty_minutes:
        measure("off", None, 60.0 * given.faulty_minutes)
        for name in FAULTS:
            measure_fault(name, 60.0 * given.faulty_minutes)


if __name__ == "__main__":
    main()
