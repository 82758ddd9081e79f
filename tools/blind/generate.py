"""Makes a blind suite: records of simulated axes with hidden causes, or none.

    python tools/blind/generate.py build/blind                      # everyday records, to develop on: seed 1
    python tools/blind/generate.py build/held --seed 4711 --suite everyday
    python tools/blind/generate.py build/full --seed 4712 --suite bench

Each case is a folder: the record and model.yaml are what a diagnosis is given, sealed.json is what it should
find. An existing case is not made again, so the command continues where it was stopped. A folder
is either complete or absent. The same seed and case give the same record. Suites with a seed of 1000 and more
are held out: score.py prints their rates and no cases, so that they are not used for development.

A suite may also be a list such as ``fault=60,law=20``. ``single`` is a number for each cause of
the catalogue, ``flicker`` counts pairs, the others count cases.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
import traceback
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1]))
from blind.case import KINDS, SCHEMA, Case, cases, make

SUITES = {
    "development": "healthy_bench=60,healthy_work=60,fault=60,law=20,outside=20,flicker=10",
    "everyday": "healthy_bench=200,healthy_work=200,fault=200,law=100,outside=60,flicker=50",
    "bench": "single=4,pair=20,triple=10,none=20,other_law=20,unknown=20",
}


def wanted(text: str) -> dict[str, int]:
    """Parses a suite's name, or ``kind=number,...``."""
    pairs = (each.partition("=") for each in SUITES.get(text, text).split(",") if each)
    return {kind.strip(): int(number or 1) for kind, _, number in pairs}


def made(group: Sequence[Case], seed: int, out: Path) -> list[tuple[str, float]]:
    """Makes the missing cases of one axis; returns their names and durations, NaN after a failure."""
    done = []
    for case in group:
        began_s, folder = time.perf_counter(), case.folder(out, seed)
        if not folder.exists():
            try:
                make(case, seed, out)
            except Exception:
                traceback.print_exc()
        done.append((folder.name, time.perf_counter() - began_s if folder.exists() else math.nan))
    return done


def main(arguments: list[str] | None = None) -> int:
    """Parses the command line and makes the suite."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, help="folder of the suite")
    parser.add_argument("--seed", type=int, default=1, help="seed of the suite")
    parser.add_argument(
        "--suite",
        default="development",
        help=f"{', '.join(SUITES)}, or a list of kind=number ({', '.join(KINDS)})",
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--only", default="", help="only cases whose name contains this")
    options = parser.parse_args(arguments)
    try:
        chosen = [each for each in cases(wanted(options.suite), options.seed) if options.only in each.name]
        claim(options.out, options.seed)
    except ValueError as problem:
        print(problem, file=sys.stderr)
        return 2
    # Cases of one axis go to one process, because the first of them calibrates it.
    groups: dict[str, list[Case]] = {}
    for each in chosen:
        axis = each.axis.removesuffix("-fine").removesuffix("-coarse")
        groups.setdefault(axis or each.name, []).append(each)
    job = partial(made, seed=options.seed, out=options.out)
    number = failed = 0
    with ProcessPoolExecutor(options.jobs, initializer=os.nice, initargs=(10,)) as pool:
        for done in pool.map(job, groups.values()):
            for name, seconds in done:
                number, failed = number + 1, failed + math.isnan(seconds)
                print(f"{number}/{len(chosen)} {name} {seconds:.1f} s", flush=True)
    return 1 if failed else 0


def claim(folder: Path, seed: int) -> None:
    """Records the seed of the folder; raises ValueError if it belongs to a different seed."""
    about = folder / "suite.json"
    if about.exists():
        found = json.loads(about.read_text(encoding="utf-8"))["seed"]
        if found != seed:
            raise ValueError(
                f"{folder}: holds a suite of seed {found}; name another folder, or --seed {found}"
            )
        return
    folder.mkdir(parents=True, exist_ok=True)
    about.write_text(json.dumps({"schema": SCHEMA, "seed": seed}) + "\n", encoding="utf-8")


if __name__ == "__main__":
    raise SystemExit(main())
