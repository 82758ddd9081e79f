"""Figures of a fleet: accuracy, gain by the prior, cost of the engine.

.venv/bin/python tools/bench/fleet.py score FLEET OUT [--limit ARCSEC]
.venv/bin/python tools/bench/fleet.py prior FLEET OUT
.venv/bin/python tools/bench/fleet.py ratios [--samples 32000] [--tasks 6]

FLEET is a folder of `hdbridge fleet simulate`, OUT the result of a run over it. The ratios are of
processor time, so they hold on a computer that others use too.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from scipy.special import logit

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from diagnose import record
from support import plant

from hdbridge.analysis.findings import Parameter
from hdbridge.analysis.probability import Prior, updated
from hdbridge.analysis.scales import Scales
from hdbridge.fleet import engine
from hdbridge.fleet.dataset import Dataset
from hdbridge.fleet.prior import joint_prior, prior_rows
from hdbridge.fleet.simulate import YEAR_HOURS, peak_at_0_hours_arcsec
from hdbridge.fleet.sources import Source
from hdbridge.fleet.summary import own_recordings, summarise
from hdbridge.records.record import Record

FOLDS = 5
DETECTABLE = 2
"""Recordings in which a cause must exceed the limit of detection before a joint can be listed for it."""


def score(fleet: Path, out: Path, limit_arcsec: float) -> None:
    """Compares the summary of a run with the hidden causes; joints without a row are left out."""

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
        begin = peak_at_0_hours_arcsec(own["cause"], rate, own["hours"][0])
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


def _number(row: dict[str, Any], joints: dict[str, Any]) -> int:
    return int(np.argmin(np.abs(np.array(joints[row["joint"]]["hours"]) - row["hours"])))


def _detectable(joint: dict[str, Any], rows: list[dict[str, Any]]) -> bool:
    """Returns True if the cause exceeds its detection limit in enough recordings, by those themselves."""
    count = 0
    for row in rows:
        if row["joint"] == joint["name"] and row["reason"] is None and row["duplicate_of"] is None:
            limits = {each["cause"]: each["arcsec"] for each in row["limits"] or ()}
            rate = joint["arcsec_per_1000_hours"]
            size = (
                peak_at_0_hours_arcsec(joint["cause"], rate, joint["hours"][0]) + rate * row["hours"] / 1000.0
            )
            count += size > limits.get(joint["cause"], 1.0)
    return count >= DETECTABLE


def prior(fleet: Path, out: Path) -> None:
    """Weighs the names of each joint's recordings by a prior from the other joints; counts right and wrong.

    Recordings are not fitted again without the names that fall away, as `diagnose --prior` does.
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
    """Counts the names of one recording, and the widths of the intervals of the right cause."""
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


def ratios(samples: int, tasks: int) -> None:
    """Measures the engine against the diagnosis itself, with one process and with two."""

    inner = engine.diagnosed
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "model.yaml").write_text(plant.model_text(1))
        whole = record(samples)
        rng = np.random.default_rng(2)
        for number in range(tasks):
            load = whole.load_position_deg + rng.normal(0.0, 0.05 / 3600.0, samples)
            Record({**whole.columns, "load_position_deg": load}).write_csv(folder / f"{number}.csv")

        def timed(*arguments: Any) -> Any:
            begun, cpu = time.time(), time.process_time()
            row = inner(*arguments)
            own = {"pid": os.getpid(), "begun": begun, "end": time.time(), "cpu": time.process_time() - cpu}
            own |= {"all": time.process_time(), "rss": _rss_mb()}
            path = folder / f"{arguments[0].joint}-{time.time_ns()}.json"
            path.write_text(json.dumps(own))
            return row

        engine.diagnosed = timed
        for workers in (1, 2):
            sources = [Source(str(folder / f"{n}.csv"), joint=f"J{n}", ratio=50.0) for n in range(tasks)]
            cpu = time.process_time()
            end = engine.run(sources, Dataset(folder / f"out{workers}"), engine.Cluster(None, workers),
                             model=folder / "model.yaml")  # fmt: skip
            main = time.process_time() - cpu
            lines = [json.loads(each.read_text()) for each in folder.glob("*.json")]
            for each in folder.glob("*.json"):
                each.unlink()
            _print_ratios(workers, lines, main, end.failed)


def _print_ratios(workers: int, lines: list[dict[str, Any]], main_s: float, failed: int) -> None:
    by_worker: dict[int, list[dict[str, Any]]] = {}
    for each in sorted(lines, key=lambda each: each["end"]):
        by_worker.setdefault(each["pid"], []).append(each)
    inside = sum(each["cpu"] for each in lines)
    # Between the end of a worker's first task and the end of its last: no start-up, no imports.
    later = [own[1:] for own in by_worker.values()]
    between = sum(own[-1]["all"] - own[0]["all"] for own in by_worker.values())
    within = sum(each["cpu"] for own in later for each in own)
    busy = sum(each["end"] - each["begun"] for own in later for each in own) / sum(
        own[-1]["end"] - own[0]["end"] for own in by_worker.values()
    )
    count = sum(map(len, later))
    memory = [(own[0]["rss"], own[-1]["rss"]) for own in by_worker.values()]
    print(
        f"{workers} processes: {len(lines)} tasks, {failed} failed, {within / count:.2f} s of a processor\n"
        f"  engine in the workers: {100.0 * (between - within) / within:.2f} %\n"
        f"  main process, with start and end: {main_s:.1f} s, {100.0 * main_s / inside:.1f} %\n"
        f"  workers busy: {100.0 * busy:.1f} % of the time between their first and last task\n"
        f"  memory after the first and the last task, MB: "
        f"{', '.join(f'{one:.0f} to {other:.0f}' for one, other in memory)}",
        flush=True,
    )


def _rss_mb() -> float:
    return float(psutil.Process().memory_info().rss / 1e6)


def main() -> None:
    """Prints the figures that were asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = parser.add_subparsers(dest="kind", required=True)
    for name in ("score", "prior"):
        each = kinds.add_parser(name)
        each.add_argument("fleet", type=Path)
        each.add_argument("out", type=Path)
    kinds.choices["score"].add_argument("--limit", type=float, default=10.0)
    engine = kinds.add_parser("ratios")
    engine.add_argument("--samples", type=int, default=32_000)
    engine.add_argument("--tasks", type=int, default=6)
    given = parser.parse_args()
    if given.kind == "score":
        score(given.fleet, given.out, given.limit)
    elif given.kind == "prior":
        prior(given.fleet, given.out)
    else:
        ratios(given.samples, given.tasks)


if __name__ == "__main__":
    main()
