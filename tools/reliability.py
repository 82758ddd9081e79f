"""Reliability of the probabilities of a diagnosis: how often names of each probability were right.

    python tools/reliability.py --suite build/blind-4711
    python tools/reliability.py --suite build/blind-1 --answers build/before
    python tools/reliability.py --trials 2 --first 5000 --keep build/reliability.json

Compares the stated probability of each name with whether it, or one of its aliases, was there: of the answers
that tools/blind/score.py has kept of a suite, or of short records from formulas (tools/fit_probabilities.py),
which it diagnoses. Prints a diagram as a Markdown table: bins with counts, mean probability, share that was
right with its 95 % interval, and the Brier score. The findings of trials are kept in a table as they come; an
existing one is read instead of made again.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parent))
from blind.score import verdict_of
from blind.tables import rate
from fit_probabilities import from_trials

BINS = (0.0, 0.3, 0.5, 0.7, 0.9, 0.95, 1.01)
BAR = 20
Row = dict[str, Any]


def diagram(rows: Sequence[Row]) -> str:
    """Returns the table; the bar is the share that was right, the mark in it the mean probability."""
    given = np.array([float(row["given"]) for row in rows])
    right = np.array([bool(row["right"]) for row in rows])
    lines = ["| probability | names | mean | right | diagram |", "|---|---|---|---|---|"]
    for low, high in pairwise(BINS):
        inside = (given >= low) & (given < high)
        if np.any(inside):
            mean, share = float(np.mean(given[inside])), float(np.mean(right[inside]))
            bar = ["#" if at < round(BAR * share) else "." for at in range(BAR)]
            bar[min(round(BAR * mean), BAR - 1)] = "|"
            lines.append(
                f"| {low:.2f} to {min(high, 1.0):.2f} | {np.count_nonzero(inside)} | {mean:.3f} | "
                f"{rate(right[inside].tolist())} | `{''.join(bar)}` |"
            )
    base = float(np.mean(right))
    lines.append(
        f"\nBrier score {np.mean((given - right) ** 2):.4f}; {base * (1.0 - base):.4f} with the same "
        f"probability for every name ({len(rows)} names, {int(np.sum(right))} right)"
    )
    return "\n".join(lines)


def answered(suite: Path, answers: Path) -> Iterable[Row]:
    """Yields the names in the kept answers to the cases of a blind suite."""
    for case in sorted(each.parent for each in suite.glob("[!.]*/sealed.json")):
        if (answers / case.name / "answer.json").exists():
            for given, right in verdict_of(case, answers).probabilities:
                yield {"given": given, "right": right}


def kept(rows: Iterable[Row], file: Path | None) -> list[Row]:
    """Collects the findings, and writes them as they come."""
    found: list[Row] = []
    for row in rows:
        found.append(row)
        if file:
            file.write_text(json.dumps(found, indent=1), encoding="utf-8")
    return found


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--suite", type=Path, help="folder of a blind suite")
    parser.add_argument("--answers", type=Path, help="folder of its answers; by default FOLDER/answers")
    parser.add_argument("--trials", type=int, default=0, help="seeds of records from formulas")
    parser.add_argument("--first", type=int, default=5000, help="the first of these seeds")
    parser.add_argument("--keep", type=Path, help="JSON table of the findings")
    options = parser.parse_args()
    if options.keep and options.keep.exists():
        rows: list[Row] = json.loads(options.keep.read_text(encoding="utf-8"))
    else:
        rows = kept(from_trials(options.trials, options.first), options.keep)
        if options.suite:
            rows += answered(options.suite, options.answers or options.suite / "answers")
    if not rows:
        print("no findings; give --suite or --trials", file=sys.stderr)
        return 2
    print(diagram(rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
