"""Rules and evidence on the same drawn records: who names what, how sure, and what it costs.

python tools/evidence/compare.py --seeds 7000:7050 [--kinds single pair ...] [--workers 2] --out FILE.json

A record of each kind for each seed (draw.py). The file is written after each record; run again, what is in it
is not done again. The table at the end: counts with exact binomial 95 % intervals, Brier score, reliability.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import pairwise
from pathlib import Path
from typing import Any

os.environ |= {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
}  # one core a worker, so that seconds compare
sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1]))
import numpy as np
from evidence.draw import KINDS, draw
from evidence.posterior import explained
from evidence.scales import Scales
from scipy.stats import binomtest
from support.trials import SYNONYMS

from hdbridge.diagnose import diagnose
from hdbridge.model import TransmissionModel
from hdbridge.records.record import Record

METHODS = ("rules", "evidence")
EDGES = (0.0, 0.5, 0.7, 0.9, 0.95, 0.99, 1.0001)
Named = list[dict[str, Any]]


def rules(record: Record, model: TransmissionModel) -> Named:
    """The product's diagnosis."""
    return [
        {"cause": each.cause, "probability": each.probability, "aliases": list(each.aliases)}
        for each in diagnose(record, model).findings
    ]


def evidence(record: Record, model: TransmissionModel) -> Named:
    """The search over theories."""
    return [
        {
            "cause": each.cause,
            "probability": each.probability,
            "aliases": list(each.aliases),
            "nats": each.nats,
        }
        for each in explained(record, model).findings
    ]


def judged(kind: str, seed: int, methods: Sequence[str]) -> dict[str, Any]:
    """One record by both methods."""
    case = draw(kind, seed)
    record, model = case.made()
    row: dict[str, Any] = {
        "kind": kind, "seed": seed, "name": case.name,
        "hidden": sorted(case.hidden), "allowed": sorted(case.allowed),
    }  # fmt: skip
    for method in methods:
        named: Callable[[Record, TransmissionModel], Named] = rules if method == "rules" else evidence
        begin = time.process_time()
        try:
            row[method] = {"found": named(record, model)}
        except (ArithmeticError, ValueError, AssertionError, np.linalg.LinAlgError) as error:
            row[method] = {"found": [], "failed": repr(error)}  # counts as having said nothing
        row[method]["seconds"] = time.process_time() - begin
    return row


def same(cause: str) -> frozenset[str]:
    """A cause and what no record of one mounting distinguishes from it."""
    return frozenset({cause} | SYNONYMS.get(cause, set()))


def figures(rows: Sequence[dict[str, Any]], method: str) -> dict[str, tuple[int, int]]:
    """Counts, each out of how many."""
    counts: dict[str, list[int]] = {}

    def count(name: str, hits: int, of: int = 1) -> None:
        both = counts.setdefault(name, [0, 0])
        both[0] += hits
        both[1] += of

    for row in rows:
        kind, hidden = row["kind"], [same(each) for each in row["hidden"]]
        names = [each["cause"] for each in row[method]["found"]]
        count("failed", "failed" in row[method])
        causes = [each for each in names if each != "unexplained"]
        allowed = {name for each in row["allowed"] for name in same(each)}
        wrong = [each for each in causes if each not in allowed]
        recalled = sum(any(name in causes for name in each) for each in hidden)
        if kind in {"pair", "triple"}:
            count(f"{kind}: causes named", recalled, len(hidden))
            count(f"{kind}: names right", len(causes) - len(wrong), len(causes))
        elif hidden:
            count(f"{kind}: right first", bool(names) and names[0] in allowed)
            count(f"{kind}: wrong first", bool(causes) and names[0] in wrong)
            count(f"{kind}: a wrong name beside", any(each in wrong for each in names[1:]))
        elif kind == "unknown":
            count("unknown: led", bool(names) and names[0] == "unexplained")
            count("unknown: a false name", bool(wrong))
        else:
            count(f"{kind}: a false name", bool(wrong))
            count(f"{kind}: unexplained", "unexplained" in names)
    return {name: (hits, of) for name, (hits, of) in counts.items()}


