"""Make a blind suite: records of simulated axes with something hidden in them, or nothing.

python tools/blind/generate.py --out FOLDER [--seed 1] [--cases single=1,pair=20,...] [--jobs 2] [--means]

Each case is a folder: record.csv and model.yaml (what a diagnosis is given), hidden.yaml (what it should
find) and truth.yaml (the plant, for whoever wants to look). The same seed and case name give the same files.
"single" and "power" are numbers for each cause of the catalogue, "power" at several sizes over the noise; the
others are numbers of cases.
"""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from blindcase import KINDS, Case, cases, make

SUITE = "single=2,pair=30,triple=10,none=30,other_law=20,unknown=20,no_torque=4"


def wanted(text: str) -> dict[str, int]:
    """``kind=number,...`` as a mapping."""
    pairs = (each.partition("=") for each in text.split(",") if each)
    return {kind.strip(): int(number or 1) for kind, _, number in pairs}


def made(case: Case, seed: int, out: Path, means: bool) -> tuple[str, float]:
    """Make one case; its name and how long it took."""
    began_s = time.perf_counter()
    make(case, seed, out, means)
    return case.name, time.perf_counter() - began_s


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line and make the suite."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the suite")
    parser.add_argument("--seed", type=int, default=1, help="seed of the suite")
    parser.add_argument(
        "--cases", default=SUITE, help=f"number by kind ({', '.join(KINDS)}); default {SUITE}"
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--means", action="store_true", help="block means in place of every fifth reading")
    parser.add_argument("--only", default="", help="only cases whose name contains this")
    options = parser.parse_args(arguments)
    try:
        chosen = [each for each in cases(wanted(options.cases), options.seed) if options.only in each.name]
    except ValueError as problem:
        print(problem, file=sys.stderr)
        return 2
    job = partial(made, seed=options.seed, out=options.out, means=options.means)
    with ProcessPoolExecutor(options.jobs) as pool:
        for number, (name, seconds) in enumerate(pool.map(job, chosen), 1):
            print(f"{number}/{len(chosen)} {name} {seconds:.1f} s", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
