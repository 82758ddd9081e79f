"""Reliability of the probabilities of a diagnosis: how often names of each probability were right.

    python tools/reliability.py --suite build/blind-4711
    python tools/reliability.py --suite build/blind-1 --answers build/before
    python tools/reliability.py --trials 2 --first 5000 --keep build/reliability.json

Compares the stated probability of each name with whether it, or one of its aliases, was there: of the answers
that tools/blind/score.py has kept of a suite, or of short records from formulas (tests/support/trials.py),
which it diagnoses. Prints a diagram as a Markdown table: bins with counts, mean probability, share that was
right with its 95 % interval, and the Brier score. The findings of trials are kept in a table as they come; an
existing one is read instead of made again.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parent))
from blind.case import record_of, unsealed
from blind.score import verdict_of
from blind.tables import rate
from support.trials import CAUSES, LOOPS, NONE, PAIRS, SHORT, SPECIAL, SYNONYMS, UNKNOWN, planted

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis
from hdbridge.analysis.scales import Scales
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.recording import Recording

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


def judged(
    source: str, name: str, result: Diagnosis, there: set[str], also: set[str], loop: bool
) -> Iterator[Row]:
    """Yields one row for each reported cause; those in ``also`` count neither right nor wrong."""
    met: set[str] = set()
    for each in result.findings:
        names = {each.cause, *each.aliases}
        hits = {one for one in there if names & {one, *SYNONYMS.get(one, ())}} - met
        if each.cause == "unexplained" or (each.cause in also and not hits):
            continue
        met |= set(sorted(hits)[:1])
        right = bool(hits) or (loop and bool(names & LOOPS))
        yield {
            "source": source, "record": name, "cause": each.cause, "right": right,
            "terms": dict(each.terms), "given": each.probability,
        }  # fmt: skip


def from_suite(folder: Path) -> Iterator[Row]:
    """Yields the findings in the cases of a blind suite."""
    for case in sorted(each.parent for each in folder.glob("[!.]*/sealed.json")):
        hidden = unsealed(case)
        recording = Recording.load(*record_of(case))
        model = TransmissionModel.load(case / "model.yaml")
        result = diagnose(recording, model, scales=Scales(named_from=0.0))
        there = {each["cause"] for each in hidden["hidden"]} - {"unexplained"}
        loop = hidden["kind"] in {"law", "other_law"}
        yield from judged(folder.name, f"{folder.name}/{case.name}", result, there, set(hidden["also"]), loop)


def from_trials(seeds: int, first: int) -> Iterator[Row]:
    """Yields the findings in short records from formulas."""
    for seed in range(first, first + seeds):
        for name in (*CAUSES, *SPECIAL, *NONE, *UNKNOWN, *PAIRS):
            there, record, model = planted(name, seed, SHORT)
            loop = name.startswith("none:") or bool(there & LOOPS)
            result = diagnose(record, model, scales=Scales(named_from=0.0))
            yield from judged("trials", f"{name} {seed}", result, there - {"unexplained"}, set(), loop)


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
