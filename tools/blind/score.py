"""Diagnose every case of a blind suite and print how well it went.

python tools/blind/score.py FOLDER [--jobs 2] [--reuse] [--timeout 600] [--json OUT] [--command COMMAND]

Each case's answer is kept next to it as diagnosis.json and diagnosis.yaml (exit status, seconds); --reuse
judges what is there without running again. Exit status 1 where a command failed.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml
from blindscore import Verdict, judged
from blindtables import page

COMMAND = f"{Path(sys.executable).parent / 'hdbridge'} diagnose"


def diagnosed(case: Path, command: Sequence[str], timeout_s: float) -> None:
    """Run the command on a case; keep its answer, its exit status and the time that it took."""
    answer = case / "diagnosis.json"
    answer.unlink(missing_ok=True)
    parts = [*command, str(case / "record.csv"), "--model", str(case / "model.yaml"), "--json", str(answer)]
    began_s = time.perf_counter()
    try:
        done = subprocess.run(parts, capture_output=True, text=True, timeout=timeout_s, check=False)
        status, said = done.returncode, (done.stderr or done.stdout)[-2000:]
    except subprocess.TimeoutExpired:
        status, said = 124, f"took more than {timeout_s:g} s"
    report: dict[str, Any] = {"exit_status": status, "seconds": round(time.perf_counter() - began_s, 2)}
    if status:
        report["said"] = said
    (case / "diagnosis.yaml").write_text(yaml.safe_dump(report), encoding="utf-8")


def verdict_of(case: Path) -> Verdict:
    """Judge the answer that is kept with a case."""
    hidden = yaml.safe_load((case / "hidden.yaml").read_text(encoding="utf-8"))
    report = yaml.safe_load((case / "diagnosis.yaml").read_text(encoding="utf-8"))
    failed = ""
    diagnosis: dict[str, Any] | None = None
    if report["exit_status"]:
        failed = f"exit status {report['exit_status']}"
    else:
        diagnosis = json.loads((case / "diagnosis.json").read_text(encoding="utf-8"))
        if diagnosis is None or diagnosis.get("schema") != "hdbridge.diagnosis/1":
            failed, diagnosis = "another schema", None
    truth, model = (_yaml(case / name) for name in ("truth.yaml", "model.yaml"))
    return judged(hidden, diagnosis, float(report["seconds"]), failed, truth, model)


def _yaml(path: Path) -> dict[str, Any]:
    """A file of a case; empty where it is not there."""
    return dict(yaml.safe_load(path.read_text(encoding="utf-8"))) if path.exists() else {}


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, diagnose, judge, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="folder that generate.py made")
    parser.add_argument("--jobs", type=int, default=1, help="cases at once; with 1 the run times are true")
    parser.add_argument("--reuse", action="store_true", help="do not run a case that has an answer")
    parser.add_argument("--timeout", type=float, default=600.0, help="seconds for a case")
    parser.add_argument("--json", type=Path, help="write the verdicts for machines")
    parser.add_argument("--command", default=COMMAND, help="command that diagnoses")
    parser.add_argument("--only", default="", help="only cases whose name contains this")
    options = parser.parse_args(arguments)
    cases = sorted(each.parent for each in options.folder.glob("*/hidden.yaml"))
    cases = [each for each in cases if options.only in each.name]
    if not cases:
        print(f"{options.folder}: no cases; make some with tools/blind/generate.py", file=sys.stderr)
        return 2
    to_run = [each for each in cases if not (options.reuse and (each / "diagnosis.yaml").exists())]
    command = shlex.split(options.command)
    with ThreadPoolExecutor(options.jobs) as pool:
        for case, _ in zip(
            to_run, pool.map(lambda case: diagnosed(case, command, options.timeout), to_run), strict=True
        ):
            print(f"{case.name} diagnosed", file=sys.stderr, flush=True)
    verdicts = [verdict_of(each) for each in cases]
    print(page(verdicts))
    if options.json:
        options.json.write_text(json.dumps([asdict(each) for each in verdicts], indent=1), encoding="utf-8")
    return 1 if any(each.failed for each in verdicts) else 0


if __name__ == "__main__":
    raise SystemExit(main())
