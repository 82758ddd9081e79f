"""Random events on the slave of the gateway, or on the whole gateway with both its buses, in simulated time.

    python tools/bench/random_events.py [--stack slave|gateway] [--events 100000] [--seed 1]

After each event the invariants of the tests must hold: no set-point outside the limits, no unrequested
motion. Prints the progress. If a sequence of events violates an invariant, prints it with its seed and ends
with exit status 1.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from random import Random
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[2] / "tests"))
from support.disorder import draw, play_story
from support.slave_events import play_events

PER_STORY = {"slave": 200, "gateway": 100}


def story(stack: str, seed: int) -> None:
    """Plays one sequence of events; raises AssertionError if an invariant is violated."""
    count, rng = PER_STORY[stack], Random(seed)
    seen: Any
    with tempfile.TemporaryDirectory(prefix="events-") as folder:
        if stack == "slave":
            seen = play_events(seed, count)
        else:
            seen = play_story(Path(folder), [draw(rng) for _ in range(count)])
    for name in TOTAL:
        TOTAL[name] += getattr(seen, name)


TOTAL = {"periods": 0, "moved": 0, "enabled": 0}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stack", choices=PER_STORY, default="slave")
    parser.add_argument("--events", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    events, broken, seed = 0, 0, options.seed
    while events < options.events:
        try:
            story(options.stack, seed)
        except AssertionError as error:
            broken += 1
            print(f"seed {seed}: {error}", flush=True)
        events += PER_STORY[options.stack]
        seed += 1
        if seed % (50 if options.stack == "slave" else 5) == 0:
            print(f"{events} events, {broken} stories that broke a law, {TOTAL}", flush=True)
    print(f"{events} events, {broken} stories that broke a law, {TOTAL}")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
