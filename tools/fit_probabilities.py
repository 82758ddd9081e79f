"""Fits the probability formula: `python tools/fit_probabilities.py [--suite FOLDER]... [--keep TABLE.json]`.

Diagnoses the records of blind suites (tools/blind/generate.py), whose causes are known. Each finding provides
the terms of the formula (hdbridge/analysis/probability.py) and shows whether the named cause was right. A
logistic regression with a ridge penalty is fitted, every term with its required sign, and tested by
cross-validation that leaves out whole records. If `--keep` names an existing table, it is read instead.
Prints the coefficients for `Scales`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from blind.case import NEED_ROLLING, record_of, unsealed
from blind.parameters import TWINS
from blind.tables import CALIBRATION, Pair, brier, calibration, table

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis
from hdbridge.analysis.probability import coefficients
from hdbridge.analysis.scales import Scales
from hdbridge.axis.model import TransmissionModel
from hdbridge.records.recording import Recording

RIDGE = 1.0
FOLDS = 10
FREE = frozenset({"constant"})
AGAINST = frozenset({"unexplained"})
PRIOR = {"unexplained": -1.0}
"""Coefficients to which the ridge penalty shrinks if the records are uninformative; 0 for all others."""
Row = dict[str, Any]


def fitted(terms: np.ndarray, right: np.ndarray, names: list[str]) -> np.ndarray:
    """Returns the fitted coefficients of the logistic regression, shape (terms,)."""
    bounds = [
        (None, None) if each in FREE else ((None, 0) if each in AGAINST else (0, None)) for each in names
    ]
    ridge = np.array([0.0 if each == "constant" else RIDGE for each in names])

    def cost(values: np.ndarray) -> tuple[float, np.ndarray]:
        score = terms @ values
        loss = float(np.sum(np.logaddexp(0.0, -np.where(right, score, -score))))
        slope = terms.T @ (1.0 / (1.0 + np.exp(-score)) - right)
        away = values - prior
        return loss + 0.5 * float(ridge @ away**2), slope + ridge * away

    prior = np.array([PRIOR.get(each, 0.0) for each in names])
    return np.asarray(minimize(cost, prior, jac=True, method="L-BFGS-B", bounds=bounds).x)


def probabilities(terms: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.asarray(np.minimum(1.0 / (1.0 + np.exp(-terms @ values)), Scales().surest))


def judged(
    source: str, name: str, result: Diagnosis, there: set[str], also: set[str], loop: bool
) -> Iterator[Row]:
    """Yields one row for each reported cause; those in ``also`` count neither as right nor as wrong."""
    met: set[str] = set()
    for each in result.findings:
        names = {each.cause, *each.aliases}
        hits = {one for one in there if names & {one, TWINS.get(one, one)}} - met
        if each.cause == "unexplained" or (each.cause in also and not hits):
            continue
        met |= set(sorted(hits)[:1])
        right = bool(hits) or (loop and bool(names & set(NEED_ROLLING)))
        yield {
            "source": source, "record": name, "cause": each.cause, "right": right,
            "terms": dict(each.terms), "given": each.probability,
        }  # fmt: skip


def from_suite(folder: Path) -> Iterator[Row]:
    """Yields the judged findings in the cases of a blind suite."""
    for case in sorted(each.parent for each in folder.glob("[!.]*/sealed.json")):
        hidden = unsealed(case)
        recording = Recording.load(*record_of(case))
        model = TransmissionModel.load(case / "model.yaml")
        result = diagnose(recording, model, scales=Scales(named_from=0.0))
        there = {each["cause"] for each in hidden["hidden"]} - {"unexplained"}
        loop = hidden["kind"] in {"law", "other_law"}
        yield from judged(folder.name, f"{folder.name}/{case.name}", result, there, set(hidden["also"]), loop)


def kept(rows: Iterable[Row], file: Path | None) -> list[Row]:
    """Collects the findings, and writes them to the file after each one."""
    found: list[Row] = []
    for row in rows:
        found.append(row)
        if file:
            file.write_text(json.dumps(found, indent=1), encoding="utf-8")
    return found


def report(title: str, pairs: Sequence[Pair]) -> None:
    """Prints, by bin of probability, the fraction of findings that were right, and the Brier score."""
    print(f"{title}\n\n{table(CALIBRATION, calibration(pairs))}\n\n{': '.join(brier(pairs))}\n")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--suite", type=Path, action="append", default=[], help="folder of a blind suite")
    parser.add_argument("--keep", type=Path, help="JSON table of the findings")
    options = parser.parse_args()
    if options.keep and options.keep.exists():
        rows: list[Row] = json.loads(options.keep.read_text(encoding="utf-8"))
    else:
        rows = kept((row for each in options.suite for row in from_suite(each)), options.keep)
    if not rows:
        print("no findings; give --suite", file=sys.stderr)
        return 2
    names = list(coefficients(Scales()))
    terms = np.array([[row["terms"][name] for name in names] for row in rows])
    right = np.array([bool(row["right"]) for row in rows])
    records = sorted({row["record"] for row in rows})
    fold = np.array([records.index(row["record"]) * 7919 % FOLDS for row in rows])
    left_out = np.empty(len(rows))
    for number in range(FOLDS):
        held = fold == number
        left_out[held] = probabilities(terms[held], fitted(terms[~held], right[~held], names))
    report("as given", [(row["given"], row["right"]) for row in rows])
    for source in [*dict.fromkeys(row["source"] for row in rows), ""]:
        chosen = np.array([source in ("", row["source"]) for row in rows])
        pairs = zip(left_out[chosen].tolist(), right[chosen].tolist(), strict=True)
        report(f"cross-validated {source or 'all'}", list(pairs))
    for name, value in zip(names, fitted(terms, right, names), strict=True):
        print(f'    "{name}": {value:.2f},')
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
