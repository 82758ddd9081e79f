"""Fits the formula of the probabilities: `python tools/fit_probabilities.py [--suite FOLDER]... [--trials N]
[--keep TABLE.json]`.

Diagnoses records whose causes are known: blind suites (tools/blind/generate.py) and short records from the
formulas of tests/support/plant.py, N seeds of each cause. Each finding gives the terms of the formula
(hdbridge/analysis/probability.py) and whether the name was right. A logistic formula with a ridge is fitted,
every term with its required sign, and tested by cross-validation that leaves whole records out. An existing
table of `--keep` is read instead of made again. Prints the coefficients for `Scales`.
"""

from __future__ import annotations

import argparse
import json
import sys
from itertools import chain
from pathlib import Path

import numpy as np
from reliability import Row, diagram, from_suite, from_trials, kept
from scipy.optimize import minimize

from hdbridge.analysis.probability import coefficients
from hdbridge.analysis.scales import Scales

RIDGE = 1.0
FOLDS = 10
FREE = frozenset({"constant"})
AGAINST = frozenset({"excess", "unexplained"})
PRIOR = {"unexplained": -1.0}
"""Coefficients that the ridge draws towards where these records say little; 0 for all others."""


def fitted(terms: np.ndarray, right: np.ndarray, names: list[str]) -> np.ndarray:
    """Returns the coefficients of the logistic formula, shape (terms,)."""
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


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--suite", type=Path, action="append", default=[], help="folder of a blind suite")
    parser.add_argument("--trials", type=int, default=0, help="seeds of records from formulas")
    parser.add_argument("--keep", type=Path, help="JSON table of the findings")
    options = parser.parse_args()
    if options.keep and options.keep.exists():
        rows: list[Row] = json.loads(options.keep.read_text(encoding="utf-8"))
    else:
        suites = (row for each in options.suite for row in from_suite(each))
        rows = kept(chain(suites, from_trials(options.trials, 100)), options.keep)
    if not rows:
        print("no findings; give --suite or --trials", file=sys.stderr)
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
    print(f"as given\n\n{diagram(rows)}")
    for source in [*dict.fromkeys(row["source"] for row in rows), ""]:
        chosen = np.array([source in ("", row["source"]) for row in rows])
        held_out = [{"given": p, "right": r} for p, r in zip(left_out[chosen], right[chosen], strict=True)]
        print(f"\ncross-validated {source or 'all'}\n\n{diagram(held_out)}")
    for name, value in zip(names, fitted(terms, right, names), strict=True):
        print(f'    "{name}": {value:.2f},')
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
