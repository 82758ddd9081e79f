"""Random events on the slave of the gateway, or on the whole gateway with both its buses, in simulated time.

    python tools/bench/random_events.py [--stack slave|gateway] [--events 100000] [--seed 1]

After each event the invariants of the tests must hold: no set-point outside the limits, no unrequested
motion. Prints the progress. If a sequence of events violates an invariant, prints it with its seed and ends
with exit status 1.
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections import Counter
from pathlib import Path
from random import Random
from typing import Any

from harness import parser
from support.disorder import draw, play_story
from support.slave_events import play_events

PER_STORY = {"slave": 200, "gateway": 100}
COUNTED = ("periods", "moved", "enabled")


def story(stack: str, seed: int) -> Any:
    """Plays one sequence of events; raises AssertionError if an invariant is violated."""
    count, rng = PER_STORY[stack], Random(seed)
    if stack == "slave":
        return play_events(seed, count)
    with tempfile.TemporaryDirectory(prefix="events-") as folder:
        return play_story(Path(folder), [draw(rng) for _ in range(count)])


def main() -> int:
    given = parser(__doc__)
    given.add_argument("--stack", choices=PER_STORY, default="slave")
    given.add_argument("--events", type=int, default=100_000)
    given.add_argument("--seed", type=int, default=1)
    options = given.parse_args()
    per_story, broken = PER_STORY[options.stack], 0
    total: Counter[str] = Counter()
    stories = math.ceil(options.events / per_story)
    for number in range(1, stories + 1):
        seed = options.seed + number - 1
        try:
            seen = story(options.stack, seed)
            total.update({name: getattr(seen, name) for name in COUNTED})
        except AssertionError as error:
            broken += 1
            print(f"seed {seed}: {error}", flush=True)
        if number % 25 == 0 or number == stories:
            print(
                f"{number * per_story} events, {broken} stories that broke a law, {dict(total)}", flush=True
            )
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
