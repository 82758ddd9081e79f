"""Figures of a simulated fleet: accuracy of its summary, and gain by its prior.

.venv/bin/python tools/bench/fleet.py score FLEET OUT [--limit ARCSEC]
.venv/bin/python tools/bench/fleet.py prior FLEET OUT

FLEET is a folder of `hdbridge fleet simulate`, OUT the result of a run over it.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from harness import parser
from scipy.special import logit

from hdbridge.analysis.findings import Parameter
from hdbridge.analysis.probability import Prior, updated
from hdbridge.analysis.scales import Scales
from hdbridge.fleet.dataset import Dataset
from hdbridge.fleet.prior import joint_prior, prior_rows
from hdbridge.fleet.simulate import FRICTION_NM, STIFFNESS_NM_PER_RAD, YEAR_HOURS
from hdbridge.fleet.summary import own_recordings, summarise
from hdbridge.units import ARCSEC_PER_DEG

FOLDS = 5
DETECTABLE = 2
"""Number of recordings in which a cause must exceed its detection limit for its joint to be listed."""


def score(fleet: Path, out: Path, limit_arcsec: float) -> None:
    """Compares the summary of a run with the true causes; joints without a row are left out."""

    rows = [row for row in Dataset(out).recordings() if row["joint"]]
    answers = json.loads((fleet / "answers.json").read_text())
    joints = {each["name"]: each for each in answers["joints"]}
    seen = {row["joint"] for row in rows}
    found = summarise(rows, limit_arcsec)
    listed = {each.joint: each for each in found.first}
    sick = {name for name in seen if joints[name]["cause"]}
    able = {name for name in sick if _detectable(joints[name], rows)}
    right = {name for name in able if name in listed and listed[name].cause == joints[name]["cause"]}
    aliased = {name for name in able & listed.keys() - right if joints[name]["cause"] in listed[name].aliases}
    wrong = {
        name for name, each in listed.items() if joints[name]["cause"] not in (each.cause, *each.aliases)
    }
    weeks = len(seen) * YEAR_HOURS / 168.0
    held, known = 0, 0
    for name in right:
        each = listed[name]
        if each.remaining is None or each.remaining.high == 0.0:
            continue
        last = max(row["hours"] for row in rows if row["joint"] == name and row["reason"] is None)
        rate, own = joints[name]["arcsec_per_1000_hours"], joints[name]
        begin = _peak_at_0_hours_arcsec(own["cause"], rate, own["hours"][0])
        true = max(1000.0 * (limit_arcsec - begin) / rate - last, 0.0)
        known += 1
        held += each.remaining.low <= true <= each.remaining.high
    wanted = {
        row["path"]
        for row in rows
        if joints[row["joint"]]["swapped_at"] is not None
        if row["reason"] is None and row["duplicate_of"] is None
        if _number(row, joints) >= joints[row["joint"]]["swapped_at"]
    }
    claimed = {each.path for each in found.mistaken if each.kind == "swapped"}
    damaged = {str((fleet / each).absolute()) for each in answers["damaged"]}
    failed = {path for _, path, _ in found.failed}
    there = {row["path"] for row in rows}
    copies = {each for each in answers["copies"] if str((fleet / each).absolute()) in there}
    print(f"{len(rows)} recordings of {len(seen)} joints; {len(sick)} with a cause, {len(able)} detectable")
    print(f"right cause listed first: {len(right)} of {len(able)}; as an alternative: {len(aliased)}")
    print(f"lines {len(listed)}, wrong {len(wrong)}: {1000.0 * len(wrong) / weeks:.2f} per 1,000 joint-weeks")
    print(f"90 % intervals of the hours to {limit_arcsec:g} arcsec: {held} of {known} hold the true hours")
    print(f"exchanged recordings: {len(wanted & claimed)} of {len(wanted)}, {len(claimed - wanted)} wrong")
    print(
        f"damaged: {len(failed & damaged)} of {len(damaged & there)}, {len(failed - damaged)} others failed"
    )
    print(f"copies: {len(found.duplicates)} of {len(copies)}")


def _peak_at_0_hours_arcsec(cause: str, arcsec_per_1000_hours: float, first_hours: float) -> float:
    """Returns the peak of a cause as a diagnosis sees it, extrapolated along a straight line to 0 hours.

    A model fitted to the first recording contains the motor orders and the loop of that recording, so only
    their later growth is seen. The load friction of a joint with backlash winds up the gear, which looks like
    additional backlash.
    """
    if cause in {"motor_order", "hysteresis_parameters"}:
        return -arcsec_per_1000_hours * first_hours / 1000.0
    return math.degrees(FRICTION_NM / STIFFNESS_NM_PER_RAD) * ARCSEC_PER_DEG if cause == "backlash" else 0.0


def _number(row: dict[str, Any], joints: dict[str, Any]) -> int:
    return int(np.argmin(np.abs(np.array(joints[row["joint"]]["hours"]) - row["hours"])))


def _detectable(joint: dict[str, Any], rows: list[dict[str, Any]]) -> bool:
    """Returns True if the cause exceeds the detection limits of enough recordings."""
    count = 0
    for row in rows:
        if row["joint"] == joint["name"] and row["reason"] is None and row["duplicate_of"] is None:
            limits = {each["cause"]: each["arcsec"] for each in row["limits"] or ()}
            rate = joint["arcsec_per_1000_hours"]
            size = (
                _peak_at_0_hours_arcsec(joint["cause"], rate, joint["hours"][0])
                + rate * row["hours"] / 1000.0
            )
            count += size > limits.get(joint["cause"], 1.0)
    return count >= DETECTABLE


def prior(fleet: Path, out: Path) -> None:
    """Applies a prior from the other joints to each joint's findings; counts right and wrong findings.

    Unlike `diagnose --prior`, this does not refit the recordings without the dropped findings.
    """
    rows = [row for row in Dataset(out).recordings() if row["joint"]]
    truth = {each["name"]: each for each in json.loads((fleet / "answers.json").read_text())["joints"]}
    own = own_recordings(rows)[0]
    scales = Scales()
    counts = {each: Counter() for each in ("without", "with")}
    widths: list[float] = []
    for fold in range(FOLDS):
        out_of = set(list(own)[fold::FOLDS])
        known = prior_rows([row for row in rows if row["joint"] not in out_of])
        groups = {row["group"] for row in known if row["attribute"] == "batch"}
        for name in out_of:
            batch = own[name][-1]["batch"]
            of_joint = joint_prior(known, {"batch": batch} if batch in groups else {})
            for row in own[name]:
                _count(row, truth[name]["cause"], of_joint, scales, counts, widths)
    recordings = sum(map(len, own.values()))
    print(f"{recordings} recordings of {len(own)} joints, with the prior of the other joints, {FOLDS} folds")
    for each, found in counts.items():
        print(
            f"  {each}: names right {found['right']}, wrong {found['wrong']}; causes missed {found['missed']}"
        )
    if widths:
        narrower = np.mean(np.array(widths) < 0.95)
        print(
            f"  {len(widths)} intervals of right causes: width with over without, median "
            f"{np.median(widths):.2f}; {narrower:.0%} narrower by 5 % or more"
        )


def _count(
    row: Any, true: str | None, prior: Prior, scales: Scales, counts: dict[str, Any], widths: list[float]
) -> None:
    """Counts the findings of one recording, and collects the interval widths of the right cause."""
    right = dict.fromkeys(counts, False)
    for each in row["findings"]:
        if each["cause"] == "unexplained":
            continue
        score = float(logit(each["probability"]))
        with_prior = updated(score, prior.log_odds(each["cause"], scales), scales)
        hit = true in (each["cause"], *(each["aliases"] or ()))
        for kind, probability in (("without", each["probability"]), ("with", with_prior)):
            if probability >= scales.named_from:
                counts[kind]["right" if hit else "wrong"] += 1
                right[kind] |= hit
        for one in each["parameters"] if hit else ():
            if (each["cause"], one["name"]) in prior.ranges and 0.0 < one["high"] - one["low"] < np.inf:
                given = Parameter(one["value"], one["unit"], one["low"], one["high"])
                found = given.combined(*prior.ranges[each["cause"], one["name"]])
                widths.append((found.high - found.low) / (given.high - given.low))
    for kind, hit in right.items():
        counts[kind]["missed"] += bool(true) and not hit


def main() -> None:
    """Prints the requested figures."""
    options = parser(__doc__)
    options.add_argument("kind", choices=("score", "prior"))
    options.add_argument("fleet", type=Path)
    options.add_argument("out", type=Path)
    options.add_argument("--limit", type=float, default=10.0, help="arcsec; of score")
    given = options.parse_args()
    if given.kind == "score":
        score(given.fleet, given.out, given.limit)
    else:
        prior(given.fleet, given.out)


if __name__ == "__main__":
    main()