def assertions(rows: Sequence[dict[str, Any]], method: str) -> list[tuple[float, bool]]:
    """Probability and truth of what was named, its aliases counted, and of what was hidden and was not."""
    result = []
    for row in rows:
        allowed = {name for each in row["allowed"] for name in same(each)}
        missed = set(row["hidden"])
        for each in row[method]["found"]:
            if each["cause"] == "unexplained":
                continue
            told = {each["cause"], *each["aliases"]}
            result.append((float(each["probability"]), bool(told & allowed)))
            missed -= {hidden for hidden in missed if same(hidden) & told}
        result += [(0.0, True)] * len(missed)
    return result


def tables(rows: Sequence[dict[str, Any]], methods: Sequence[str]) -> str:
    """Markdown: rows of counts, the Brier score, reliability, seconds."""
    found = {method: figures(rows, method) for method in methods}
    lines = ["| row | " + " | ".join(methods) + " |", "|---|" + "---|" * len(methods)]
    for name in found[methods[0]]:
        cells = []
        for method in methods:
            hits, of = found[method][name]
            if not of:
                cells.append("0 of 0")
                continue
            ends = binomtest(hits, of).proportion_ci(method="exact")
            cells.append(f"{hits} of {of} ({100 * ends.low:.0f}-{100 * ends.high:.0f} %)")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    said = {method: assertions(rows, method) for method in methods}
    brier = [sum((p - right) ** 2 for p, right in said[each]) / max(len(said[each]), 1) for each in methods]
    lines.append("| Brier score | " + " | ".join(f"{each:.3f}" for each in brier) + " |")
    seconds = [sorted(row[each]["seconds"] for row in rows) for each in methods]
    middle = [f"{each[len(each) // 2]:.1f}, {each[-1]:.1f}" for each in seconds]
    lines.append("| seconds of one core: median, most | " + " | ".join(middle) + " |")
    lines += ["", "| probability | " + " | ".join(f"{each}: right" for each in methods) + " |"]
    lines.append("|---|" + "---|" * len(methods))
    for low, high in pairwise(EDGES):
        cells = []
        for method in methods:
            inside = [right for p, right in said[method] if max(low, 1e-9) <= p < high]
            cells.append(f"{sum(inside)} of {len(inside)}")
        lines.append(f"| {low:g} to {min(high, 1.0):g} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, judge what is not in the file yet, print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", required=True, help="FIRST:LAST, the last not included")
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=KINDS)
    parser.add_argument("--methods", nargs="*", default=list(METHODS), choices=METHODS)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args(arguments)
    first, last = (int(each) for each in options.seeds.split(":"))
    rows = json.loads(options.out.read_text(encoding="utf-8"))["rows"] if options.out.exists() else []
    done = {(row["kind"], row["seed"]) for row in rows if all(each in row for each in options.methods)}
    wanted = [(kind, seed) for seed in range(first, last) for kind in options.kinds]
    scales = Scales().as_rows()
    with ProcessPoolExecutor(options.workers) as pool:
        waiting = [pool.submit(judged, *each, options.methods) for each in wanted if each not in done]
        for each in as_completed(waiting):
            row = each.result()
            rows = [one for one in rows if (one["kind"], one["seed"]) != (row["kind"], row["seed"])]
            rows.append(row)
            document = json.dumps({"scales": scales, "rows": rows}, indent=1) + "\n"
            part = options.out.with_suffix(".part")
            part.write_text(document, encoding="utf-8")
            part.replace(options.out)
            said = "; ".join(f"{method}: {_words(row[method])}" for method in options.methods)
            print(f"{row['kind']} {row['seed']} {row['name']}: {said}", file=sys.stderr, flush=True)
    chosen = [row for row in rows if (row["kind"], row["seed"]) in set(wanted)]
    print("\n".join(f"{each['name']} {each['value']:g} {each['unit']}: {each['source']}" for each in scales))
    print(tables(sorted(chosen, key=lambda row: KINDS.index(row["kind"])), options.methods))
    return 0


def _words(said: dict[str, Any]) -> str:
    names = ", ".join(f"{each['cause']} {each['probability']:.2f}" for each in said["found"])
    return f"{names or 'nothing'} ({said['seconds']:.0f} s)"


if __name__ == "__main__":
    raise SystemExit(main())
