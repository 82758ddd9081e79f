"""Figures of a fleet: how right it is, what its prior brings, what the engine costs.

.venv/bin/python tools/bench/fleet.py score FLEET OUT [--limit ARCSEC]
.venv/bin/python tools/bench/fleet.py prior FLEET OUT [--most 12]
.venv/bin/python tools/bench/fleet.py ratios [--samples 32000] [--tasks 6]

FLEET is a folder of `hdbridge fleet simulate`, OUT the result of a run over it; `prior` needs a FLEET of
another seed than the one of OUT. All figures are of processor time, so
they hold on a computer that others use too.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from diagnose import record
from support import plant

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.calibration import fit
from hdbridge.fleet import engine
from hdbridge.fleet.dataset import Dataset
from hdbridge.fleet.diagnosing import read
from hdbridge.fleet.prior import read_prior
from hdbridge.fleet.simulate import YEAR_HOURS, peak_at_0_hours_arcsec
from hdbridge.fleet.sources import Source, read_manifest
from hdbridge.fleet.summary import summarise
from hdbridge.records.record import Record

DETECTABLE = 2
"""Recordings in which a cause must exceed the limit of detection before a joint can be listed for it."""


def score(fleet: Path, out: Path, limit_arcsec: float) -> None:
    """Compares the summary of a run with what the simulation hid; joints without a row are left out."""

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
    swapped = {each for each in answers["swapped"] if each in seen}
    wanted = {
        row["path"]
        for row in rows
        if row["joint"] in swapped and row["reason"] is None and row["duplicate_of"] is None
        if _number(row, joints) >= answers["swapped_from"]
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


def prior(fleet: Path, out: Path, most: int) -> None:
    """Diagnoses the last recordings of fresh joints with and without the fleet's prior; prints the gain."""

    answers = json.loads((fleet / "answers.json").read_text())
    joints = {each["name"]: each for each in answers["joints"]}
    sources: dict[str, list[Any]] = {}
    for each in read_manifest(fleet / "manifest.csv").values():
        sources.setdefault(each.joint or "", []).append(each)
    totals = {name: {"right": 0, "wrong": 0, "missed": 0} for name in ("without", "with")}
    ratios: list[float] = []
    done = 0
    for name, own in sorted(sources.items()):
        if name in answers["swapped"] or joints[name]["turned_at"] is not None:
            continue
        own.sort(key=lambda each: each.order)
        try:
            model = fit(read(own[0]), ratio=own[0].ratio).model
            recording = replace(read(own[-1]), ratio=own[-1].ratio)
        except Exception as problem:  # damaged on purpose
            print(f"{name}: left out: {problem}")
            continue
        known = read_prior(out / "fleet.parquet", {"batch": joints[name]["batch"]})
        results = {"without": diagnose(recording, model), "with": diagnose(recording, model, prior=known)}
        true = joints[name]["cause"]
        for kind, result in results.items():
            named = [each for each in result.findings if each.cause != "unexplained"]
            hits = [true in (each.cause, *each.aliases) for each in named]
            totals[kind]["right"] += any(hits)
            totals[kind]["wrong"] += len(hits) - sum(hits)
            totals[kind]["missed"] += bool(true) and not any(hits)
        ratios += _widths(results["without"], results["with"])
        done += 1
        names = {kind: [each.cause for each in result.findings] for kind, result in results.items()}
        print(f"{name} ({true}): {names['without']} -> {names['with']}", flush=True)
        if done >= most:
            break
    print(f"{done} fresh joints, last recording: {totals}")
    if ratios:
        print(f"width of {len(ratios)} intervals, with over without: median {np.median(ratios):.2f}, "
              f"{np.mean(np.array(ratios) < 0.99):.0%} narrower")  # fmt: skip


def _widths(without: Any, with_prior: Any) -> list[float]:
    found = {each.cause: each for each in with_prior.findings}
    return [
        (other.high - other.low) / (own.high - own.low)
        for each in without.findings
        if each.cause in found
        for name, own in each.parameters.items()
        if (other := found[each.cause].parameters.get(name)) and 0.0 < own.high - own.low < np.inf
    ]


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
    kinds.choices["prior"].add_argument("--most", type=int, default=12)
    engine = kinds.add_parser("ratios")
    engine.add_argument("--samples", type=int, default=32_000)
    engine.add_argument("--tasks", type=int, default=6)
    given = parser.parse_args()
    if given.kind == "score":
        score(given.fleet, given.out, given.limit)
    elif given.kind == "prior":
        prior(given.fleet, given.out, given.most)
    else:
        ratios(given.samples, given.tasks)


if __name__ == "__main__":
    main()
